"""The right hand of the Modular Prosthetic Limb, made of primitives.

mpl.toml holds the figures: bodies, joints, masses and inertias of the public model, and
capsules fitted to its meshes (NOTICE says where they are from). The palm's frame: fingers
along -y, palmar side -z, thumb at +x; identity orientation is palm down. Body 0 of a digit is
its knuckle, 1 to 3 are the phalanges.

Fingers follow closing trajectories with one parameter, 0 open and 1 closed; thumb and little
finger share theirs (paper, PyBullet set-up).
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from . import DIGITS, SEGMENTS, SLIDES, ClosingAction, Hand, Pitch, ScriptedGrasp, Surface, figures
from .servos import add_servo, add_slides

FIGURES = figures.read(Path(__file__).with_name("mpl.toml"))
JOINTS = figures.joints(FIGURES)
FINGERS = DIGITS[1:]
GROUPS = (("thumb", "little"), ("index",), ("middle",), ("ring",))
GROUP_NAMES = tuple("closing of " + " and ".join(group) for group in GROUPS)
# Joint angles at the open and the closed end of the trajectories, rad; other joints stay at 0.
THUMB_CLOSING = {"ABD": (0.6, 1.95), "MCP": (0.0, 0.67), "PIP": (0.0, 0.73), "DIP": (0.0, 0.68)}
FINGER_CLOSING = {"MCP": (0.0, 1.57), "PIP": (0.0, 1.0), "DIP": (0.0, 0.88)}
# Distance from a joint to its fingertip, m: the joint's torque limit is that times a force.
LEVERS = {
    "thumb": {"ABD": 0.095, "MCP": 0.09, "PIP": 0.056, "DIP": 0.023},
    "little": {"ABD": 0.07, "MCP": 0.068, "PIP": 0.035, "DIP": 0.018},
}
OTHER_LEVERS = {"ABD": 0.09, "MCP": 0.086, "PIP": 0.043, "DIP": 0.018}
FINGER_FORCE = 8.0  # N
# The source's joint defaults but for the damping, 0.2 there: fingers that fast fling the object away.
FINGER_GAIN, FINGER_DAMPING, FINGER_ARMATURE = 10.0, 0.5, 0.01

# Boxes of the palm: (centre, half size), m.
PALM_BOXES = (
    ((-0.0215, -0.0395, 0.0003), (0.0385, 0.0345, 0.0229)),
    ((-0.011, -0.079, 0.0033), (0.028, 0.008, 0.0165)),
)
# At the bases of the fingers, on the palmar face of the first box.
PALM_TAXELS = {
    finger: (x, y, PALM_BOXES[0][0][2] - PALM_BOXES[0][1][2])
    for finger, (x, y) in zip(
        FINGERS,
        ((0.0099, -0.066), (-0.0128, -0.068), (-0.0355, -0.066), (-0.0562, -0.055)),
        strict=True,
    )
}
PALM_POINT = (-0.0215, -0.0395, -0.0226)  # middle of the palmar face

# The palm's frame where the hand starts, m (world; the object rests at the origin).
START = (0.0, 0.069, 0.100)
# How far each group is closed there; the thumb would reach into the ground if it were closed more.
START_CLOSING = (0.2, 0.4, 0.4, 0.4)
# Of an action of 1: m along x, y, z, and a share of the closing trajectory. Sideways the hand need
# not go far; up and closing, a small step is undone by the next before anything is lifted.
SLIDE_STEP, CLOSING_STEP = (0.01, 0.01, 0.2), 1.0
SLIDE_LIMITS = ((-0.02, 0.02), (-0.02, 0.02), (-0.03, 0.06))
SLIDE_GAIN, SLIDE_DAMPING, SLIDE_FORCE = 1000.0, 79.0, 100.0  # N/m, N s/m, N


def build(visual: bool = False, finger_gain: float = 1.0) -> mujoco.MjSpec:
    """The hand alone as an editable model; `visual` changes nothing, its shapes are its looks.

    `finger_gain` multiplies the position gain and torque limit of the finger actuators. Links of
    the hand do not touch each other, as in the paper's simulator.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = "mpl"
    palm = figures.add_bodies(spec, FIGURES, FINGER_DAMPING, FINGER_ARMATURE)
    palm.pos = START
    add_slides(spec, palm, np.eye(3).tolist(), SLIDE_GAIN, SLIDE_DAMPING, SLIDE_FORCE)
    for centre, half_size in PALM_BOXES:
        palm.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half_size, **figures.LOOKS)
    for joint in JOINTS:
        limit = FINGER_FORCE * _lever(joint)
        add_servo(spec, joint, FINGER_GAIN * finger_gain, limit * finger_gain)
    return spec


def _lever(joint: str) -> float:
    digit, _, kind = joint.partition("_")
    return LEVERS.get(digit, OTHER_LEVERS)[kind]


def _trajectory(end: int) -> dict[str, float]:
    """Joint angles at the open (0) or closed (1) end."""
    return {
        f"{digit}_{kind}": ends[end]
        for digit in DIGITS
        for kind, ends in (THUMB_CLOSING if digit == "thumb" else FINGER_CLOSING).items()
    }


def _action() -> ClosingAction:
    actuators = (*SLIDES, *JOINTS)
    opened, closed = _trajectory(0), _trajectory(1)
    digits = [name.partition("_")[0] if name in closed else "" for name in actuators]
    groups = tuple(np.flatnonzero(np.isin(digits, group)) for group in GROUPS)
    return ClosingAction(
        slide_step=np.array(SLIDE_STEP),
        slide_limits=np.array(SLIDE_LIMITS),
        closing_step=CLOSING_STEP,
        groups=groups,
        open=np.array([opened.get(name, 0.0) for name in actuators]),
        closed=np.array([closed.get(name, 0.0) for name in actuators]),
    )


DISTAL_SHIFT = {"distal": 0.0075}  # m towards the tip


def _surfaces() -> tuple[Surface, ...]:
    surfaces = figures.phalanges(FIGURES, DISTAL_SHIFT)
    for finger, centre in PALM_TAXELS.items():
        surfaces.append(Surface(finger, "palm", "palm", centre, (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)))
    return tuple(surfaces)


def _grasp(size: float, palm: tuple[float, float, float], closing: float) -> ScriptedGrasp:
    """Every finger closed to `closing`, the palm's frame at `palm`, m."""
    targets = {s: p - q for s, p, q in zip(SLIDES, palm, START, strict=True)}
    opened, closed = _trajectory(0), _trajectory(1)
    targets |= {joint: opened[joint] + closing * (closed[joint] - opened[joint]) for joint in closed}
    return ScriptedGrasp(size, targets)


GRASPS = (
    _grasp(0.05, (-0.005, 0.069, 0.102), 0.8),
    _grasp(0.045, (0.009, 0.072, 0.089), 0.7),
)


def hand() -> Hand:
    """The MPL hand with 3 slides, 19 hinges and 7 actions (paper, PyBullet set-up)."""
    names = (*SLIDES, *JOINTS)
    action = _action()
    start = action.open.copy()
    for group, closing in zip(action.groups, START_CLOSING, strict=True):
        start[group] += closing * (action.closed - action.open)[group]
    return figures.hand(
        "mpl",
        FIGURES,
        build=build,
        palm_point=PALM_POINT,
        surfaces=_surfaces(),
        pitch=Pitch(
            rows=dict.fromkeys(SEGMENTS, 4.5e-3), column=6.5e-3, radius=2e-3, large_radius=3.8e-3
        ),
        action_map=action,
        action_names=(*SLIDES, *GROUP_NAMES),
        first_joints=tuple(f"{digit}_{'ABD' if digit == 'thumb' else 'MCP'}" for digit in DIGITS),
        start={name: value for name, value in zip(names, start, strict=True) if value},
        observation=("object_id", "hand_position", "object_position", "finger_joints"),
        added_inertia=1e-3,
        grasps=GRASPS,
        opened=_trajectory(0),
        closed=_trajectory(1),
        groups=tuple(tuple(names[i] for i in group) for group in action.groups),
        group_names=GROUP_NAMES,
        handed_beside=("ring", "little"),
    )
