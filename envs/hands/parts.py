"""What a hand's file says of its model's parts: palm, digits, joint angles; checked, with defaults."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import filter as matching
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..state import Array
from ..validation import interval, number, only, require_one_of, strings, table, vector
from . import models, mounting, servos
from .files import FOLDER
from .hand import Coupling, Frame
from .mounting import Mount

SLACK = 1e-3  # rad or m that an angle may be beyond a joint's range
Angles = dict[str, float]
"""By joint, rad or m."""


class Digit(NamedTuple):
    """From knuckle to tip."""

    links: tuple[str, ...]
    tip: tuple[float, ...]
    """In the frame of the last link, m."""
    sides: tuple[Array | None, ...]
    """Palmar directions of the links, each in its frame, where the file has them."""


@dataclass
class Parts:
    """A hand's file, and what of its model it means; ValueError where one does not fit the other."""

    data: dict[str, Any]
    folder: Path

    # -- the model ---------------------------------------------------------------------------

    @property
    def is_own(self) -> bool:
        """Is it anybody's own hand? The library's are as they have always been."""
        return self.folder != FOLDER

    @cached_property
    def asked(self) -> Mount:
        """What the file says of the model."""
        data = self.data
        contacts = data.get("contacts", "others")
        require_one_of(("others", "model"), contacts, "contacts")
        slides = table(
            data, "slides", {*servos.SLIDE, "centre", "half_range", "step", "limits"}
        )
        figures = table(data, "servos", set(servos.SERVOS))
        for kind in figures:
            only(table(figures, kind), set(servos.SERVOS[kind]), f"servos.{kind}")
        return Mount(
            model=_model_file(data.get("model"), self.folder),
            palm=str(data.get("palm")),
            root=str(data.get("root", "")),
            fuses=self.is_own,
            drop=strings(data["drop"], "drop") if "drop" in data else (),
            masses=numbers(table(data, "masses"), "masses"),
            keeps_contacts=contacts == "model",
            slides=numbers(
                {k: slides.get(k, v) for k, v in servos.SLIDE.items()}, "slides"
            ),
            servos={k: numbers(figures[k], f"servos.{k}") for k in figures},
        )

    @cached_property
    def raw(self) -> mujoco.MjSpec:
        """The model before bodies become part of others, without what no hand can have."""
        spec = self.asked.unfused()
        for body in self.asked.masses:
            require_one_of([each.name for each in spec.bodies], body, "masses")
            if not spec.body(body).explicitinertial:
                raise ValueError(
                    f"masses: found {body!r}, allowed bodies whose model has an inertial"
                )
        for joint in spec.joints:
            of_body = f"a joint of body {joint.parent.name!r}"
            if joint.type not in (servos.HINGE, servos.LINEAR):
                kind = joint.type.name.removeprefix("mjJNT_").lower()
                what = f"joint {joint.name!r}" if joint.name else of_body
                raise ValueError(
                    f"{what}: is a {kind} joint, allowed hinges and slides"
                )
            if not joint.name:
                raise ValueError(f"{of_body}: has no name; give it one")
        if empty := [body.name for body in mounting.weightless(spec)]:
            drop = ", ".join(f'"{name}"' for name in empty)
            raise ValueError(
                f"model: found links without mass or shape; leave them out: drop = [{drop}]"
            )
        return spec

    @cached_property
    def mount(self) -> Mount:
        """Of the model where its file has it."""
        ranges: dict[str, tuple[float, ...]] = {}
        for pattern, value in table(self.data, "ranges").items():
            joints = self.matching(pattern, "ranges")
            ranges |= dict.fromkeys(joints, interval(value, f"ranges.{pattern}"))
        return replace(
            self.asked,
            palm=self.palm_frame.link,
            ranges=ranges,
            couplings=self.own_couplings,
            keeps_servos=not self.replaced,
            passive=self.passive,
        )

    @cached_property
    def replaced(self) -> tuple[str, ...]:
        """The actuators of the model in whose place joints get the library's servos, because not all
        of them are position servos, each of other joints."""
        spec, driven, bad = self.raw, dict[str, str](), []
        for actuator in spec.actuators:
            arms = servos.arms(spec, actuator)
            if not servos.is_servo(spec, actuator) or set(arms) & set(driven):
                bad.append(actuator.name)
            driven |= dict.fromkeys(arms, actuator.name)
        if any(actuator.trntype == servos.TENDON for actuator in spec.actuators):
            moved = {*driven, *(coupling.joint for coupling in mounting.followed(spec))}
            bad += [joint for joint in self.angles(table(self.data, "closed"), "closed", False)
                    if joint not in moved]  # fmt: skip
        return tuple(actuator.name for actuator in spec.actuators) if bad else ()

    @cached_property
    def passive(self) -> tuple[str, ...]:
        """Joints without servos: those that the file names, and those in closed loops that it does not
        move."""
        named = (
            strings(self.data["passive"], "passive") if "passive" in self.data else ()
        )
        found = [
            joint for pattern in named for joint in self.matching(pattern, "passive")
        ]
        keys = "opened", "closed", "start"
        moved = set().union(
            *(self.angles(table(self.data, key), key, False) for key in keys)
        )
        looped = set().union(*mounting.loops(self.raw))
        found += [
            j.name
            for j in self.raw.joints
            if j.parent.name in looped and j.name not in moved
        ]
        return tuple(dict.fromkeys(found))

    @cached_property
    def spec(self) -> mujoco.MjSpec:
        """The bare model."""
        spec = self.mount.bare()
        for actuator in spec.actuators:
            if not servos.is_servo(spec, actuator):
                raise ValueError(
                    f"actuator {actuator.name!r}: is no position servo of a joint"
                )
        return spec

    @cached_property
    def files(self) -> list[Path]:
        """Of the model."""
        path = self.asked.model
        return [*models.included(path), *models.assets(path, self.raw)]

    @cached_property
    def model(self) -> mujoco.MjModel:
        """`spec`, compiled."""
        model = models.compiled(self.spec)
        free = [
            joint
            for joint, actuator in self.driven.items()
            if not (
                model.joint(joint).limited[0] or model.actuator(actuator).ctrllimited[0]
            )
        ]
        if free:
            more = "; so have " + ", ".join(free[1:]) if free[1:] else ""
            hint = f'[ranges] "{free[0]}" = [low, high]'
            raise ValueError(
                f"joint {free[0]!r}: has no range; give it one: {hint}{more}"
            )
        return model

    @cached_property
    def joints(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.raw.joints)

    @cached_property
    def driven(self) -> dict[str, str]:
        """Actuators by the joint that they drive: of a tendon the first that follows no other."""
        followers = {coupling.joint for coupling in mounting.followed(self.spec)}
        found = {}
        for actuator in self.spec.actuators:
            arms = servos.arms(self.spec, actuator)
            found[next((j for j in arms if j not in followers), next(iter(arms)))] = (
                actuator.name
            )
        return found

    @cached_property
    def own_couplings(self) -> tuple[Coupling, ...]:
        """Those of the file."""
        found = []
        for joint, about in table(self.data, "couplings").items():
            where = f"couplings.{joint}"
            table({where: about}, where, {"follows", "ratio", "offset"})
            driver = str(about.get("follows"))
            self.angles({joint: 0, driver: 0}, "couplings", False)
            ratio, offset = (number(about.get(key, usual), f"{where}.{key}")
                             for key, usual in (("ratio", None), ("offset", 0.0)))  # fmt: skip
            found.append(Coupling(joint, driver, ratio, offset))
        return tuple(found)

    @cached_property
    def follows(self) -> tuple[Coupling, ...]:
        """Of joints that follow others, those of the file first: each by what moves them all."""
        found = {
            each.joint: each
            for each in (*self.own_couplings, *mounting.followed(self.spec))
        }
        for driver, name in self.driven.items():
            for joint in servos.arms(self.spec, self.spec.actuator(name)):
                if joint != driver:
                    found.setdefault(joint, Coupling(joint, driver, 1.0))
        return tuple(_whole(coupling, found) for coupling in found.values())

    def frame(self, name: Any, where: str) -> Frame:
        """The link that a body is, or is part of; ValueError where there is none of that name."""
        bodies = [body.name for body in self.raw.bodies[1:]]
        if name not in bodies:
            allowed = ", ".join(bodies)
            raise ValueError(
                f"{where}: found no body {name!r} in the model, allowed: {allowed}"
            )
        return self.welded.get(str(name), Frame(str(name)))

    @cached_property
    def welded(self) -> dict[str, Frame]:
        """The bodies that are part of links."""
        # Nobody can mean what has no name.
        fixed = [
            b.name
            for b in self.raw.bodies
            if self.is_own and b.name and mounting.is_fixed(b)
        ]
        if not fixed:
            return {}
        data, found = posed(models.compiled(self.raw.copy()), {}), {}
        for name in fixed:
            body = self.raw.body(name)
            while mounting.is_fixed(body):
                body = body.parent
            here, there = data.body(name), data.body(body.name)
            turn = there.xmat.reshape(3, 3).T
            own = turn @ here.xmat.reshape(3, 3)
            found[name] = Frame(
                body.name, np.round(own, 12), turn @ (here.xpos - there.xpos)
            )
        return found

    # -- joint angles ------------------------------------------------------------------------

    def matching(self, pattern: str, where: str) -> list[str]:
        """The joints of that name, or pattern; ValueError where there is none."""
        joints = (
            [pattern] if pattern in self.joints else matching(self.joints, str(pattern))
        )
        if not joints:
            allowed = ", ".join(self.joints)
            raise ValueError(
                f"{where}: found no joint {pattern!r} in the model, allowed: {allowed}"
            )
        return joints

    def angles(self, values: dict[str, Any], where: str, ranged: bool = True) -> Angles:
        """Those of a table, in order: keys are joints or patterns of them. ValueError for what is not
        in a joint's range, where it is to be `ranged`."""
        found: Angles = {}
        for pattern, value in values.items():
            joints = self.matching(pattern, where)
            found |= dict.fromkeys(joints, number(value, f"{where}.{pattern}"))
        for joint, angle in found.items() if ranged else ():
            low, high = self.range_of(joint)
            if not low - SLACK <= angle <= high + SLACK:
                allowed = f"allowed {low:.4g} to {high:.4g}, the joint's range"
                raise ValueError(f"{where}.{joint}: found {angle:g}, {allowed}")
        return found

    def range_of(self, joint: str) -> tuple[float, float]:
        """Of a joint, in rad or m, infinite where it has none."""
        found = self.model.joint(joint)
        low, high = found.range.tolist() if found.limited[0] else (-math.inf, math.inf)
        return low, high

    def inside(self, joint: str) -> float:
        """The angle nearest to 0 that the joint can have."""
        low, high = self.range_of(joint)
        return min(max(0.0, low), high)

    @cached_property
    def closed(self) -> Angles:
        closed = self.angles(table(self.data, "closed"), "closed")
        idle = [joint for joint in closed if joint not in self.driven]
        if idle:
            hint = "leave it out"
            if self.driven and not any(
                joint == each.joint for joint in idle for each in self.follows
            ):
                names = ", ".join(f'"{name}"' for name in self.driven.values())
                hint = f"add the missing ones, or give all joints the library's: drop = [{names}]"
            raise ValueError(
                f"closed.{idle[0]}: found a joint without an actuator; {hint}"
            )
        return closed

    @cached_property
    def opened(self) -> Angles:
        """The same joints, open."""
        opened = self.angles(table(self.data, "opened"), "opened")
        for joint in opened:
            if joint not in self.closed:
                raise ValueError(
                    f"opened.{joint}: found it without a value in [closed]"
                )
        return {joint: self.inside(joint) for joint in self.closed} | opened

    @cached_property
    def open_pose(self) -> Angles:
        """Of all joints that close, and of those that follow them."""
        return self.opened | self.followed(self.opened)

    def way(self, joint: str) -> float:
        """How far it goes from open to closed, by itself or following another, rad or m."""
        own = self.closed.get(joint, 0.0) - self.opened.get(joint, 0.0)
        return own or sum(
            c.ratio * self.way(c.driver) for c in self.follows if c.joint == joint
        )

    def at(self, share: float) -> Angles:
        """A share of the way from open to closed."""
        return {
            j: self.opened[j] + share * (self.closed[j] - self.opened[j])
            for j in self.closed
        }

    def pose(self, share: float) -> Angles:
        """Of all joints: at a share of the way from open to closed, the others as at the start."""
        angles = self.start | self.at(share)
        return angles | self.followed(angles)

    @cached_property
    def start(self) -> Angles:
        """As the file says, part of the way to closed, or open; followers follow."""
        if "start" in self.data:
            angles = self.angles(table(self.data, "start"), "start")
        else:
            shares = table(self.data, "start_closing", set(self.digits))
            angles = dict(self.opened)
            for digit in self.digits:
                some = self.at(number(shares.get(digit, 0.0), f"start_closing.{digit}"))
                angles |= {joint: some[joint] for joint in self.closing_of(digit)}
        angles = {joint: self.inside(joint) for joint in self.joints} | angles
        return angles | self.followed(angles)

    def followed(self, angles: Angles) -> Angles:
        """Where the joints are that follow others, which are at these angles."""
        return {c.joint: c.at(angles.get(c.driver, 0.0)) for c in self.follows}

    # -- digits and palm ---------------------------------------------------------------------

    @cached_property
    def digits(self) -> dict[str, Digit]:
        found: dict[str, Digit] = {}
        for name, about in table(self.data, "digits").items():
            where = f"digits.{name}"
            table(
                {where: about}, where, {"links", "tip", "palmar", "base", "base_link"}
            )
            bodies = strings(about.get("links"), f"{where}.links")
            frames = [self.frame(body, where) for body in bodies]
            sides: dict[str, Array | None] = {}
            for frame, side in zip(
                frames, _sides(about.get("palmar"), len(bodies), where), strict=True
            ):
                sides.setdefault(
                    frame.link,
                    None if side is None else np.array(frame.direction(side)),
                )
                others = (
                    other for other, digit in found.items() if frame.link in digit.links
                )
                if other := next(others, None):
                    raise ValueError(
                        f"{where}.links: found {frame.link!r}, which is a link of {other}"
                    )
            tip = frames[-1].point(vector(about.get("tip"), 3, f"{where}.tip"))
            found[name] = Digit(tuple(sides), tip, tuple(sides.values()))
        if not found:
            raise ValueError("digits: found none, expected a table with one or more")
        return found

    def closing_of(self, digit: str) -> list[str]:
        """The joints of [closed] that move a digit, through closed loops too."""
        chain = set(mounting.chain(self.spec.body(self.digits[digit].links[-1])))
        chain |= {
            body for loop in mounting.loops(self.spec) if chain & loop for body in loop
        }
        return [
            joint
            for joint in self.closed
            if self.spec.joint(joint).parent.name in chain
        ]

    def tips(self, model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        """(n_digits, 3) in a posed model, m."""
        bodies = [model.body(digit.links[-1]).id for digit in self.digits.values()]
        points = np.array([digit.tip for digit in self.digits.values()])
        turned = np.einsum("nij,nj->ni", data.xmat[bodies].reshape(-1, 3, 3), points)
        return np.asarray(data.xpos[bodies] + turned)

    @cached_property
    def palm_frame(self) -> Frame:
        return self.frame(self.data.get("palm"), "palm")

    @cached_property
    def palm(self) -> int:
        return int(self.model.body(self.palm_frame.link).id)

    @cached_property
    def palm_point(self) -> tuple[float, ...]:
        """In its frame, m."""
        return self.palm_frame.point(
            vector(self.data.get("palm_point"), 3, "palm_point")
        )

    @cached_property
    def palmar(self) -> Array:
        """Unit vector (3,) out of the palm, in its frame."""
        palmar = self.palm_frame.direction(vector(self.data.get("palmar"), 3, "palmar"))
        return unit(palmar, "palmar")

    @cached_property
    def fingers(self) -> Array:
        """Unit vector (3,) from the palm towards the fingers, in its frame."""
        fingers = self.palm_frame.direction(
            vector(self.data.get("fingers"), 3, "fingers")
        )
        fingers = unit(fingers, "fingers")
        if abs(self.palmar @ fingers) > 0.9:
            raise ValueError(
                "fingers: found the direction of palmar, expected one along the palm"
            )
        return beside(fingers, self.palmar)


def _whole(coupling: Coupling, of: Mapping[str, Coupling]) -> Coupling:
    """By the last of those that follow each other."""
    chain = [coupling.joint, coupling.driver]
    while beyond := of.get(coupling.driver):
        chain.append(beyond.driver)
        if beyond.driver in chain[:-1]:
            raise ValueError(f"couplings: found a circle: {' follows '.join(chain)}")
        ratio, offset = coupling.ratio * beyond.ratio, coupling.at(beyond.offset)
        rigid = coupling.is_rigid and beyond.is_rigid
        coupling = Coupling(coupling.joint, beyond.driver, ratio, offset, rigid)
    return coupling


def _sides(value: Any, n: int, where: str) -> list[Array | None]:
    """Palmar directions of `n` links: none, one for all, or one for each."""
    where = f"{where}.palmar"
    if value is None:
        return [None] * n
    each = (
        value
        if isinstance(value, list) and value and isinstance(value[0], list)
        else [value] * n
    )
    if len(each) != n:
        raise ValueError(
            f"{where}: found {len(each)} directions, expected one, or one for each link"
        )
    return [unit(vector(one, 3, where), where) for one in each]


def posed(model: mujoco.MjModel, angles: Mapping[str, float]) -> mujoco.MjData:
    """A model with these joint angles, the others where its joints rest."""
    data = mujoco.MjData(model)
    for joint, angle in angles.items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    return data


def placed(data: mujoco.MjData, link: str, point: Any) -> Array:
    """Where a point (3,) in a link's frame is, m."""
    body = data.body(link)
    return np.asarray(body.xpos + body.xmat.reshape(3, 3) @ point)


def numbers(values: dict[str, Any], where: str) -> dict[str, float]:
    """All of a table, from 0 up."""
    return {key: number(value, f"{where}.{key}", 0.0) for key, value in values.items()}


def unit(direction: Any, where: str) -> Array:
    """A direction of length 1; ValueError where it has none."""
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise ValueError(f"{where}: found no direction")
    return np.asarray(direction, float) / length


def beside(direction: Array, other: Array) -> Array:
    """What of a unit vector is at right angles to another, of length 1."""
    along = float(direction @ other)
    return (
        direction
        if abs(along) < 1e-9
        else unit(direction - along * other, "directions")
    )


def _model_file(name: Any, folder: Path) -> Path:
    """A path beside the hand's file, or "package:path" in a package that is installed."""
    if not isinstance(name, str) or not name:
        raise ValueError(
            f"model: found {name!r}, expected the path of an MJCF or URDF file"
        )
    package, colon, inside = name.partition(":")
    if not colon:
        return folder / name
    spec = (
        find_spec(package) if package.isidentifier() else None
    )  # not imported: that may be slow
    if spec is None or not spec.submodule_search_locations:
        package = package.replace("_", "-")
        what = f"the hand's model files come with {package}, which is not installed"
        raise ImportError(f"{what}: pip install {package}")
    return Path(spec.submodule_search_locations[0]) / inside
