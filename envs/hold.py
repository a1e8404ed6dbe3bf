"""The hold test of lift-and-hold: raise the hand to 1 m and see whether the object stays.

"The hand is moved to a height of 1 meter and kept there for 5000 unrecorded simulation
steps" (paper, PyBullet set-up). A failure is called as soon as it is certain: an object that
is further from the palm than any finger reaches is in free fall. A success is called at
the end, or, under the verdict "settled", once the object has stopped moving in the hand; how
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
CHECK_EVERY = 25  # simulation steps


@dataclass(frozen=True)
class HoldTest:
    """Parameters of a hold test."""

    steps: int = 5000
    """Simulation steps at the top."""
    height: float = 1.0
    """Height of the palm, m."""
    verdict: Verdict = "full"
    settle_steps: int = 400
    settle_distance: float = 5e-4
    """"settled": less movement in the palm's frame than this over `settle_steps`, m."""

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
        """Raise and hold; every CHECK_EVERY steps whether the hand is at the top, and the
        object's position relative to the palm (3,), m. The palm does not turn meanwhile."""
        targets = joint_targets.copy()
        # From where the slide is, not from its target: the hand may still lag behind that.
        top = simulator.joint_state()[0][2] + self.height - simulator.link_positions()[0, 2]
        while targets[2] != top:
            way = RAISE_SPEED * timestep * CHECK_EVERY
            targets[2] += np.clip(top - targets[2], -way, way)
            simulator.step(targets, CHECK_EVERY)
            yield False, _in_hand(simulator)
        yield True, _in_hand(simulator)
        for done in range(0, self.steps, CHECK_EVERY):
            simulator.step(targets, min(CHECK_EVERY, self.steps - done))
            yield True, _in_hand(simulator)

    def is_settled(self, history: list[Array]) -> bool:
        """Has the object moved less than `settle_distance` for `settle_steps`?"""
        lag = self.settle_steps // CHECK_EVERY
        if len(history) <= lag:
            return False
        moved = np.linalg.norm(np.array(history[-lag - 1 :]) - history[-1], axis=1)
        return bool(moved.max() < self.settle_distance)


def _in_hand(simulator: Simulator) -> Array:
    return simulator.object_state().position - simulator.link_positions()[0]
