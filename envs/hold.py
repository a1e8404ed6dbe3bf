"""The hold test of lift-and-hold: raise the hand to 1 m and see whether the object stays.

"The hand is moved to a height of 1 meter and kept there for 5000 unrecorded simulation
steps" (paper, PyBullet set-up). A failure is called as soon as it is certain: an object that
hangs further below the palm than any finger reaches is in free fall. A success is called at
the end, or, under the verdict "settled", once the object has stopped moving in the hand; how
often that is wrong is measured in docs/environments.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .hands import Array
from .simulators import Simulator

Verdict = Literal["full", "settled"]
RAISE_SPEED = 0.3  # m/s
OUT_OF_REACH = 0.25  # m below the palm; the longest finger reaches 0.15 m
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
        targets = joint_targets.copy()
        top = targets[2] + self.height - simulator.link_positions()[0, 2]
        while targets[2] < top:
            targets[2] = min(top, targets[2] + RAISE_SPEED * timestep * CHECK_EVERY)
            simulator.step(targets, CHECK_EVERY)
            if _fell(simulator):
                return False
        history = [_in_hand(simulator)]
        lag = self.settle_steps // CHECK_EVERY
        for _ in range(self.steps // CHECK_EVERY):
            simulator.step(targets, CHECK_EVERY)
            if _fell(simulator):
                return False
            history.append(_in_hand(simulator))
            if self.verdict == "settled" and len(history) > lag:
                moved = np.linalg.norm(np.array(history[-lag - 1 :]) - history[-1], axis=1).max()
                if moved < self.settle_distance:
                    return True
        return True


def _in_hand(simulator: Simulator) -> Array:
    """Position of the object relative to the palm; the palm does not turn during the test."""
    return simulator.object_state().position - simulator.link_positions()[0]


def _fell(simulator: Simulator) -> bool:
    return bool(_in_hand(simulator)[2] < -OUT_OF_REACH)
