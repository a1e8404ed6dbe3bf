"""Read what a hand's file means of its model: palm, digits, joint angles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import filter as matching
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..state import Array
from ..validation import require_one_of, require_rising
from . import model_file, mount
from .geometry import perpendicular, placed, posed, unit
from .hand import FOLDER, Coupling, Frame
from .tables import HandFile, Names

RANGE_TOLERANCE = 1e-3  # rad or m that an angle may be beyond a joint's range
Angles = dict[str, float]
"""Angles by joint, rad or m."""


class Digit(NamedTuple):
    """A digit, from knuckle to tip."""

    links: tuple[str, ...]
    tip: tuple[float, ...]
    """Fingertip in the frame of the last link, m."""
    sides: tuple[Array | None, ...]
    """Palmar directions of the links, each in its frame, where the file has them."""


# -- what it means ---------------------------------------------------------------------------


@dataclass
class Parts:
    """A hand's file and its model. Properties raise ValueError where one does not fit the other."""

    file: HandFile
    folder: Path

    def __reduce__(self) -> Any:
        """Return what a copy is made from; MuJoCo's specs, which cannot be copied, it makes anew."""
        return Parts, (self.file, self.folder)

    # -- the model

    @property
    def is_own(self) -> bool:
        """True for anybody's own hand; the library's are read as they always were."""
        return self.folder != FOLDER

    @cached_property
    def path(self) -> Path:
        """The model's file."""
        return _model_file(self.file.model, self.folder)

    @cached_property
    def raw(self) -> mujoco.MjSpec:
        """The model before bodies become part of others.

        Raises ValueError for what no hand can have.
        """
        spec = mount.cleaned(self.path, self.file, visual=False)
        weighing = [body.name for body in spec.bodies if body.explicitinertial]
        for name in self.file.masses:
            require_one_of(weighing, name, "masses")
        for joint in spec.joints:
            if joint.type not in (mount.HINGE, mount.LINEAR) or not joint.name:
                kind = joint.type.name.removeprefix("mjJNT_").lower()
                raise ValueError(
                    f"body {joint.parent.name!r}: found {kind} joint {joint.name!r}, "
                    "allowed hinges and slides that have a name"
                )
        return spec

    def bare(self, visual: bool) -> mujoco.MjSpec:
        """Return the model with the links, joints and servos of the hand, where its file has it."""
        spec = mount.cleaned(self.path, self.file, visual)
        if self.file.contacts == "others":
            mount.touch_only_others(spec)
        if self.is_own:
            mount.fuse(spec)
        for joint, span in self.by_joint(self.file.ranges, "ranges").items():
            require_rising(span, f"ranges.{joint}")
            mount.set_range(spec.joint(joint), *span)
        mount.couple(spec, self.file_couplings, self.file.servos)
        for actuator in spec.actuators if self.misfits else ():
            spec.delete(actuator)
        mount.drive(spec, self.passive, self.file.servos)
        return spec

    @cached_property
    def misfits(self) -> list[str]:
        """Actuators that are no position servos, or on a joint that has one.

        Where there are some, all joints get the library's servos.
        """
        misfits, driven = list[str](), set[str]()
        for actuator in self.raw.actuators:
            joints = mount.arms(self.raw, actuator).keys()
            if not mount.is_servo(self.raw, actuator) or joints & driven:
                misfits.append(actuator.name)
            driven |= joints
        return misfits

    @cached_property
    def passive(self) -> tuple[str, ...]:
        """Joints without servos: those that the file names, and those in closed loops.

        What a pose of the file moves has one all the same.
        """
        file = self.file
        joints = self.by_joint(dict.fromkeys(file.passive), "passive")
        poses = file.opened | file.closed | (file.start or {})
        moved = self.by_joint(poses, "opened, closed and start")
        looped = set[str]().union(*mount.loops(self.raw))
        for joint in self.raw.joints:
            if joint.parent.name in looped and joint.name not in moved:
                joints[joint.name] = None
        return tuple(joints)

    @cached_property
    def spec(self) -> mujoco.MjSpec:
        """The model as the hand has it, without what only pictures need."""
        return self.bare(visual=False)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled `spec`."""
        return model_file.compiled(self.spec)

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names of all joints of the model."""
        return tuple(joint.name for joint in self.raw.joints)

    @cached_property
    def driven(self) -> dict[str, str]:
        """Actuators by the joint that they drive: of a tendon the first that follows no other."""
        followers = {coupling.joint for coupling in mount.followed(self.spec)}
        actuators = {}
        for actuator in self.spec.actuators:
            joints = mount.arms(self.spec, actuator)
            leader = min(joints, key=lambda joint: joint in followers)
            actuators[leader] = actuator.name
        return actuators

    @cached_property
    def file_couplings(self) -> tuple[Coupling, ...]:
        """Couplings of the hand's file."""
        laws = self.by_joint(self.file.couplings, "couplings")
        for law in laws.values():
            require_one_of(self.joints, law.follows, "couplings")
        return tuple(
            Coupling(joint, *vars(law).values()) for joint, law in laws.items()
        )

    @cached_property
    def follows(self) -> tuple[Coupling, ...]:
        """Couplings of all joints that follow others, those of the file first, by what moves them."""
        couplings = {
            coupling.joint: coupling
            for coupling in (*self.file_couplings, *mount.followed(self.spec))
        }
        for driver, name in self.driven.items():
            for joint in mount.arms(self.spec, self.spec.actuator(name)):
                if joint != driver:
                    couplings.setdefault(joint, Coupling(joint, driver, 1.0))
        return tuple(_by_last(each, couplings) for each in couplings.values())

    def frame(self, name: str, where: str) -> Frame:
        """Return the link that a body is, or is part of.

        Raises ValueError where no body has that name.
        """
        require_one_of([body.name for body in self.raw.bodies[1:]], name, where)
        return self.welded.get(name, Frame(name))

    @cached_property
    def welded(self) -> dict[str, Frame]:
        """Frames of the bodies that are part of links, by their names."""
        names = [b.name for b in self.raw.bodies if b.name and mount.is_fixed(b)]
        if not names or not self.is_own:
            return {}
        data, frames = posed(model_file.compiled(self.raw.copy()), {}), {}
        for name in names:
            body = data.body(name)
            link = data.body(mount.link_of(self.raw.body(name)).name)
            turn = link.xmat.reshape(3, 3).T
            axes = np.round(turn @ body.xmat.reshape(3, 3), 12)
            frames[name] = Frame(link.name, axes, turn @ (body.xpos - link.xpos))
        return frames

    # -- joint angles

    def by_joint(self, table: Mapping[str, Any], where: str) -> dict[str, Any]:
        """Return a table of the file by joint; its keys are joints or patterns of them."""
        values: dict[str, Any] = {}
        for pattern, value in table.items():
            is_name = pattern in self.joints  # also one with brackets
            joints = [pattern] if is_name else matching(self.joints, pattern)
            if not joints:
                require_one_of(self.joints, pattern, where)
            values |= dict.fromkeys(joints, value)
        return values

    def angles(self, values: Mapping[str, float], where: str) -> Angles:
        """Return a table of the file by joint; ValueError for what is not in a joint's range."""
        angles = self.by_joint(values, where)
        for joint, angle in angles.items():
            low, high = self.range_of(joint)
            if not low - RANGE_TOLERANCE <= angle <= high + RANGE_TOLERANCE:
                raise ValueError(
                    f"{where}.{joint}: found {angle:g}, allowed {low:.4g} to {high:.4g}, "
                    "the joint's range"
                )
        return angles

    def range_of(self, name: str) -> tuple[float, float]:
        """Return the range of a joint, in rad or m, infinite where it has none."""
        joint = self.model.joint(name)
        low, high = joint.range.tolist() if joint.limited[0] else (-math.inf, math.inf)
        return low, high

    def inside(self, joint: str) -> float:
        """Return the angle nearest to 0 that the joint can have."""
        return float(np.clip(0.0, *self.range_of(joint)))

    @cached_property
    def closed(self) -> Angles:
        """Angles of the closed hand, of joints that have an actuator."""
        closed = self.angles(self.file.closed, "closed")
        for joint in closed:
            if joint not in self.driven:
                raise ValueError(
                    f"closed.{joint}: found a joint without an actuator; leave it out, or, unless it "
                    "follows another, drop all actuators"
                )
        return closed

    @cached_property
    def opened(self) -> Angles:
        """Angles of the open hand, of the joints that close."""
        opened = self.angles(self.file.opened, "opened")
        for joint in opened:
            require_one_of(self.closed, joint, "opened")
        return {joint: self.inside(joint) for joint in self.closed} | opened

    def way(self, joint: str) -> float:
        """Return how far it goes from open to closed, by itself or following another, rad or m."""
        ends = (self.followed(ends) | ends for ends in (self.opened, self.closed))
        opened, closed = (angles.get(joint, 0.0) for angles in ends)
        return closed - opened

    def at(self, share: float) -> Angles:
        """Return the angles at a share of the way from open to closed."""
        return between(self.opened, self.closed, share)

    def pose(self, share: float) -> Angles:
        """Return the angles of all joints at a share of the way from open to closed.

        Joints that do not close are as at the start.
        """
        angles = self.start | self.at(share)
        return angles | self.followed(angles)

    @cached_property
    def start(self) -> Angles:
        """Angles at the start: as the file says, part of the way to closed, or open."""
        if self.file.start is not None:
            angles = self.angles(self.file.start, "start")
        else:
            angles = dict(self.opened)
            for digit, share in self.file.start_closing.items():
                require_one_of(self.digits, digit, "start_closing")
                closing = self.at(share)
                angles |= {joint: closing[joint] for joint in self.closing_of(digit)}
        return self.completed(angles)

    def completed(self, angles: Angles) -> Angles:
        """Return the angles of all joints: these, what follows them, others as near to 0 as can be."""
        angles = {joint: self.inside(joint) for joint in self.joints} | angles
        return angles | self.followed(angles)

    def followed(self, angles: Angles) -> Angles:
        """Return where the joints are that follow others, which are at these angles."""
        return {c.joint: c.at(angles.get(c.driver, 0.0)) for c in self.follows}

    # -- digits and palm

    @cached_property
    def digits(self) -> dict[str, Digit]:
        """Digits of the file, by name."""
        digits: dict[str, Digit] = {}
        for name, table in self.file.digits.items():
            where = f"digits.{name}"
            require_distinct(table.links, where)
            frames = [self.frame(body, where) for body in table.links]
            directions = _directions(table.palmar, len(frames), f"{where}.palmar")
            sides: dict[str, Array | None] = {}
            for frame, side in zip(frames, directions, strict=True):
                turned = None if side is None else np.array(frame.direction(side))
                sides.setdefault(frame.link, turned)
            tip = frames[-1].point(table.tip)
            digits[name] = Digit(tuple(sides), tip, tuple(sides.values()))
        links = [link for digit in digits.values() for link in digit.links]
        require_distinct(tuple(links), "digits")
        return digits

    def closing_of(self, digit: str) -> list[str]:
        """Return the joints of [closed] that move a digit, through closed loops too."""
        chain = set(mount.chain(self.spec.body(self.digits[digit].links[-1])))
        chain = chain.union(*(loop for loop in mount.loops(self.spec) if chain & loop))
        return [j for j in self.closed if self.spec.joint(j).parent.name in chain]

    def tips(self, data: mujoco.MjData) -> Array:
        """Return where fingertips are in a posed model, (n_digits, 3), m."""
        digits = self.digits.values()
        return np.array([placed(data, digit.links[-1], digit.tip) for digit in digits])

    @cached_property
    def palm_frame(self) -> Frame:
        """The palm's body in the frame of its link."""
        return self.frame(self.file.palm, "palm")

    @cached_property
    def palm(self) -> int:
        """Id of the palm's link in `model`."""
        return int(self.model.body(self.palm_frame.link).id)

    @cached_property
    def palm_point(self) -> tuple[float, ...]:
        """The palm's point (3,) in the frame of its link, m."""
        return self.palm_frame.point(self.file.palm_point)

    @cached_property
    def palmar(self) -> Array:
        """Unit vector (3,) out of the palm, in the frame of its link."""
        return unit(self.palm_frame.direction(self.file.palmar), "palmar")

    @cached_property
    def fingers(self) -> Array:
        """Unit vector (3,) from the palm towards the fingers, in the frame of its link."""
        fingers = unit(self.palm_frame.direction(self.file.fingers), "fingers")
        if abs(self.palmar @ fingers) > 0.9:
            raise ValueError(
                "fingers: found the direction of palmar, expected one along the palm"
            )
        return perpendicular(fingers, self.palmar)


def between(opened: Angles, closed: Angles, share: float) -> Angles:
    """Return the closed joints' angles at a share of the way from open to closed."""
    return {
        joint: opened[joint] + share * (end - opened[joint])
        for joint, end in closed.items()
    }


def require_distinct(names: Names, where: str) -> None:
    """Raise ValueError unless there are one or more names, each once."""
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{where}: found {list(names)}, expected each name once")


def _by_last(coupling: Coupling, couplings: Mapping[str, Coupling]) -> Coupling:
    """Return a coupling to the joint that moves all those that follow each other."""
    chain = [coupling.joint]
    while beyond := couplings.get(coupling.driver):
        chain.append(beyond.joint)
        if beyond.driver in chain:
            raise ValueError(f"couplings: found a circle: {' follows '.join(chain)}")
        coupling = Coupling(
            coupling.joint,
            beyond.driver,
            coupling.ratio * beyond.ratio,
            coupling.at(beyond.offset),
            coupling.is_rigid and beyond.is_rigid,
        )
    return coupling


def _directions(value: Any, n: int, where: str) -> list[Array | None]:
    """Return palmar directions of `n` links: none, one for all, or one for each."""
    if value is None:
        return [None] * n
    directions = value if isinstance(value[0], tuple) else [value] * n
    if len(directions) != n:
        raise ValueError(
            f"{where}: found {len(directions)} directions, expected one, or one for each link"
        )
    return [unit(direction, where) for direction in directions]


def _model_file(name: str, folder: Path) -> Path:
    """Return a path beside the hand's file, or "package:path" in a package that is installed.

    The package is not imported: that may be slow.
    """
    package, colon, inside = name.partition(":")
    if not colon:
        return folder / name
    spec = find_spec(package) if package.isidentifier() else None
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(
            f"model: found {name!r}, but no installed package {package!r}; allowed a path, or "
            "PACKAGE:PATH"
        )
    return Path(spec.submodule_search_locations[0]) / inside
