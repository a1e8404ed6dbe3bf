"""The hold test of lift-and-hold: raise the hand to 1 m and see whether the object stays.

"The hand is moved to a height of 1 meter and kept there for 5000 unrecorded simulation
steps" (paper, PyBullet set-up). Here that is a time, 5,000 timesteps of the hand's own set-up, so
that a smaller timestep makes no shorter test. A failure is called as soon as it is certain: an
object that is further from the palm than any finger reaches is in free fall. A success is called
at the end, or, under the verdict "settled", once the object has stopped moving in the hand; how
often that is wrong was measured: docs/environments.md, "Hold test".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .hands import Array
from .simulators import Simulator

Verdict = Literal["full", "settled"]
RAISE_SPEED = 0.3  # m/s
OUT_OF_REACH = 0.25  # m from the palm; the longest finger reaches 0.15 m
LOOK_STEPS, SETTLE_STEPS = 25, 400  # of the set-up's own timestep


@dataclass(frozen=True)
class HoldTest:
    """Parameters of a hold test; times are rounded to whole timesteps, at least one."""

    seconds: float
    """Time at the top, s."""
    look_every: float
    """Time between looks at the object, s."""
    settle_seconds: float
    settle_distance: float = 5e-4
    """"settled": less movement in the palm's frame than this over `settle_seconds`, m."""
    verdict: Verdict = "full"
    height: float = 1.0
    """Height of the palm, m."""

    @classmethod
    def of_setup(cls, own_timestep: float, seconds: float, verdict: Verdict = "full") -> HoldTest:
        """The test of a set-up whose own timestep is `own_timestep` s, whatever timestep it is run
        with: looked at every 25 and settled over 400 of those."""
        return cls(seconds, LOOK_STEPS * own_timestep, SETTLE_STEPS * own_timestep, verdict=verdict)

    def run(self, simulator: Simulator, joint_targets: Array, timestep: float) -> bool:
        """Does the object stay in the hand? Leaves the simulator wherever the test ended."""
        history = []
        for is_at_top, position in self.positions(simulator, joint_targets, timestep):
            if np.linalg.norm(position) > OUT_OF_REACH:
                return False
            if is_at_top:
                history.append(position)
                if self.verdict == "settled" and self.is_settled(history):
                    return True
        return True

    def positions(
        self, simulator: Simulator, joint_targets: Array, timestep: float
    ) -> Iterator[tuple[bool, Array]]:
        """Raise and hold; at every look whether the hand is at the top, and the object's position
        relative to the palm (3,), m. The palm does not turn meanwhile."""
        targets, every = joint_targets.copy(), _n_steps(self.look_every, timestep)
        # From where the slide is, not from its target: the hand may still lag behind that.
        top = simulator.joint_state()[0][2] + self.height - simulator.link_positions()[0, 2]
        while targets[2] != top:
            way = RAISE_SPEED * timestep * every
            targets[2] += np.clip(top - targets[2], -way, way)
            simulator.step(targets, every)
            yield False, _in_hand(simulator)
        yield True, _in_hand(simulator)
        n_steps = _n_steps(self.seconds, timestep)
        for done in range(0, n_steps, every):
            simulator.step(targets, min(every, n_steps - done))
            yield True, _in_hand(simulator)

    def is_settled(self, history: list[Array]) -> bool:
        """Has the object moved less than `settle_distance` for `settle_seconds`?"""
        lag = round(self.settle_seconds / self.look_every)
        if len(history) <= lag:
            return False
        moved = np.linalg.norm(np.array(history[-lag - 1 :]) - history[-1], axis=1)
        return bool(moved.max() < self.settle_distance)


def _n_steps(seconds: float, timestep: float) -> int:
    return max(1, round(seconds / timestep))


def _in_hand(simulator: Simulator) -> Array:
    return simulator.object_state().position - simulator.link_positions()[0]
