"""The hold test of lift-and-hold: raise the hand to 1 m and see whether the object stays.

"The hand is moved to a height of 1 meter and kept there for 5000 unrecorded simulation
steps" (paper, PyBullet set-up). Here that is a time, 5,000 timesteps of the hand's own
set-up, so that a smaller timestep makes no shorter test. A failure is called as soon as
it is certain: an object that is further from the palm than any finger reaches is in
free fall. A success is called at the end.

The verdict "settled" runs the same test with time compressed. What decides a long hold
is how far the object creeps, so creep is sped up (`Simulator.set_creep`), and a success
is called as soon as the object's movement would not take it far by the end. How often
that is wrong was measured: docs/concepts/tasks.md, "The hold test".
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

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
    """Factor by which "settled" speeds creep up and compresses time. What this and the
    next two cost is measured by ``python -m benchmarks hold_verdict``."""
    shake_seconds: float = 0.2
    """Time after which the jolt of setting off is over, s; "settled" speeds creep up
    from then on."""
    settle_distance: float = 2e-3
    """Distance, m, by which no point of an object at rest will move before the
    compressed test of "settled" ends, and for one look more."""

    def run(self, simulator: Simulator, state: State) -> bool:
        """Return True if the object stays in the hand, from this state on.

        Joint targets stay as they are, but for the slide that rises. Leaves the
        simulator wherever the test ended.
        """
        trial, targets = Trial(self, simulator.scene.timestep), state.targets.copy()
        trial.begin(state)
        is_over: Any = False
        try:
            while not is_over:
                simulator.set_creep(float(trial.creep))
                n_substeps = trial.rise()
                targets[2] = trial.slide
                simulator.step(targets, int(n_substeps))
                is_over, is_held = trial.judge(simulator.state())
        finally:
            simulator.set_creep(1.0)
        return bool(is_held)


class Trial:
    """A hold test on its way, or one in each of many scenes: its arrays then have a leading axis."""

    slide: Any = np.nan
    """Target of the slide that rises, m."""
    _top: Any = np.nan
    _n_looks: Any = 0
    _n_left: Any = 0  # timesteps at the top
    _corners: Any = np.nan

    def __init__(self, test: HoldTest, timestep: float) -> None:
        """Take the test, and the physics step, s."""
        self._test = test
        self._n_substeps = max(1, round(test.look_every / timestep))
        self._n_at_top = max(1, round(test.seconds / timestep))
        self._furthest = RAISE_SPEED * timestep * self._n_substeps

    def begin(self, state: State) -> None:
        """Begin from where the slide is, not from its target: the hand may lag far behind that."""
        self.slide = state.joint_positions[..., 2]
        self._top = self.slide + self._test.height - state.palm[..., 2]
        self._n_looks, self._n_left, self._corners = 0, self._n_at_top, _corners(state)

    def rise(self) -> Array:
        """Set the slide's next target; return the number of timesteps to the next look."""
        is_rising = self.slide != self._top  # the palm does not turn, but rise and stay
        way = np.clip(self._top - self.slide, -self._furthest, self._furthest)
        n = np.where(
            is_rising, self._n_substeps, np.minimum(self._n_substeps, self._n_left)
        )
        self.slide = self.slide + way
        self._n_left = self._n_left - np.where(is_rising, 0, n)
        self._n_looks = self._n_looks + 1
        return n

    def judge(self, state: State) -> tuple[Array, Array]:
        """Look at the object; return whether the test is over, and whether the object was held."""
        test, in_hand = self._test, state.object_position - state.palm
        is_lost = ~(np.linalg.norm(in_hand, axis=-1) <= test.out_of_reach)
        is_at_top = self.slide == self._top
        is_held = is_at_top & (self._n_left == 0)
        if test.verdict == "settled":
            before, self._corners = self._corners, _corners(state)
            speed = (
                np.linalg.norm(self._corners - before, axis=-1).max(-1)
                / test.look_every
            )
            whole = (test.seconds + test.height / RAISE_SPEED) / test.creep
            left = np.maximum(0.0, whole - self._compressed)
            # It moves so little in the hand that it will not get far, or time is up.
            is_at_rest = speed * (left + test.look_every) < test.settle_distance
            is_at_rest = is_at_rest & (state.clearance > CLEARANCE)
            is_held = is_held | (self._compressed > 0) & (
                is_at_rest | is_at_top & (left == 0)
            )
        return is_lost | is_held, is_held & ~is_lost

    @property
    def creep(self) -> Array:
        """Factor by which creep is sped up now."""
        is_fast = (self._test.verdict == "settled") & (self._compressed >= 0)
        return np.where(is_fast, self._test.creep, 1.0)

    @property
    def _compressed(self) -> Any:
        """Time since creep was sped up, s."""
        test = self._test
        return (
            self._n_looks - round(test.shake_seconds / test.look_every)
        ) * test.look_every


def _corners(state: State) -> Array:
    """Return corners (..., 8, 3) of the object's bounding box relative to the palm, m."""
    axes = (
        state.object_rotation * np.stack(state.shape.half_size, axis=-1)[..., None, :]
    )
    corners = axes.reshape(-1, 3) @ CORNERS.T
    corners = corners.reshape(*axes.shape[:-1], 8).swapaxes(-1, -2)
    return (state.object_position - state.palm)[..., None, :] + corners
