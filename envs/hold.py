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
from typing import Literal, NamedTuple

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
        timestep, targets = simulator.scene.timestep, state.targets.copy()
        trial, is_over, is_held = self.begin(state, timestep), False, False
        try:
            while not is_over:
                simulator.set_creep(float(self.creep_in(trial)))
                trial, n_substeps = self.rise(trial, timestep)
                targets[2] = trial.slide
                simulator.step(targets, int(n_substeps))
                trial, is_over, is_held = self.judge(trial, simulator.state())
        finally:
            simulator.set_creep(1.0)
        return bool(is_held)

    def begin(self, state: State, timestep: float) -> Trial:
        """Return a test that begins in this state, or one in each of many.

        It starts from where the slide is, not from its target: the hand may lag far behind that.
        """
        slide = state.joint_positions[..., 2]
        top = slide + self.height - state.palm[..., 2]
        left = max(1, round(self.seconds / timestep)) + 0 * slide
        return Trial(slide, top, 0 * slide, left, _corners(state))

    def rise(self, trial: Trial, timestep: float) -> tuple[Trial, Array]:
        """Return the test with the slide's next target, and the number of timesteps to the next look."""
        n_substeps = max(1, round(self.look_every / timestep))
        furthest = RAISE_SPEED * timestep * n_substeps
        is_rising = (
            trial.slide != trial.top
        )  # the palm does not turn, but rise and stay
        slide = trial.slide + np.clip(trial.top - trial.slide, -furthest, furthest)
        n = np.where(is_rising, n_substeps, np.minimum(n_substeps, trial.left))
        left = np.where(is_rising, trial.left, trial.left - n)
        return trial._replace(slide=slide, look=trial.look + 1, left=left), n

    def judge(self, trial: Trial, state: State) -> tuple[Trial, Array, Array]:
        """Return the test after a look at the object, whether it is over, and whether it was held."""
        away, is_at_top = (
            np.linalg.norm(state.object_position - state.palm, axis=-1),
            trial.slide == trial.top,
        )
        is_lost = ~(away <= self.out_of_reach)
        is_held = is_at_top & (trial.left == 0)
        if self.verdict == "settled":
            corners, compressed = _corners(state), self._compressed(trial)
            speed = (
                np.linalg.norm(corners - trial.corners, axis=-1).max(-1)
                / self.look_every
            )
            trial = trial._replace(corners=corners)
            whole = (self.seconds + self.height / RAISE_SPEED) / self.creep
            left = np.maximum(0.0, whole - compressed)
            # In the hand it moves so little that it will not get far, or time is up.
            is_at_rest = speed * (left + self.look_every) < self.settle_distance
            is_at_rest &= state.clearance > CLEARANCE
            is_held |= (compressed > 0) & (is_at_rest | is_at_top & (left == 0))
        return trial, is_lost | is_held, is_held & ~is_lost

    def creep_in(self, trial: Trial) -> Array:
        """Return by which factor creep is sped up now."""
        is_fast = (self.verdict == "settled") & (self._compressed(trial) >= 0)
        return np.where(is_fast, self.creep, 1.0)

    def _compressed(self, trial: Trial) -> Array:
        """Return the time since creep was sped up, s."""
        return (
            trial.look - round(self.shake_seconds / self.look_every)
        ) * self.look_every


class Trial(NamedTuple):
    """A hold test on its way, or one in each of many scenes."""

    slide: Array
    """Target (...) of the slide that rises, m."""
    top: Array
    """Where it stays then (...), m."""
    look: Array
    """Number of looks at the object (...)."""
    left: Array
    """Number of timesteps left at the top (...)."""
    corners: Array
    """Corners (..., 8, 3) of the object's bounding box relative to the palm, m; they show turns."""


def _corners(state: State) -> Array:
    scaled = CORNERS * np.stack(state.shape.half_size, axis=-1)[..., None, :]
    in_hand = state.object_position - state.palm
    return in_hand[..., None, :] + scaled @ state.object_rotation.swapaxes(-1, -2)
