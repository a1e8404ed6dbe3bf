"""A hand from a file: a model, and in TOML what it means (docs/guides/own_hand.md).

The model says what moves and what collides; the file says where the palm is and which links are
whose. Everything else has a default that follows from both.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from .. import validation
from ..state import Array
from ..validation import interval, number, only, require_one_of, strings, table, vector
from . import checks, models, mounting, sensors, surfaces
from .files import KEPT, short_digest
from .hand import CLOSING_STEP, SLIDES, Hand, LinearAction, ScriptedGrasp, Surface
from .mounting import Mount
from .parts import Parts, placed, posed
from .skins import stand_off

KEYS = {
    "model", "root", "drop", "masses", "contacts", "palm", "palmar", "fingers", "palm_point",
    "palm_is_flat", "added_inertia", "observation", "first_joints", "handed_beside", "environment",
    "scene", "place", "slides", "servos", "ranges", "passive", "digits", "pitch", "couplings", "start",
    "start_closing", "opened", "closed", "actions", "grasp",
}  # fmt: skip
OBSERVATION = (
    "joint_positions",
    "joint_velocities",
    "object_position",
    "object_orientation",
)
HALF_RANGE = (
    0.03,
    0.03,
    0.20,
)  # m, how far actions of 1 move the slides from their centre
SLIDE_STEP = (0.01, 0.01, 0.2)  # m, of actions that are increments
SLIDE_LIMITS = (
    (-0.02, 0.02),
    (-0.02, 0.02),
    (-0.03, 0.06),
)  # m, around the grasping height
CLEAR, STEP, HIGHEST = (
    0.008,
    0.002,
    0.5,
)  # m: around the hand at the start; of the search for it
FARTHEST = 1.0  # m of anything from the palm or the object
NANO = 9  # decimals of m that count of a place
FINGERS = (
    0.045  # m: how much more than an object is between the tips that it fits between
)
STANDS_OFF = 5e-3  # m, of a convex hull from its mesh: worth a note
TIMESTEP = 0.004  # s, of scenes that say nothing else


def load(path: Path) -> Hand:
    """Return the hand of a file; ValueError naming what is wrong with it or its model,
    FileNotFoundError, and ImportError where the model's package is not installed."""
    data = validation.read(path, "hand file")
    only(data, KEYS, "the file")
    parts = Parts(data, path.parent)
    hand = _hand(parts, path)
    if parts.is_own:
        timestep = table(data, "scene").get("timestep", TIMESTEP)
        timestep = number(timestep, "scene.timestep", 1e-5, 1.0)
        with models.quiet():
            notes = checks.examine(hand, parts, timestep)
            hand = replace(hand, notes=hand.notes + notes)
    return hand


def _hand(parts: Parts, path: Path) -> Hand:
    data, sides = parts.data, surfaces.of(parts)
    mount, at = _hung(parts)
    grasps = _grasps(parts, at, data.get("grasp", []))
    kept = () if grasps else _grasps(parts, at, _kept(path))
    actuators = (*SLIDES, *parts.driven.values())
    hand = Hand(
        name=path.stem,
        build=mount,
        joints=(*SLIDES, *parts.joints),
        actuators=actuators,
        actuated=(*SLIDES, *parts.driven),
        palm=mount.palm,
        palm_point=parts.palm_point,
        palmar=tuple(parts.palmar.tolist()),
        fingers=tuple(parts.fingers.tolist()),
        fingertips=tuple(
            (digit.links[-1], digit.tip) for digit in parts.digits.values()
        ),
        surfaces=sides,
        pitch=surfaces.pitch(parts, sides),
        action_map=_joint_action(parts, grasps, at),
        action_names=actuators,
        couplings=tuple(
            coupling for coupling in parts.follows if coupling.driver in parts.driven
        ),
        first_joints=_names(data, "first_joints", (), parts.joints),
        start={joint: angle for joint, angle in parts.start.items() if angle},
        observation=_names(data, "observation", OBSERVATION),
        added_inertia=number(
            data.get("added_inertia", Hand.added_inertia), "added_inertia", 0.0
        ),
        grasps=grasps or kept,
        opened={parts.driven[joint]: angle for joint, angle in parts.opened.items()},
        closed={parts.driven[joint]: angle for joint, angle in parts.closed.items()},
        groups=_groups(parts),
        notes=_notes(parts),
        finger_length=_finger_length(parts, sides),
        reach=_reach(parts),
        welded=parts.welded,
        sensors=sensors.of(parts) if parts.is_own else (),
        handed_beside=_names(data, "handed_beside", (), tuple(parts.digits)),
    )
    return _with_actions(data, hand)


def _notes(parts: Parts) -> tuple[str, ...]:
    """What became of the model's servos, and what its meshes count as."""
    found = []
    if parts.replaced:
        found.append(
            f"its actuators ({_some(parts.replaced)}) are not all position servos of different joints: "
            "the joints have the library's"
        )
    if parts.passive:
        found.append(f"joints without servos: {_some(parts.passive)}")
    links = [
        parts.palm_frame.link,
        *(link for digit in parts.digits.values() for link in digit.links),
    ]
    off = {link: stand_off(parts.model, parts.model.body(link).id) for link in links}
    wide = sorted(
        (link for link in off if off[link] > STANDS_OFF),
        key=off.__getitem__,
        reverse=True,
    )
    if wide:
        hulls = ", ".join(f"{link} {1e3 * off[link]:.0f} mm" for link in wide)
        found.append(
            f"what touches is the convex hull of a mesh, which stands off it: {hulls}"
        )
    return tuple(found)


def _some(names: tuple[str, ...]) -> str:
    return ", ".join(names[:4]) + (
        f" and {len(names) - 4} more" if len(names) > 4 else ""
    )


def _finger_length(parts: Parts, sides: tuple[Surface, ...]) -> float:
    """Of the longest digit: of its bones, where all its links are such, else from joint to joint, m."""
    data, found = posed(parts.model, parts.open_pose), []
    tips = dict(zip(parts.digits, parts.tips(parts.model, data), strict=True))
    for name, digit in parts.digits.items():
        spans = [
            side.span
            for side in sides
            if side.digit == name and side.segment != "palm" and side.bone
        ]
        joints = np.array([*(data.body(link).xpos for link in digit.links), tips[name]])
        steps = np.linalg.norm(np.diff(joints, axis=0), axis=1)
        whole = len(spans) == len(digit.links)
        found.append(
            sum(high - low for low, high, _ in spans) if whole else float(steps.sum())
        )
    return max(found)


def _reach(parts: Parts) -> float:
    """How far the fingertips get from the palm's point, open or closed, m; at least the usual, which
    is that of the library's hands."""
    found = [Hand.reach]
    for share in (0.0, 0.5, 1.0) if parts.is_own else ():
        data = posed(parts.model, parts.pose(share))
        point = placed(data, parts.palm_frame.link, parts.palm_point)
        found += np.linalg.norm(parts.tips(parts.model, data) - point, axis=1).tolist()
    return max(found)


def _names(
    data: dict[str, Any], key: str, usual: tuple[str, ...], known: tuple[str, ...] = ()
) -> tuple[str, ...]:
    """A list of the file, each of those that are known."""
    found = strings(data[key], key) if key in data else usual
    for name in found if known else ():
        require_one_of(known, name, key)
    return found


# -- where it hangs --------------------------------------------------------------------------


def _hung(parts: Parts) -> tuple[Mount, Array]:
    """The model's mount, and where a point of the palm hangs at the start, m."""
    place = table(parts.data, "place", {"of", "at"})
    of = np.array(parts.palm_point)
    if "of" in place:
        of = np.array(
            parts.palm_frame.point(
                vector(place["of"], 3, "place.of", -FARTHEST, FARTHEST)
            )
        )
    data = posed(parts.model, parts.start)
    root, palm = (data.xmat[body].reshape(3, 3) for body in (1, parts.palm))
    turn = mounting.turned(root.T @ palm, parts.palmar, parts.fingers)
    steps = root.T @ (data.xpos[parts.palm] - data.xpos[1]), root.T @ palm @ of
    is_turned = not np.allclose(
        turn, posed(parts.model, {}).xmat[1].reshape(3, 3), atol=1e-9
    )
    rotation = tuple(map(tuple, turn.tolist()))
    mount = replace(
        parts.mount, rotation=rotation, is_turned=is_turned, files=tuple(parts.files)
    )

    def at_place(at: Array) -> Mount:
        for step in steps:
            at = at - turn @ np.round(step, NANO)
        return replace(mount, position=tuple(at.tolist()))

    if "at" in place:
        at = np.array(vector(place["at"], 3, "place.at", -FARTHEST, FARTHEST))
    else:
        at = _above_the_object(parts, at_place(np.zeros(3)))
    return at_place(at), at


def _above_the_object(parts: Parts, mount: Mount) -> Array:
    """Where that point can be (3,), m: what closes around the object is above it, and as low as the
    hand is free of ground and object."""
    spec, room = mount(), Hand.start_clearance / 2
    plane, box = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(type=plane, size=[1, 1, 0.1])
    spec.worldbody.add_geom(type=box, size=[room] * 3, pos=[0, 0, room], margin=CLEAR)
    model = models.compiled(spec)
    middle = _middle(parts, model)
    at = -middle * [1.0, 1.0, 0.0]
    data = posed(model, parts.start)
    for height in np.arange(0.0, HIGHEST, STEP):
        data.qpos[:3] = [*at[:2], height]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon == 0:
            return np.round([*at[:2], height], 4)
    raise ValueError(
        f"place: found no height up to {HIGHEST:g} m at which the hand is free; give it: at = [x, y, z]"
    )


def _middle(parts: Parts, model: mujoco.MjModel) -> Array:
    """Between the fingertips (3,), m: of a hand with a thumb, between that and the others, closed as
    far as an object just fits in."""
    shares = (
        np.linspace(1.0, 0.0, 21)
        if "thumb" in parts.digits and len(parts.digits) > 2
        else [0.5]
    )
    for share in shares:
        tips = parts.tips(model, posed(model, parts.pose(float(share))))
        if len(shares) == 1:
            return np.asarray(tips.mean(axis=0))
        thumb = list(parts.digits).index("thumb")
        sides = tips[thumb], np.delete(tips, thumb, axis=0).mean(axis=0)
        if np.linalg.norm((sides[0] - sides[1])[:2]) > Hand.start_clearance + FINGERS:
            break
    return np.asarray((sides[0] + sides[1]) / 2)


# -- what it does ----------------------------------------------------------------------------


def _kept(path: Path) -> Any:
    """What a command has found for a file that has no grasp, and kept beside it."""
    kept = path.with_suffix(KEPT)
    if not kept.is_file():
        return []
    data = validation.read(kept, "grasp file")
    return data.get("grasp", []) if data.get("hand") == short_digest(path) else []


def _grasps(parts: Parts, at: Array, tables: Any) -> tuple[ScriptedGrasp, ...]:
    found = []
    if not isinstance(tables, list) or not all(isinstance(one, dict) for one in tables):
        raise ValueError(f"grasp: found {tables!r}, expected [[grasp]] tables")
    for count, about in enumerate(tables, 1):
        where = f"grasp {count}"
        only(about, {"object_size", "at", "slides", "joints", "closing"}, where)
        size = number(about.get("object_size"), f"{where}: object_size", 1e-3)
        if "at" in about:
            palm = vector(about["at"], 3, f"{where}: at")
            slides = tuple(p - q for p, q in zip(palm, at.tolist(), strict=True))
        else:
            slides = vector(about.get("slides"), 3, f"{where}: slides")
        angles = parts.angles(table(about, "joints"), f"{where}: joints")
        if "closing" in about:
            angles = parts.at(number(about["closing"], f"{where}: closing")) | angles
        targets = {
            parts.driven[j]: angle for j, angle in angles.items() if j in parts.driven
        }
        found.append(
            ScriptedGrasp(size, {**dict(zip(SLIDES, slides, strict=True)), **targets})
        )
    return tuple(found)


def _groups(parts: Parts) -> dict[str, tuple[str, ...]]:
    """Actuators that close together, by what that is called: those of each digit, or of several."""
    chosen = table(parts.data, "actions").get("groups") or [
        [digit] for digit in parts.digits
    ]
    if not isinstance(chosen, list):
        raise ValueError(
            f"actions.groups: found {chosen!r}, expected a list of lists of digits"
        )
    found: dict[str, tuple[str, ...]] = {}
    groups = [strings(group, "actions.groups") for group in chosen]
    strings([digit for group in groups for digit in group], "actions.groups")
    for group in groups:
        for digit in group:
            require_one_of(parts.digits, digit, "actions.groups")
        joints = [joint for digit in group for joint in parts.closing_of(digit)]
        members = [parts.driven[joint] for joint in joints]
        if members and not any(map(parts.way, joints)):
            found_no = "found none of its joints that [opened] and [closed] move"
            raise ValueError(f"digits.{group[0]}: {found_no}")
        if members:
            found["closing of " + " and ".join(group)] = tuple(members)
    return found


def _joint_action(
    parts: Parts, grasps: tuple[ScriptedGrasp, ...], at: Array
) -> LinearAction:
    """Every actuator over its range; action 0 of the slides is the grasping height."""
    slides, model = table(parts.data, "slides"), parts.model
    limits = np.array([model.joint(joint).range for joint in parts.driven])
    limited = model.actuator_ctrllimited.astype(bool)
    limits[limited] = model.actuator_ctrlrange[limited]
    height = grasps[-1].targets[SLIDES[2]] if grasps else min(0.0, 0.06 - float(at[2]))
    centre = vector(
        slides.get("centre", (0.0, 0.0, round(height, NANO))), 3, "slides.centre"
    )
    half_range = vector(
        slides.get("half_range", HALF_RANGE), 3, "slides.half_range", 0.0, 1.0
    )
    return LinearAction(
        centre=np.concatenate([centre, limits.mean(axis=1)]),
        half_range=np.concatenate([half_range, np.ptp(limits, axis=1) / 2]),
    )


def _with_actions(data: dict[str, Any], hand: Hand) -> Hand:
    """The hand with the actions that the file wants: of joints, or increments of slides and groups."""
    actions, slides = (
        table(data, "actions", {"kind", "step", "groups"}),
        table(data, "slides"),
    )
    require_one_of(
        ("joints", "closing"), kind := actions.get("kind", "joints"), "actions.kind"
    )
    if kind == "joints":
        return hand
    if not hand.groups:
        raise ValueError(
            "actions: kind closing needs the angles of the closed hand: [closed]"
        )
    limits = slides.get("limits", SLIDE_LIMITS)
    if not isinstance(limits, list | tuple) or len(limits) != 3:
        raise ValueError(f"slides.limits: found {limits!r}, expected three pairs")
    action = hand.closing(
        np.array(vector(slides.get("step", SLIDE_STEP), 3, "slides.step")),
        np.array([interval(pair, "slides.limits") for pair in limits]),
        number(actions.get("step", CLOSING_STEP), "actions.step", 0.0),
    )
    return replace(hand, action_map=action, action_names=(*SLIDES, *hand.groups))
