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
from itertools import product
from typing import Literal

import numpy as np

from .hands import Array
from .snapshot import Snapshot

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


class Hold:
    """A hold test under way, from one look at the object to the next; it begins with the joint targets
    of now, but for the slide that rises.

    Whoever runs it takes `n_substeps` timesteps towards `targets` while what sticks creeps `creep`
    times as fast as usual, then calls `advance`, until there is a verdict.
    """

    def __init__(self, test: HoldTest, now: Snapshot, timestep: float) -> None:
        self.test, self.targets, self.creep = test, now.targets.copy(), 1.0
        # From where the slide is, not from its target: the hand may lag far behind that.
        self.targets[2] = now.joint_positions[2]
        self._top = self.targets[2] + test.height - now.hand[2]
        times = (test.look_every, test.seconds)
        self._every, self._left = (max(1, round(seconds / timestep)) for seconds in times)
        self._way = RAISE_SPEED * timestep * self._every
        self._n_looks, self._corners = 0, _corners(now)
        self._plan()

    @property
    def is_at_top(self) -> bool:
        """Is the hand to rise no further?"""
        return bool(self.targets[2] == self._top)

    def advance(self, now: Snapshot) -> tuple[Array, bool | None]:
        """Targets (n_actuators,) of the next steps, and whether the object stays in the hand: None as
        long as that is open. `now` is what the last steps led to."""
        self._n_looks += 1
        if not np.linalg.norm(_in_hand(now)) <= OUT_OF_REACH:
            return self.targets, False
        is_over = self.is_at_top and not self._left
        if is_over or (self.test.verdict == "settled" and self._settles(now)):
            return self.targets, True
        self._plan()
        return self.targets, None

    def _plan(self) -> None:
        """What comes next: the palm does not turn, but rise and stay."""
        self.n_substeps = self._every
        if not self.is_at_top:
            self.targets[2] += np.clip(self._top - self.targets[2], -self._way, self._way)
            return
        self.n_substeps = min(self._every, self._left)
        self._left -= self.n_substeps

    def _settles(self, now: Snapshot) -> bool:
        """The early verdict: at rest, or still in the hand when time is up and it is at the top."""
        test, before = self.test, self._corners
        self._corners = _corners(now)
        compressed = (self._n_looks - round(test.shake_seconds / test.look_every)) * test.look_every
        if compressed >= 0:
            self.creep = test.creep
        if compressed <= 0:
            return False
        left = max(0.0, (test.seconds + test.height / RAISE_SPEED) / test.creep - compressed)
        speed = np.linalg.norm(self._corners - before, axis=1).max() / test.look_every
        is_at_rest = speed * (left + test.look_every) < test.settle_distance
        return bool(is_at_rest and now.clearance > CLEAR) or (self.is_at_top and left == 0)


def _in_hand(now: Snapshot) -> Array:
    """The object's position relative to the palm (3,), m."""
    return now.object.position - now.hand


def _corners(now: Snapshot) -> Array:
    """Of the object's bounding box relative to the palm (8, 3), m: they show turns."""
    return _in_hand(now) + CORNERS * now.shape.half_size @ now.object.rotation.T
