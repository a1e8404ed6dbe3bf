"""The two tasks of the paper: what is achieved, what is rewarded, what is success.

A task is pure: it looks at a `Situation`, never at a simulator. Rewards are functions of the
achieved and the desired goal alone, so that hindsight relabelling can recompute them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from .hands import Array

Outcome = Literal["undecided", "fell_back", "lifted", "dropped", "held", "timed_out"]
# How the outcome of a step of lift-and-hold stands in its achieved goal.
OUTCOMES: dict[Outcome, float] = {
    "timed_out": -1.0,
    "undecided": 0.0,
    "fell_back": 0.25,  # had left the ground, and lies on it again
    "lifted": 0.4,  # the hold test decides between the next two
    "dropped": 0.5,  # was lifted, and did not survive the hold test
    "held": 1.0,
}
FINAL = ("held", "dropped", "timed_out")  # the paper's time-out is a verdict too, with its -100


@dataclass(frozen=True)
class Situation:
    """What a task may look at after a control step, world frame, SI units."""

    hand: Array
    """(3,) palm point."""
    fingertips: Array
    """(5, 3)"""
    object_position: Array
    """(3,)"""
    outcome: Outcome


class Task(Protocol):
    """A goal, a reward and a verdict."""

    @property
    def tests_hold(self) -> bool:
        """Does lifting the object end the episode with a hold test?"""

    @property
    def has_single_goal(self) -> bool:
        """Is one goal the only one that is ever asked for, or could be?"""

    @property
    def max_episode_steps(self) -> int:
        """Length of an episode unless the configuration says otherwise."""

    def desired_goal(self) -> Array:
        """(goal_size,) float64"""

    def achieved_goal(self, situation: Situation) -> Array:
        """(goal_size,) float64"""

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards (...) from goals (..., goal_size)."""

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """bool (...)"""


@dataclass(frozen=True)
class ReachGoal:
    """Bring the object to a place above the ground and keep it there (paper, MuJoCo set-up)."""

    goal: tuple[float, float, float]
    tolerance: float
    kind: Literal["sparse", "dense"]
    max_episode_steps: int = 20
    tests_hold: bool = False
    has_single_goal: bool = False

    def desired_goal(self) -> Array:
        return np.array(self.goal)

    def achieved_goal(self, situation: Situation) -> Array:
        return situation.object_position

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """sparse: 0 within the tolerance, else -1; dense: -10 x distance in m. Both readings
        of the paper exist in the code it builds on (Plappert et al. 2018)."""
        if self.kind == "dense":
            return -10.0 * _distance(achieved_goal, desired_goal)
        return self.is_success(achieved_goal, desired_goal) - 1.0

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        return _distance(achieved_goal, desired_goal) <= self.tolerance


@dataclass(frozen=True)
class LiftAndHold:
    """Grasp, lift, and survive a long unrecorded hold at 1 m (paper, PyBullet set-up).

    The achieved goal holds the six distances the reward is made of (palm, then fingertips,
    to the object's centre, m) and the outcome; the desired goal is the outcome "held". There
    is one goal only, so relabelling an episode leaves its rewards as they are.
    """

    finger_weight: float = 0.2
    """alpha of the paper's reward."""
    max_episode_steps: int = 100
    tests_hold: bool = True
    has_single_goal: bool = True

    def desired_goal(self) -> Array:
        return np.array([0.0] * 6 + [OUTCOMES["held"]])

    def achieved_goal(self, situation: Situation) -> Array:
        points = np.vstack([situation.hand, situation.fingertips])
        distances = _distance(points, situation.object_position)
        return np.append(distances, OUTCOMES[situation.outcome])

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Closeness of palm and fingertips until a lift; 5 more for a failed attempt, whether
        the object fell back before it was lifted or was dropped in the hold test; 1000 for a
        lift that held; -100 at time-out. Squares are of metres, as the paper has them."""
        closeness = np.exp(-(achieved_goal[..., :6] ** 2))
        reward = closeness[..., 0] + self.finger_weight * closeness[..., 1:].sum(axis=-1)
        outcome = achieved_goal[..., 6]
        failed = (outcome == OUTCOMES["fell_back"]) | (outcome == OUTCOMES["dropped"])
        reward = np.where(failed, reward + 5.0, reward)
        reward = np.where(outcome == OUTCOMES["timed_out"], -100.0, reward)
        return np.where(self.is_success(achieved_goal, desired_goal), 1000.0, reward)

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        return np.asarray(achieved_goal)[..., 6] == OUTCOMES["held"]


def _distance(a: Any, b: Any) -> Array:
    return np.linalg.norm(np.asarray(a) - np.asarray(b), axis=-1)
