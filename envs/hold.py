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

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from .hands import Array
from .objects import Shape
from .simulators import Simulator

Verdict = Literal["full", "settled"]
RAISE_SPEED = 0.3  # m/s
OUT_OF_REACH = 0.25  # m from the palm; the longest finger reaches 0.15 m
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
CLEAR = 0.01  # m under the object: nothing but the hand holds it
LOOK_STEPS = 25  # of the set-up's own timestep, whatever timestep it is run with


@dataclass(frozen=True)
class HoldTest:
    """Parameters of a hold test; times are rounded to whole timesteps, at least one."""

    seconds: float
    """Time at the top, s."""
    look_every: float
    """Time between looks at the object, s."""
    shape: Shape
    """The object's."""
    verdict: Verdict = "full"
    height: float = 1.0
    """Height of the palm, m."""
    creep: float = 20.0
    """"settled": by how much creep is sped up and time compressed. What this and the next two cost
    is measured by ``python -m benchmarks hold_verdict --early creep=40`` and so on."""
    shake_seconds: float = 0.2
    """"settled": the jolt of setting off is over after this time, and creep is sped up from then
    on, s."""
    settle_distance: float = 2e-3
    """"settled": the object is at rest when no point of it will move by more than this, m, before
    the compressed test ends and for one look more."""

    def run(self, simulator: Simulator, joint_targets: Array, timestep: float) -> bool:
        """Does the object stay in the hand? Leaves the simulator wherever the test ended."""
        looks = self.positions(simulator, joint_targets, timestep)
        if self.verdict == "full":
            return all(_is_in_reach(position) for _, position in looks)
        try:
            return self._settles(simulator, looks)
        finally:
            simulator.set_creep(1.0)

    def _settles(self, simulator: Simulator, looks: Iterator[tuple[bool, Array]]) -> bool:
        """The early verdict: at rest, or still in the hand when time is up and it is at the top."""
        corners = self._corners_in_hand(simulator)
        n_shaken = round(self.shake_seconds / self.look_every)
        for n_looks, (is_at_top, position) in enumerate(looks, start=1):
            if not _is_in_reach(position):
                return False
            before, corners = corners, self._corners_in_hand(simulator)
            compressed = (n_looks - n_shaken) * self.look_every
            if compressed > 0:
                left = self._time_left(compressed)
                speed = np.linalg.norm(corners - before, axis=1).max() / self.look_every
                is_at_rest = speed * (left + self.look_every) < self.settle_distance
                if (is_at_rest and self._is_clear(simulator)) or (is_at_top and left == 0):
                    return True
            if compressed >= 0:
                simulator.set_creep(self.creep)
        return True

    def _time_left(self, compressed: float) -> float:
        """Of a test that is `compressed` s in its compressed part, s."""
        whole = self.seconds + self.height / RAISE_SPEED
        return max(0.0, whole / self.creep - compressed)

    def positions(
        self, simulator: Simulator, joint_targets: Array, timestep: float
    ) -> Iterator[tuple[bool, Array]]:
        """Raise and hold; at every look whether the hand is at the top, and the object's position
        relative to the palm (3,), m. The palm does not turn meanwhile."""
        targets, every = joint_targets.copy(), _n_steps(self.look_every, timestep)
        # From where the slide is, not from its target: the hand may lag far behind that.
        targets[2] = simulator.joint_state()[0][2]
        top = targets[2] + self.height - simulator.link_positions()[0, 2]
        while targets[2] != top:
            way = RAISE_SPEED * timestep * every
            targets[2] += np.clip(top - targets[2], -way, way)
            simulator.step(targets, every)
            yield bool(targets[2] == top), _in_hand(simulator)
        n_steps = _n_steps(self.seconds, timestep)
        for done in range(0, n_steps, every):
            simulator.step(targets, min(every, n_steps - done))
            yield True, _in_hand(simulator)

    def _is_clear(self, simulator: Simulator) -> bool:
        """Is the object off the ground?"""
        obj = simulator.object_state()
        return bool(obj.position[2] - self.shape.half_height(obj.rotation) > CLEAR)

    def _corners_in_hand(self, simulator: Simulator) -> Array:
        """Corners of the object's bounding box relative to the palm (8, 3), m: they show turns."""
        rotation = simulator.object_state().rotation
        return _in_hand(simulator) + CORNERS * self.shape.half_size @ rotation.T


def _n_steps(seconds: float, timestep: float) -> int:
    return max(1, round(seconds / timestep))


def _is_in_reach(position: Array) -> bool:
    return bool(np.linalg.norm(position) <= OUT_OF_REACH)


def _in_hand(simulator: Simulator) -> Array:
    return simulator.object_state().position - simulator.link_positions()[0]
