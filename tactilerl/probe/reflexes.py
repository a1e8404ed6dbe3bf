"""Scripted reflexes: what can be won in a scene with one sense and one decision, without learning?

All do the same two things and differ in when they go over to the second. Where an object is handed
over they wait, then close. Elsewhere they approach and close, then lift. Each has two values that a
search may choose: when to go over, and how far to close.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, product, repeat

import numpy as np

from ..envs.grasp import GraspEnv
from ..envs.hands import Array
from ..envs.scripted import LIFT_HEIGHT, grasp_for, legs

BASELINE = 5  # readings: before, nothing has come to the hand yet
RESOLUTION = 1e-4  # rad or m: what any joint's reading may be off by
LATEST = 3  # actions before the end of an episode


@dataclass(frozen=True)
class Reflex:
    """Goes over to the second part as soon as its `sense` says `threshold` or more."""

    sense: str
    """One of SENSES."""
    threshold: float
    closing: float
    """How far the hand closes: 1 is all the way of its scripted grasp, or to the closed hand."""

    def play(self, env: GraspEnv, seed: int) -> bool:
        """Does it succeed from the start that `seed` draws?"""
        obs, _ = env.reset(seed=seed)
        reading = _Reading(env, obs)
        says = SENSES[self.sense](reading)
        first, second = _parts(env, self.closing, reading.shift(self.sense))
        targets, goes_over, is_over = first, False, False
        info: dict[str, bool] = {}
        while not is_over:
            due = reading.step >= env.max_episode_steps - LATEST - reading.second_steps
            if not goes_over and (says() >= self.threshold or due):
                targets, goes_over = second, True
            obs, _, terminated, truncated, info = env.follow(next(targets))
            reading.add(obs)
            is_over = terminated or truncated
        return bool(info["is_success"])


class _Reading:
    """What the policy would be told, by sense; the newest observation and the first few."""

    def __init__(self, env: GraspEnv, obs: dict[str, Array]) -> None:
        entries = env.observation_entries
        self._joints = entries("hand_position", "finger_joints", "joint_positions")
        self._object, self._taxels = entries("object_position"), entries("taxels")
        if not (len(self._joints) and len(self._object)):
            raise ValueError("reflexes go by joints and the object, which this hand does not observe")
        self.is_handed_over = env.task.giver is not None
        self.second_steps = 0 if self.is_handed_over else _n_lift(env)
        self._touching = env.palm_skin[2] - env.shape.half_size[2]
        self.n_first = len(_approach_and_close(env, 1.0, np.zeros(2)))
        self._seen: list[Array] = []
        self.add(obs)

    def add(self, obs: dict[str, Array]) -> None:
        """After another action."""
        self._seen.append(obs["observation"])
        self.step = len(self._seen) - 1

    def shift(self, sense: str) -> Array:
        """Where the object is seen beside its place (2,), m, by those that look."""
        looks = sense == "sight" and not self.is_handed_over
        return self._seen[0][self._object[:2]].astype(float) if looks else np.zeros(2)

    def taxels(self) -> float:
        """How many fire; -1 before the fingers have set off."""
        return float((self._seen[-1][self._taxels] > 0).sum()) if self._may_go else -1.0

    def sight(self) -> float:
        """How near the object is to the palm, m; of one on the ground, the time."""
        if not self.is_handed_over:
            return self.time()
        return float(self._seen[-1][self._object[2]] - self._touching)

    def time(self) -> float:
        """Actions so far; of a lift, since a grasp could be closed."""
        return float(self.step - (0 if self.is_handed_over else self.n_first))

    def joints(self) -> float:
        """How far any joint, or the hand, is from where it was at first, in what its readings varied
        by then; of a lift, how still the joints are, rad."""
        seen = np.array(self._seen)[:, self._joints].astype(float)
        if not self.is_handed_over:
            return -float(np.abs(seen[-1] - seen[-2]).max()) if self._may_go else -np.inf
        if self.step < BASELINE:
            return 0.0
        first = seen[:BASELINE]
        return float((np.abs(seen[-1] - first.mean(0)) / (first.std(0) + RESOLUTION)).max())

    @property
    def _may_go(self) -> bool:
        return self.is_handed_over or self.step > self.n_first // 2


SENSES: dict[str, Callable[[_Reading], Callable[[], float]]] = {
    "time": lambda reading: reading.time,
    "joints": lambda reading: reading.joints,
    "touch": lambda reading: reading.taxels,
    "sight": lambda reading: reading.sight,
}
CLOSINGS = (0.7, 0.85, 1.0, 1.15, 1.3)  # of a scripted grasp
HANDED: dict[str, tuple[float, ...]] = {
    "time": tuple(range(6, 51, 3)),
    "joints": tuple(np.geomspace(2.0, 100.0, 15).tolist()),
    "touch": tuple(range(1, 16)),
    "sight": tuple(np.linspace(-0.053, 0.003, 15).tolist()),
}
LIFTED: dict[str, tuple[float, ...]] = {
    "time": (0, 2, 5),
    "joints": (-0.3, -0.1, -0.03),
    "touch": (2, 6, 12),
    "sight": (0, 2, 5),
}


def candidates(env: GraspEnv, sense: str) -> list[Reflex]:
    """Fifteen reflexes of a sense to choose from, for every sense as many."""
    if env.task.giver is not None:
        return [Reflex(sense, threshold, 1.0) for threshold in HANDED[sense]]
    return [Reflex(sense, *values) for values in product(LIFTED[sense], CLOSINGS)]


def _parts(env: GraspEnv, closing: float, shift: Array) -> tuple[Iterator[Array], Iterator[Array]]:
    """Joint targets of the first part and of the second, each without an end."""
    if env.task.giver is not None:
        opened, closed = env.hand.start_targets(), env.hand.start_targets()
        for i, name in enumerate(env.hand.actuators):
            closed[i] += closing * (env.hand.closed.get(name, opened[i]) - opened[i])
        return repeat(opened), repeat(closed)
    first, lift = _approach_and_close(env, closing, shift), _lift(env, closing, shift)
    return chain(first, repeat(first[-1])), chain(lift, repeat(lift[-1]))


def _approach_and_close(env: GraspEnv, closing: float, shift: Array) -> list[Array]:
    approach, close, _ = legs(env, grasp_for(env), env.config.control_dt, closing)
    return [_beside(targets, shift) for targets in (*approach, *close)]


def _lift(env: GraspEnv, closing: float, shift: Array) -> list[Array]:
    """As high as the task wants it."""
    *_, lift = legs(env, grasp_for(env), env.config.control_dt, closing)
    if env.config.task == "reach-goal":
        end = lift[-1] + (env.config.goal_height - LIFT_HEIGHT) * np.eye(len(lift[-1]))[2]
        lift = [*lift[: _n_lift(env) // 2], end]
    return [_beside(targets, shift) for targets in lift]


def _n_lift(env: GraspEnv) -> int:
    return len(legs(env, grasp_for(env), env.config.control_dt)[2])


def _beside(targets: Array, shift: Array) -> Array:
    return np.concatenate([targets[:2] + shift, targets[2:]])
