"""Scripted reflexes: what can be won in a scene with one sense and one decision, without learning?

All do the same two things and differ in when they go over to the second. Where an object is handed
over they wait, then close; an active hand does not wait still, but closes and opens. Elsewhere they
approach and close, then lift. Each has two values that a search may choose: when to go over, and how
far to close.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, cycle, product, repeat
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import vector
from ..envs.grasp import GraspEnv
from ..envs.scripted import LIFT_HEIGHT, grasp_for, legs
from ..envs.state import Array

BASELINE = 5  # readings: before, nothing has come to the hand yet
RESOLUTION = 1e-4  # rad or m: what any joint's reading may be off by
LATEST = 3  # actions before the end of an episode
TRIAL = 3  # actions that an active hand closes, and as many that it opens
SENSES: dict[str, tuple[Sequence[float], Sequence[float]]] = {
    "time": (range(6, 51, 3), (0, 2, 5)),
    "joints": (np.geomspace(2.0, 100.0, 15).tolist(), (-0.3, -0.1, -0.03)),
    "active": (np.geomspace(0.01, 0.3, 15).tolist(), ()),
    "touch": (range(1, 16), (2, 6, 12)),
    "sight": (np.linspace(-0.053, 0.003, 15).tolist(), (0, 2, 5)),
}
"""Thresholds that a search may choose from, of a handover and of a lift; a lift has no active hand."""
CANDIDATES = 15  # of every sense
CLOSINGS = (0.7, 0.85, 1.0, 1.15, 1.3)  # of a scripted grasp


@dataclass(frozen=True)
class Reflex:
    """Goes over to the second part as soon as its `sense` says `threshold` or more."""

    sense: str
    """One of SENSES."""
    threshold: float
    closing: float
    """Share of the way that the hand closes, to its scripted grasp or to the closed hand; 1: all."""

    def play(
        self,
        env: gym.Env[Any, Any],
        number: int,
        is_wanted: vector.IsWanted = lambda: True,
    ) -> bool:
        """Play the start that the seed `number` draws: does it succeed?"""
        base: Any = env.unwrapped
        obs, _ = env.reset(seed=number)
        reading = _Reading(base, obs)
        says = getattr(reading, self.sense)
        latest = base.max_episode_steps - LATEST - reading.n_second
        parts = _parts(base, self.closing, reading.shift(self.sense))
        first: Iterator[Array]
        first, second = (chain(part, repeat(part[-1])) for part in parts)
        if self.sense == "active":
            first = cycle([parts[1][-1]] * TRIAL + [parts[0][-1]] * TRIAL)
        targets, is_over = first, False
        while not is_over:
            if targets is first and (
                says() >= self.threshold or reading.step >= latest
            ):
                targets = second
            obs, _, terminated, truncated, info = base.step_to(next(targets))
            reading.add(obs)
            is_over = terminated or truncated
        return bool(info["is_success"])


class _Reading:
    """Read what the policy would be told, by sense: the newest observation and the first few."""

    def __init__(self, env: GraspEnv, obs: dict[str, Array]) -> None:
        entries = env.observation_entries
        self._joints = entries("hand_position", "finger_joints", "joint_positions")
        self._object, self._taxels = entries("object_position"), entries("taxels")
        if not (len(self._joints) and len(self._object)):
            raise ValueError(
                "reflexes go by joints and the object, which this hand does not observe"
            )
        self._touching = env.palm_skin[2] - env.shape.half_size[2]
        self._lifts = env.task.giver is None
        parts = _parts(env, 1.0, np.zeros(2)) if self._lifts else ((), ())
        self._n_first, self.n_second = (len(part) for part in parts)
        self._seen: list[Array] = []
        self.add(obs)

    def add(self, obs: dict[str, Array]) -> None:
        """Take in an observation after another action."""
        self._seen.append(obs["observation"])
        self.step = len(self._seen) - 1
        self._may_go = (
            not self._lifts or self.step > self._n_first // 2
        )  # the fingers have set off

    def shift(self, sense: str) -> Array:
        """Return where the object is seen beside its place (2,), m, by those that look."""
        looks = sense == "sight" and self._lifts
        return self._seen[0][self._object[:2]].astype(float) if looks else np.zeros(2)

    def touch(self) -> float:
        """Return how many taxels fire; -1 before any may."""
        return float((self._seen[-1][self._taxels] > 0).sum()) if self._may_go else -1.0

    def sight(self) -> float:
        """Return how near the object is to the palm, m; of one on the ground, the time."""
        if self._lifts:
            return self.time()
        return float(self._seen[-1][self._object[2]] - self._touching)

    def time(self) -> float:
        """Return the actions so far; of a lift, since a grasp could be closed."""
        return float(self.step - self._n_first)

    def joints(self) -> float:
        """Return how far any joint, or the hand, has moved, relative to how its first readings varied.

        In a lift, return how still the joints are instead, rad: minus the largest change since the last
        reading.
        """
        seen = np.array(self._seen)[:, self._joints].astype(float)
        if self._lifts:
            return (
                -float(np.abs(seen[-1] - seen[-2]).max()) if self._may_go else -np.inf
            )
        if self.step < BASELINE:
            return 0.0
        first = seen[:BASELINE]
        moved = np.abs(seen[-1] - first.mean(0)) / (first.std(0) + RESOLUTION)
        return float(moved.max())

    def active(self) -> float:
        """Return the mean distance of joints and hand from their places after the first test squeeze.

        It is in rad and m, and 0 but right after a test squeeze.
        """
        if self.step % (2 * TRIAL) != TRIAL:
            return 0.0
        now, first = (self._seen[step][self._joints] for step in (self.step, TRIAL))
        return float(np.abs(now - first).mean())


def candidates(env: GraspEnv, sense: str) -> list[Reflex]:
    """Return the fifteen reflexes of a sense to choose from; none if the scene has no use for it."""
    handed, lifted = SENSES[sense]
    if env.task.giver is not None:
        return [Reflex(sense, threshold, 1.0) for threshold in handed]
    return [Reflex(sense, *values) for values in product(lifted, CLOSINGS)]


def _parts(
    env: GraspEnv, closing: float, shift: Array
) -> tuple[list[Array], list[Array]]:
    """Return the joint targets of the first and of the second part, for an object beside its place.

    The object is `shift` (2,) m beside its place; at the end of a part the targets stay.
    """
    opened = env.hand.start_targets()
    if env.task.giver is not None:
        named = zip(env.hand.actuators, opened, strict=True)
        closed = np.array([env.hand.closed.get(name, angle) for name, angle in named])
        return [opened], [opened + closing * (closed - opened)]
    approach, close, lift = legs(env, grasp_for(env), env.config.control_dt, closing)
    if env.config.task == "reach-goal":  # as high as the task wants it
        n, height = len(lift) // 2, env.config.goal_height
        end = lift[-1] + (height - LIFT_HEIGHT) * np.eye(len(opened))[2]
        lift = lift[:n] + [end] * (len(lift) - n)
    beside = np.pad(shift, (0, len(opened) - 2))
    return [targets + beside for targets in approach + close], [
        targets + beside for targets in lift
    ]
