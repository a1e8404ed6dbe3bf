"""The hold test of lift-and-hold: raise the hand to 1 m and see whether the object stays.

"The hand is moved to a height of 1 meter and kept there for 5000 unrecorded simulation
steps" (paper, PyBullet set-up). Here that is a time, 5,000 timesteps of the hand's own set-up, so
that a smaller timestep makes no shorter test. A failure is called as soon as it is certain: an
object that is further from the palm than any finger reaches is in free fall. A success is called
at the end.

The verdict "settled" runs the same test with time compressed. What decides a long hold is how far
the object creeps, so creep is sped up (`Simulator.set_creep`), and a success is called as soon as
the object's movement would not take it far by the end. How often that is wrong was measured:
docs/concepts/tasks.md, "The hold test".
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count, product
from typing import Literal

import numpy as np

from .simulators import Simulator
from .state import Array, State

Verdict = Literal["full", "settled"]
RAISE_SPEED = 0.3  # m/s
OUT_OF_REACH = (
    0.25  # m from the palm; the longest finger of the library's hands reaches 0.15 m
)
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
CLEARANCE = 0.01  # m under the object: nothing but the hand holds it
LOOK_STEPS = 25  # of the set-up's own timestep, whatever timestep it is run with


@dataclass(frozen=True)
class HoldTest:
    """A hold test; times are rounded to whole timesteps, at least one."""

    seconds: float
    """Time at the top, s."""
    look_every: float
    """Time between looks at the object, s."""
    verdict: Verdict = "full"
    """Kind of the test: in full, or until the object has settled."""
    height: float = 1.0
    """Height of the palm, m."""
    out_of_reach: float = OUT_OF_REACH
    """An object further than this from the palm is in free fall, m."""
    creep: float = 20.0
    """Factor by which "settled" speeds creep up and compresses time. What this and the next two cost
    is measured by ``python -m benchmarks hold_verdict``."""
    shake_seconds: float = 0.2
    """Time after which the jolt of setting off is over, s; "settled" speeds creep up from then on."""
    settle_distance: float = 2e-3
    """Distance, m, by which no point of an object at rest will move before the compressed test of
    "settled" ends, and for one look more."""

    def run(self, simulator: Simulator, state: State) -> bool:
        """Return True if the object stays in the hand, from this state on.

        Joint targets stay as they are, but for the slide that rises. Leaves the simulator wherever the
        test ended.
        """
        timestep = simulator.scene.timestep
        n_substeps = max(1, round(self.look_every / timestep))
        n_left = max(1, round(self.seconds / timestep))
        n_shaken = round(self.shake_seconds / self.look_every)
        rise = RAISE_SPEED * timestep * n_substeps
        targets, corners = state.targets.copy(), _corners(state)
        # From where the slide is, not from its target: the hand may lag far behind that.
        targets[2] = state.joint_positions[2]
        top = targets[2] + self.height - state.palm[2]
        try:
            for look in count(1):
                if targets[2] != top:  # the palm does not turn, but rise and stay
                    targets[2] += np.clip(top - targets[2], -rise, rise)
                else:
                    n_substeps = min(n_substeps, n_left)
                    n_left -= n_substeps
                simulator.step(targets, n_substeps)
                state, before = simulator.state(), corners
                corners, is_at_top = _corners(state), bool(targets[2] == top)
                if not np.linalg.norm(_in_hand(state)) <= self.out_of_reach:
                    return False
                if is_at_top and not n_left:
                    break
                if self.verdict == "full":
                    continue
                compressed = (look - n_shaken) * self.look_every
                if compressed >= 0:
                    simulator.set_creep(self.creep)
                furthest = float(np.linalg.norm(corners - before, axis=1).max())
                speed = furthest / self.look_every
                if compressed > 0 and self._settles(
                    state, speed, compressed, is_at_top
                ):
                    break
        finally:
            simulator.set_creep(1.0)
        return True

    def _settles(
        self, state: State, speed: float, compressed: float, is_at_top: bool
    ) -> bool:
        """Return True if the test may end early with success, after `compressed` s of it.

        The object, which moves in the hand at `speed`, m/s, is at rest, or still in the hand at the top
        when time is up.
        """
        whole = (self.seconds + self.height / RAISE_SPEED) / self.creep
        left = max(0.0, whole - compressed)
        is_at_rest = speed * (left + self.look_every) < self.settle_distance
        return bool(is_at_rest and state.clearance > CLEARANCE) or (
            is_at_top and left == 0
        )


def _in_hand(state: State) -> Array:
    """Return the object's position relative to the palm (3,), m."""
    return state.object_position - state.palm


def _corners(state: State) -> Array:
    """Return corners (8, 3) of the object's bounding box relative to the palm, m; they show turns."""
    return _in_hand(state) + CORNERS * state.shape.half_size @ state.object_rotation.T
