"""Play scripted reflexes, to see what can be won in a scene with one sense and one decision.

All do the same two things and differ in when they go over to the second. Where an
object is handed over they wait, then close; an active hand does not wait still, but
closes and opens. Elsewhere they approach and close, then lift. A search may choose when
to go over, and also how far to close (in a lift) or how long each squeeze lasts (of an
active hand).
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
FINAL_ACTIONS = 3  # actions before the end of an episode
SQUEEZES = (3, 5, 8)  # actions that an active hand closes, and as many that it opens
SENSES: dict[str, tuple[Sequence[float], Sequence[float]]] = {
    "time": (range(6, 51, 3), (0, 2, 5)),
    "joints": (np.geomspace(2.0, 100.0, 15).tolist(), (-0.3, -0.1, -0.03)),
    "active": (np.geomspace(0.01, 0.16, 5).tolist(), ()),
    "touch": (range(1, 16), (2, 6, 12)),
    "sight": (np.linspace(-0.053, 0.003, 15).tolist(), (0, 2, 5)),
}
"""Thresholds that a search may choose from, of a handover and of a lift; a lift has no
active hand."""
CANDIDATES = 15  # of every sense
CLOSINGS = (0.7, 0.85, 1.0, 1.15, 1.3)  # of a scripted grasp


@dataclass(frozen=True)
class Reflex:
    """A scripted hand that goes over to its second part when `sense` reads `threshold` or more."""

    sense: str
    """One of SENSES."""
    threshold: float
    """Reading of the sense from which the hand goes over, in the unit of the method of
    `_Senses`."""
    closing: float
    """Share of the way that the hand closes, to its scripted grasp or to the closed
    hand; 1: all."""
    squeeze: int = 0
    """Actions for which an active hand closes before it opens for as many; 0: it waits
    instead."""

    def play(
        self,
        env: gym.Env[Any, Any],
        number: int,
        is_wanted: vector.IsWanted = lambda: True,
    ) -> bool:
        """Play the start that the seed `number` draws, and return whether it succeeds."""
        base: Any = env.unwrapped
        obs, _ = env.reset(seed=number)
        lifts, shift = base.task.giver is None, np.zeros(2)
        if lifts and self.sense == "sight":  # where the object is seen beside its place
            seen = base.observation_entries("object_position")[:2]
            shift = obs["observation"][seen].astype(float)
        first, second = parts(base, self.closing, shift)
        latest = base.max_episode_steps - FINAL_ACTIONS - lifts * len(second)
        senses = _Senses(base, obs, lifts * len(first), self.squeeze)
        read = getattr(senses, self.sense)
        targets: Iterator[Array] = chain(first, repeat(first[-1]))
        if self.squeeze:
            targets = cycle([second[-1]] * self.squeeze + [first[-1]] * self.squeeze)
        is_first, is_over = True, False
        while not is_over:
            if is_first and (read() >= self.threshold or senses.step >= latest):
                is_first, targets = False, chain(second, repeat(second[-1]))
            obs, _, terminated, truncated, info = base.step_to(next(targets))
            senses.add(obs)
            is_over = terminated or truncated
        return bool(info["is_success"])


class _Senses:
    """Read one sense of a policy's observations: the newest and the first few."""

    def __init__(
        self, env: GraspEnv, obs: dict[str, Array], n_first: int, squeeze: int
    ) -> None:
        """Take an environment and its first observation.

        `n_first` is the number of actions of a lift's first part, 0 in a handover, and
        `squeeze` as in `Reflex`.
        """
        entries = env.observation_entries
        self._joints = entries("hand_position", "finger_joints", "joint_positions")
        self._object, self._taxels = entries("object_position"), entries("taxels")
        if not (len(self._joints) and len(self._object)):
            raise ValueError(
                "reflexes go by joints and the object, which this hand does not observe"
            )
        self._touching = env.palm_skin[2] - env.shape.half_size[2]
        self._lifts = env.task.giver is None
        self._n_first, self._squeeze = n_first, squeeze
        self._obs: list[Array] = []
        self.add(obs)

    def add(self, obs: dict[str, Array]) -> None:
        """Take in an observation after another action."""
        self._obs.append(obs["observation"])
        self.step = len(self._obs) - 1

    def _is_early(self) -> bool:
        """Tell whether the fingers have not yet set off to a grasp."""
        return self._lifts and self.step <= self._n_first // 2

    def touch(self) -> float:
        """Return how many taxels fire; -1 before any may."""
        if self._is_early():
            return -1.0
        return float((self._obs[-1][self._taxels] > 0).sum())

    def sight(self) -> float:
        """Return how near the object is to the palm, m; of one on the ground, the time."""
        if self._lifts:
            return self.time()
        return float(self._obs[-1][self._object[2]] - self._touching)

    def time(self) -> float:
        """Return the number of actions so far; of a lift, since a grasp could be closed."""
        return float(self.step - self._n_first)

    def joints(self) -> float:
        """Return how far any joint, or the hand, has moved, relative to how its first readings varied.

        In a lift, return how still the joints are instead, rad: minus the largest
        change since the last reading.
        """
        readings = np.array(self._obs)[:, self._joints].astype(float)
        if self._lifts:
            if self._is_early():
                return -np.inf
            return -float(np.abs(readings[-1] - readings[-2]).max())
        if self.step < BASELINE:
            return 0.0
        first = readings[:BASELINE]
        moved = np.abs(readings[-1] - first.mean(0)) / (first.std(0) + RESOLUTION)
        return float(moved.max())

    def active(self) -> float:
        """Return the mean distance of joints and hand from their places after the first test squeeze.

        It is in rad and m, and 0 but right after a test squeeze.
        """
        if not self._squeeze or self.step % (2 * self._squeeze) != self._squeeze:
            return 0.0
        now, first = (
            self._obs[step][self._joints] for step in (self.step, self._squeeze)
        )
        return float(np.abs(now - first).mean())


def candidates(env: GraspEnv, sense: str) -> list[Reflex]:
    """Return the fifteen reflexes of a sense to choose from; none if the scene has no use for it."""
    of_handover, of_lift = SENSES[sense]
    if env.task.giver is not None:
        squeezes = SQUEEZES if sense == "active" else (0,)
        return [
            Reflex(sense, *values) for values in product(of_handover, (1.0,), squeezes)
        ]
    return [Reflex(sense, *values) for values in product(of_lift, CLOSINGS)]


def parts(
    env: GraspEnv, closing: float, shift: Array
) -> tuple[list[Array], list[Array]]:
    """Return the joint targets (n_actuators,) of the first and of the second part.

    The object is `shift` (2,) m beside its place; at the end of a part the targets
    stay.
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
    offset = np.pad(shift, (0, len(opened) - 2))
    first = [targets + offset for targets in approach + close]
    return first, [targets + offset for targets in lift]
