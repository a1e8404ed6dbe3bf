"""A hand from a file: a model, and in TOML what it means (docs/guides/own_hand.md).

The model says what moves and what collides; the file says where the palm is and which
links are whose. Everything else has a default that follows from both.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from .. import validation
from ..state import Array
from ..validation import require_one_of, require_rising, require_type
from . import checks, model_file, mount, surfaces
from .geometry import placed, posed
from .hand import (
    GRASP_SUFFIX,
    SLIDES,
    Hand,
    LinearAction,
    ScriptedGrasp,
    short_digest,
)
from .parts import Parts, require_distinct
from .tables import GraspTable, HandFile, Names

PALM_DOWN = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: where the palmar side, the fingers and their cross product point in the
world."""
CLEAR, STEP, HIGHEST = 0.008, 0.002, 0.5
"""m: around the hand at the start; of the search for it."""
NANO = 9  # decimals of m that count of a place
FINGERS = 0.045  # m: how much more than an object is between tips that it fits between
TIMESTEP = 0.004  # s, of scenes that say nothing else


def load(file: HandFile, path: Path) -> Hand:
    """Return the hand of a file that is at a path.

    Raise ValueError naming what is wrong with it or its model, FileNotFoundError, and
    ImportError where the model's package is not installed.
    """
    parts = Parts(file, path.parent)
    sides, (built, at) = surfaces.of(parts), _hung(parts)
    grasps, driven = _grasps(parts, at, file.grasp), parts.driven
    actuators = (*SLIDES, *driven.values())
    for name in file.first_joints:
        require_one_of(parts.joints, name, "first_joints")
    for name in file.handed_beside:
        require_one_of(parts.digits, name, "handed_beside")
    hand = Hand(
        name=path.stem,
        file=file,
        build=built,
        paths=model_file.files(parts.path, parts.raw),
        welded=parts.welded,
        notes=_notes(parts),
        joints=(*SLIDES, *parts.joints),
        actuators=actuators,
        actuated=(*SLIDES, *driven),
        couplings=tuple(each for each in parts.follows if each.driver in driven),
        opened={driven[joint]: angle for joint, angle in parts.opened.items()},
        closed={driven[joint]: angle for joint, angle in parts.closed.items()},
        groups=_groups(parts),
        action_map=_joint_action(parts, grasps, at),
        action_names=actuators,
        palm=parts.palm_frame.link,
        palm_point=parts.palm_point,
        fingertips=tuple((each.links[-1], each.tip) for each in parts.digits.values()),
        surfaces=sides,
        pitch=surfaces.pitch(parts, sides),
        sensors=surfaces.sensors(parts),
        reach=_reach(parts),
        start={joint: angle for joint, angle in parts.start.items() if angle},
        grasps=grasps or _grasps(parts, at, _kept(path)),
    )
    if file.actions.kind == "closing":
        hand = _closing(hand)
    if not parts.is_own:
        return hand
    timestep = file.scene.get("timestep", TIMESTEP)
    require_type(timestep, checks.Timestep, "scene.timestep")
    return replace(hand, notes=hand.notes + checks.examine(hand, parts, timestep))


def _notes(parts: Parts) -> tuple[str, ...]:
    """Say what was put into the model."""
    notes = {
        "joints have the library's servos, as these are no position servos, or on joints that have "
        "one: ": parts.misfits,
        "joints without servos: ": parts.passive,
        "joints without a range, which have one of ±1.57 rad or ±0.05 m until [ranges] gives them "
        "another: ": [
            joint.name
            for joint in parts.raw.joints
            if mount.is_unranged(joint)
            and not mount.is_unranged(parts.spec.joint(joint.name))
        ],
    }
    return tuple(text + ", ".join(names) for text, names in notes.items() if names)


def _reach(parts: Parts) -> float:
    """Return how far the fingertips get from the palm's point, open or closed, m.

    It is at least the usual, which is that of the library's hands.
    """
    away = [Hand.reach]
    for share in (0.0, 0.5, 1.0) if parts.is_own else ():
        data = posed(parts.model, parts.pose(share))
        point = placed(data, parts.palm_frame.link, parts.palm_point)
        away += np.linalg.norm(parts.tips(data) - point, axis=1).tolist()
    return max(away)


# -- where it hangs --------------------------------------------------------------------------


def _build(
    parts: Parts, position: Array, rotation: Array, visual: bool = False, finger_gain: float = 1.0
) -> mujoco.MjSpec:  # fmt: skip
    """Return the hand alone as it hangs palm down on three slides (`Hand.build`).

    `position` (3,), m, and `rotation` (3, 3) are those of the model's root body.
    """
    spec, slides = parts.bare(visual), parts.file.slides
    root = spec.worldbody.first_body()
    root.pos = position
    unmoved = posed(parts.model, {}).xmat[1].reshape(3, 3)
    if not np.allclose(rotation, unmoved, atol=1e-9):
        root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        turn = Rotation.from_matrix(rotation).as_rotvec()
        angle = float(np.linalg.norm(turn))
        axis = np.round(turn / max(angle, 1e-9), 12)
        root.quat = [np.cos(angle / 2), *(np.sin(angle / 2) * axis)]
    usual = model_file.EMPTY_SPEC.default
    for name, axis in zip(SLIDES, rotation, strict=True):
        slide = root.add_joint(usual, name=name, type=mount.LINEAR, axis=axis)
        slide.damping[0] = slides.damping
        mount.add_servo(spec, name, slides.gain, slides.force)
    carrying = mount.chain(spec.body(parts.palm_frame.link))
    for actuator in spec.actuators:
        moved = spec.joint(next(iter(mount.arms(spec, actuator)))).parent.name
        if moved not in carrying:  # it moves a finger, and not the palm
            actuator.gainprm *= finger_gain
            actuator.biasprm *= finger_gain
            actuator.forcerange *= finger_gain
    return spec


def _hung(parts: Parts) -> tuple[Callable[..., mujoco.MjSpec], Array]:
    """Return what builds the hand, and where a point of the palm is at the start (3,), m."""
    place = parts.file.place
    of = parts.palm_point if place.of is None else parts.palm_frame.point(place.of)
    data = posed(parts.model, parts.start)
    root, palm = (data.xmat[body].reshape(3, 3) for body in (1, parts.palm))
    axes = parts.palmar, parts.fingers, np.cross(parts.palmar, parts.fingers)
    turn = np.round(PALM_DOWN @ np.array(axes) @ (root.T @ palm).T, 12) + 0.0
    to_palm = turn @ np.round(root.T @ (data.xpos[parts.palm] - data.xpos[1]), NANO)
    to_point = turn @ np.round(root.T @ palm @ np.array(of), NANO)
    at = np.array(place.at or ())
    if place.at is None:
        at = _above_the_object(parts, _build(parts, -to_palm - to_point, turn))
    return partial(_build, parts, at - to_palm - to_point, turn), at


def _above_the_object(parts: Parts, spec: mujoco.MjSpec) -> Array:
    """Return where a point of the palm can be at the start (3,), m.

    What closes around the object is above it, and as low as the hand is free of ground
    and object.
    """
    room = Hand.start_clearance / 2
    plane, box = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX
    around, usual = spec.worldbody, model_file.EMPTY_SPEC.default
    around.add_geom(usual, type=plane, size=[1, 1, 0.1])
    around.add_geom(usual, type=box, size=[room] * 3, pos=[0, 0, room], margin=CLEAR)
    model = model_file.compiled(spec)
    at = -_middle(parts, model) * [1.0, 1.0, 0.0]
    data = posed(model, parts.start)
    for height in np.arange(0.0, HIGHEST, STEP):
        data.qpos[: len(SLIDES)] = [*at[:2], height]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon == 0:
            return np.round([*at[:2], height], 4)
    raise ValueError(
        f"place: found no height up to {HIGHEST:g} m at which the hand is free; give it: at = [x, y, z]"
    )


def _middle(parts: Parts, model: mujoco.MjModel) -> Array:
    """Return the middle between the fingertips (3,), m.

    Of a hand with a thumb it is between that and the others, closed as far as an object
    just fits in.
    """
    if "thumb" not in parts.digits or len(parts.digits) <= 2:
        half = posed(model, parts.pose(0.5))
        return np.asarray(parts.tips(half).mean(axis=0))
    thumb = list(parts.digits).index("thumb")
    for share in np.linspace(1.0, 0.0, 21):
        tips = parts.tips(posed(model, parts.pose(float(share))))
        others = np.delete(tips, thumb, axis=0).mean(axis=0)
        width = np.linalg.norm((tips[thumb] - others)[:2])
        if width > Hand.start_clearance + FINGERS:
            break
    return np.asarray((tips[thumb] + others) / 2)


# -- what it does ----------------------------------------------------------------------------


def _kept(path: Path) -> tuple[GraspTable, ...]:
    """Return what a command has found for a file that has no grasp, and kept beside it."""
    kept = path.with_suffix(GRASP_SUFFIX)
    data = validation.read(kept, "grasp file") if kept.is_file() else {}
    if data.get("hand") != short_digest(path):
        return ()
    return tuple(
        validation.fill(GraspTable, each, "grasp") for each in data.get("grasp", ())
    )


def _grasps(
    parts: Parts, at: Array, tables: tuple[GraspTable, ...]
) -> tuple[ScriptedGrasp, ...]:
    grasps = []
    for number, grasp in enumerate(tables, 1):
        where, slides = f"grasp {number}", grasp.slides
        if grasp.at is not None:
            slides = tuple((np.array(grasp.at) - at).tolist())
        if slides is None or grasp.object_size < 1e-3:
            raise ValueError(f"{where}: needs at or slides, and object_size in m")
        angles = parts.angles(grasp.joints, f"{where}: joints")
        if grasp.closing is not None:
            angles = parts.at(grasp.closing) | angles
        targets = dict(zip(SLIDES, slides, strict=True))
        targets |= {parts.driven[j]: a for j, a in angles.items() if j in parts.driven}
        grasps.append(ScriptedGrasp(grasp.object_size, targets))
    return tuple(grasps)


def _groups(parts: Parts) -> dict[str, Names]:
    """Return the actuators that close together, by what that is called.

    They are those of each digit, or of several.
    """
    groups = parts.file.actions.groups or tuple((digit,) for digit in parts.digits)
    require_distinct(tuple(itertools.chain(*groups)), "actions.groups")
    actuators: dict[str, Names] = {}
    for group in groups:
        for digit in group:
            require_one_of(parts.digits, digit, "actions.groups")
        joints = [joint for digit in group for joint in parts.closing_of(digit)]
        if joints and not any(map(parts.way, joints)):
            raise ValueError(
                f"digits.{group[0]}: found none of its joints that [opened] and [closed] move"
            )
        if joints:
            label = "closing of " + " and ".join(group)
            actuators[label] = tuple(parts.driven[joint] for joint in joints)
    return actuators


def _joint_action(
    parts: Parts, grasps: tuple[ScriptedGrasp, ...], at: Array
) -> LinearAction:
    """Return every actuator over its range; action 0 of the slides is the grasping height."""
    slides, model = parts.file.slides, parts.model
    limits = np.array([model.joint(joint).range for joint in parts.driven])
    limited = model.actuator_ctrllimited.astype(bool)
    limits[limited] = model.actuator_ctrlrange[limited]
    height = grasps[-1].targets[SLIDES[2]] if grasps else min(0.0, 0.06 - float(at[2]))
    centre = slides.centre or (0.0, 0.0, round(height, NANO))
    return LinearAction(
        centre=np.concatenate([centre, limits.mean(axis=1)]),
        half_range=np.concatenate([slides.half_range, np.ptp(limits, axis=1) / 2]),
    )


def _closing(hand: Hand) -> Hand:
    """Return the hand with actions that are increments of slides and groups."""
    file, slides = hand.file, hand.file.slides
    if not hand.groups:
        raise ValueError(
            "actions: kind closing needs the angles of the closed hand: [closed]"
        )
    for limits in slides.limits:
        require_rising(limits, "slides.limits")
    action = hand.closing(
        np.array(slides.step), np.array(slides.limits), file.actions.step
    )
    return replace(hand, action_map=action, action_names=(*SLIDES, *hand.groups))
