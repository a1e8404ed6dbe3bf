"""The right Allegro Hand, four fingers with four joints each, made of primitives.

allegro.toml holds the figures: frames, axes and ranges of the public model, and capsules that stand
for its boxes (NOTICE says where they are from). The palm's frame: fingers along z, palmar side x, thumb
towards y. Body 0 of a digit is its base, 1 to 3 are the phalanges.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from . import SEGMENTS, SLIDES, Hand, LinearAction, Pitch, ScriptedGrasp, Surface, figures
from .servos import add_servo, add_slides

FIGURES = figures.read(Path(__file__).with_name("allegro.toml"))
JOINTS = figures.joints(FIGURES)
FINGERS = ("index", "middle", "ring")
DENSITY = 800.0  # kg/m³, the source's
# The source's gain; its damping, halved, follows a target within one action.
FINGER_GAIN, FINGER_DAMPING, FINGER_ARMATURE = 10.0, 0.5, 0.01
FINGER_TORQUE = 0.7  # N m

PALM_BOX = ((-0.0093, 0.0, -0.0475), (0.0204, 0.0565, 0.0475))  # centre, half size, m
PALM_FACE = PALM_BOX[0][0] + PALM_BOX[1][0]
PALM_POINT = (PALM_FACE, 0.0, -0.0475)
# At the bases of the fingers, on the palmar face.
PALM_TAXELS = {"index": 0.0435, "middle": 0.0, "ring": -0.0435}
BELOW_BASES = 0.012  # m

# The palm's frame where the hand starts, m (world; the object rests at the origin).
START = (-0.02, 0.035, 0.135)
START_CLOSING = {"1": 0.3, "2": 0.5, "3": 0.4}  # rad, of the fingers
START_THUMB = {"0": 1.2, "1": 0.2, "2": 0.2, "3": 0.2}
# Action 0 is the grasping height, as for the Shadow Hand.
SLIDE_CENTRE = (0.0, 0.0, -0.063)
SLIDE_HALF_RANGE = (0.03, 0.03, 0.20)
SLIDE_GAIN, SLIDE_DAMPING, SLIDE_FORCE = 1000.0, 79.0, 30.0  # N/m, N s/m, N


def build(visual: bool = False, finger_gain: float = 1.0) -> mujoco.MjSpec:
    """The hand alone as an editable model; `visual` changes nothing, its shapes are its looks.

    `finger_gain` multiplies the position gain and torque limit of the finger actuators. Links of
    the hand do not touch each other.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = "allegro"
    palm = figures.add_bodies(spec, FIGURES, FINGER_DAMPING, FINGER_ARMATURE, DENSITY)
    palm.pos = START
    axes = ([0, 1, 0], [0, 0, -1], [-1, 0, 0])  # of the world, in the palm's frame
    add_slides(spec, palm, axes, SLIDE_GAIN, SLIDE_DAMPING, SLIDE_FORCE)
    centre, half_size = PALM_BOX
    box = mujoco.mjtGeom.mjGEOM_BOX
    palm.add_geom(type=box, pos=centre, size=half_size, density=DENSITY, **figures.LOOKS)
    for joint in JOINTS:
        add_servo(spec, joint, FINGER_GAIN * finger_gain, FINGER_TORQUE * finger_gain)
    return spec


DISTAL_SHIFT = {"distal": 0.0075}  # m towards the tip


def _surfaces() -> tuple[Surface, ...]:
    palm = [
        Surface(finger, "palm", "palm", (PALM_FACE, y, -BELOW_BASES), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
        for finger, y in PALM_TAXELS.items()
    ]
    return (*figures.phalanges(FIGURES, DISTAL_SHIFT), *palm)


def _start() -> dict[str, float]:
    fingers = {f"{f}_{j}": angle for f in FINGERS for j, angle in START_CLOSING.items()}
    return fingers | {f"thumb_{j}": angle for j, angle in START_THUMB.items()}


def _grasp(
    size: float, palm: tuple[float, ...], fingers: tuple[float, ...], thumb: tuple[float, ...]
) -> ScriptedGrasp:
    """A searched grasp: the palm's frame at `palm`, joints 1 to 3 of all fingers, all of the thumb."""
    targets = {s: p - q for s, p, q in zip(SLIDES, palm, START, strict=True)}
    for finger in FINGERS:
        targets |= {f"{finger}_{j}": angle for j, angle in enumerate(fingers, start=1)}
    targets |= {f"thumb_{j}": angle for j, angle in enumerate(thumb)}
    return ScriptedGrasp(size, targets)


# Found by a cross-entropy search over perturbed starts, apart from those the doctor uses.
GRASPS = (_grasp(0.05, (-0.031, 0.059, 0.072), (1.105, 0.665, 0.761), (1.334, 0.072, 0.845, 0.993)),)


# Fingers that close in groups go from straight, the thumb opposed, to a fist.
OPENED = {f"{f}_{j}": 0.0 for f in FINGERS for j in "123"} | {
    **{"thumb_0": 1.3, "thumb_1": 0.1, "thumb_2": 0.0, "thumb_3": 0.0}
}
CLOSED = {f"{f}_{j}": 1.5 for f in FINGERS for j in "123"} | {
    **{"thumb_0": 1.3, "thumb_1": 0.1, "thumb_2": 1.2, "thumb_3": 1.2}
}
DIGITS = ("thumb", *FINGERS)


def hand() -> Hand:
    """The Allegro Hand with 3 slides and 16 joints, each of which is an action."""
    ranges = np.array([body["range"] for body in FIGURES.values() if "joint" in body])
    return figures.hand(
        "allegro",
        FIGURES,
        build=build,
        palm_point=PALM_POINT,
        surfaces=_surfaces(),
        pitch=Pitch(
            rows=dict.fromkeys(SEGMENTS, 6e-3), column=6.5e-3, radius=2e-3, large_radius=3.8e-3
        ),
        action_map=LinearAction(
            centre=np.concatenate([SLIDE_CENTRE, ranges.mean(axis=1)]),
            half_range=np.concatenate([SLIDE_HALF_RANGE, np.ptp(ranges, axis=1) / 2]),
        ),
        action_names=(*SLIDES, *JOINTS),
        start=_start(),
        observation=(
            "joint_positions",
            "joint_velocities",
            "object_position",
            "object_orientation",
        ),
        grasps=GRASPS,
        opened=OPENED,
        closed=CLOSED,
        groups=tuple(tuple(name for name in CLOSED if name.startswith(digit)) for digit in DIGITS),
        group_names=tuple(f"closing of {digit}" for digit in DIGITS),
    )
