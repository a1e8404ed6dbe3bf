"""A robot hand: what a simulator, a task and a taxel layout need to know about one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from ..state import Array
from ..validation import quoted
from .tables import CLOSING_STEP, HandFile

if TYPE_CHECKING:
    from .geometry import Geom

FOLDER, SUFFIX = Path(__file__).parent, ".toml"
RADIUS = 2e-3  # m, of taxels of which nothing says it
GRASP_SUFFIX = ".grasp.toml"
"""Suffix in place of SUFFIX where a command keeps a grasp that it has found for a file
without one."""
SLIDES = ("slide_x", "slide_y", "slide_z")
"""The first joints and actuators: they carry the whole hand along the world's axes."""
ARM, FINGERS = slice(len(SLIDES)), slice(len(SLIDES), None)
"""The slides, and all others, among a hand's joints or actuators."""
DIGITS = ("thumb", "index", "middle", "ring", "little")
"""Usual names of up to five digits."""
SEGMENTS = ("proximal", "middle", "distal")
"""Names of three segments of a digit."""


@dataclass(frozen=True)
class Surface:
    """The palmar side of one link: where taxels may lie.

    A link that is one capsule is the palmar half of a cylinder. One of other or several
    ``geoms`` is what is met when one comes from the palmar side. A flat palm is a
    plane. All vectors are in the link's frame; the grid's origin is
    ``centre + radius * palmar`` on a cylinder.
    """

    digit: str
    """Name of the digit; for the palm, of the finger whose base it is, or "palm"."""
    segment: str
    """Segment of the digit, or "palm"."""
    link: str
    """Body the taxels ride on."""
    centre: tuple[float, float, float]
    """Point on the cylinder's axis (on the plane, or within the geoms) under the grid's
    centre, m."""
    along: tuple[float, float, float]
    """Unit vector towards the fingertip: the direction of a grid's rows."""
    palmar: tuple[float, float, float]
    """Unit outward normal of the palmar side."""
    radius: float = 0.0
    """Radius of the capsule that is the link's shape, m; 0 for other shapes."""
    bone: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Both ends of its axis, m; None for other shapes."""
    geoms: tuple[Geom, ...] = ()
    """Shapes of the link, where it is neither one capsule nor flat."""
    extent: tuple[float, float] = (9e-3, 9e-3)
    """Half the length and half the width of a surface that is no cylinder, m."""

    def place(self, row: float, column: float) -> tuple[Array, Array] | None:
        """Return position (3,), m, and outward normal (3,) of a taxel, in the link's frame.

        It lies `row` and `column` metres off the grid's middle. The flat grid is
        projected on to the link along the palmar normal, so that the paper's pitches
        hold in the plane they are given in. None where a link of any shape has nothing
        there; ValueError beside one that is a capsule.
        """
        palmar = np.array(self.palmar)
        above = (
            np.array(self.centre) + row * np.array(self.along) + column * self.across
        )
        if self.geoms:
            from .geometry import meet

            return meet(self.geoms, above, -palmar)
        if self.bone is None:
            return above, palmar
        if abs(column) <= self.radius + 1e-9:  # its very edge, in mm, is not exact
            height = np.sqrt(max(0.0, self.radius**2 - column**2))
            outward = column * self.across + height * palmar
            return above + height * palmar, outward / self.radius
        low, high, half_width = (1e3 * end for end in self.span)
        raise ValueError(
            f"a taxel on {self.digit}.{self.segment} lies beside the link: found "
            f"{1e3 * row:.1f} mm along and {1e3 * column:.1f} mm beside its middle, allowed "
            f"{low:.1f} to {high:.1f} mm along and up to {half_width:.1f} mm beside"
        )

    @property
    def across(self) -> Array:
        """Unit vector (3,) in the direction of a grid's columns."""
        return np.cross(np.array(self.palmar), np.array(self.along))

    def offset(self, position: Array) -> tuple[float, float, float]:
        """Return (row, column, height over the grid's middle), m, of a point (3,) of the link."""
        axes = np.array([self.along, self.across, self.palmar])
        row, column, height = axes @ (position - np.array(self.centre))
        return float(row), float(column), float(height)

    def skin(self, point: Array) -> tuple[float, Array]:
        """Return the distance of a point (3,) of the link to the skin, and the normal (3,) there.

        The distance is in m, negative inside of the link; the normal points outward.
        """
        if self.geoms:
            from .geometry import outside

            return outside(self.geoms, point)
        if self.bone is None:
            return self.offset(point)[2], np.array(self.palmar)
        begin, end = np.array(self.bone)
        bone = end - begin
        share = np.clip((point - begin) @ bone / (bone @ bone), 0.0, 1.0)
        away = point - begin - share * bone
        length = float(np.linalg.norm(away))
        normal = away / length if length > 0 else np.array(self.palmar)
        return length - self.radius, normal

    @property
    def span(self) -> tuple[float, float, float]:
        """Rows of both ends, and half the width of the link, m, from the grid's middle."""
        if self.bone is None:
            return -self.extent[0], *self.extent
        low, high = sorted(self.offset(np.array(point))[0] for point in self.bone)
        return low, high, self.radius


@dataclass(frozen=True)
class Pitch:
    """Distances between a hand's taxels and their sensing radii, in m (paper, Methods)."""

    rows: dict[str, float]
    """Row distance for each segment."""
    columns: dict[str, float]
    """Column distance for each link but the palm's."""
    radius: float
    """Radius of a taxel of layouts 1-5 and of every palm taxel."""
    large_radius: float
    """Radius of a phalanx taxel of layout 6."""


@dataclass(frozen=True)
class LinearAction:
    """Joint target = centre + action * half_range (paper, MuJoCo set-up; Melnik et al. 2021)."""

    centre: Array
    half_range: Array

    def __call__(self, action: Array, joint_targets: Array) -> Array:
        """Return new joint targets (n_actuators,) from an action in [-1, 1] of the same shape."""
        return self.centre + action * self.half_range

    def commands(self, joint_targets: Array) -> Array:
        """Return the last value that each action commanded: the targets themselves."""
        return joint_targets


@dataclass(frozen=True)
class ClosingAction:
    """Increments "in relation to the current position and within the limits" (paper, PyBullet set-up).

    The slides move, where they are actions, and groups of joints go along their closing
    trajectories. The position is the one last asked for, not the one reached: a finger
    that the object stops is asked for more with each increment and presses the harder,
    up to its force limit. From the position reached, any small step back would let go.
    """

    slide_step: Array
    """(3,) how far an action of 1 moves each slide's target, m; (0,) where no slide is
    an action."""
    slide_limits: Array
    """(3, 2) lowest and highest target of each slide, m; (0, 2) where no slide is an
    action."""
    closing_step: float
    """Share of the way from open to closed by which an action of 1 closes a group."""
    groups: tuple[Array, ...]
    """For each action after the slides', the actuators that it moves."""
    open: Array
    """(n_actuators,) targets at the open end."""
    closed: Array
    """(n_actuators,) targets at the closed end."""

    def __call__(self, action: Array, joint_targets: Array) -> Array:
        """Return new joint targets (..., n_actuators) from actions (slides, then groups) in [-1, 1]."""
        targets, n_slides = joint_targets.copy(), len(self.slide_step)
        slides = targets[..., :n_slides] + self.slide_step * action[..., :n_slides]
        targets[..., :n_slides] = np.clip(slides, *self.slide_limits.T)
        closing = self._closing(targets) + self.closing_step * action[..., n_slides:]
        way, shares = self.closed - self.open, np.clip(closing, 0.0, 1.0)
        for number, group in enumerate(self.groups):
            share = shares[..., number, None]
            targets[..., group] = self.open[group] + share * way[group]
        return targets

    def commands(self, joint_targets: Array) -> Array:
        """Return the last value that each action commanded.

        These are the slides' targets, m, and how far each group is to be closed, from 0
        to 1.
        """
        slides = joint_targets[..., : len(self.slide_step)]
        return np.concatenate([slides, self._closing(joint_targets)], axis=-1)

    def _closing(self, targets: Array) -> Array:
        """Return how far each group is closed, by the first of its actuators that moves."""
        first = self._first
        way = (self.closed - self.open)[first]
        return (targets[..., first] - self.open[first]) / way

    @cached_property
    def _first(self) -> Array:
        """The first actuator of each group that moves, (n_groups,)."""
        moves = self.closed != self.open
        return np.array([group[moves[group]][0] for group in self.groups], np.int64)


class Point(NamedTuple):
    """A taxel on a link."""

    link: str
    position: tuple[float, ...]
    """(3,), m."""
    normal: tuple[float, ...]
    """(3,), unit, outward; () stands for that of the nearest skin until the taxel is
    placed."""
    radius: float
    """Radius of its sensing sphere, m."""
    name: str
    threshold_N: float | None = None
    """Force from which it fires, N; None: any touch."""

    def toml(self) -> list[str]:
        """Return the lines of a layout file that describe the taxel."""
        table = {"name": self.name, **self._asdict()}
        given = {key: table[key] for key in table if table[key] not in ((), None)}
        return ["[[taxel]]", *(f"{key} = {quoted(given[key])}" for key in given)]


class Sensors(NamedTuple):
    """The touch sensors that a model has of its own."""

    points: tuple[Point, ...] = ()
    left_out: tuple[str, ...] = ()
    """Names of those that are not on the skin of a digit or the palm."""

    def __str__(self) -> str:
        """Return what was left out, "" where that is nothing."""
        names = ", ".join(self.left_out)
        return f"left out, as they are not on the skin: {names}" if names else ""


class Frame(NamedTuple):
    """The place of a body of the model in the frame of its link, of which it may be a part."""

    link: str
    turn: Array = np.eye(3)
    """(3, 3)"""
    place: Array = np.zeros(3)
    """(3,), m"""

    def direction(self, vector: Any) -> Any:
        """Return a direction (3,) in the link's frame from one in the body's."""
        return tuple((self.turn @ vector).tolist())

    def point(self, point: Any) -> tuple[float, ...]:
        """Return a point (3,), m, in the link's frame from one in the body's."""
        return tuple((self.turn @ point + self.place).tolist())


class Coupling(NamedTuple):
    """A joint whose position is offset + ratio x that of its driver, rad or m."""

    joint: str
    driver: str
    ratio: float
    offset: float = 0.0
    is_rigid: bool = False
    """True for an equality, which follows the driver's position; False for a tendon,
    which follows its target."""

    def at(self, driver: float) -> float:
        """Return the joint's position where its driver has this one."""
        return self.ratio * driver + self.offset


@dataclass(frozen=True)
class ScriptedGrasp:
    """An open-loop grasp found by search."""

    object_size: float
    """Edge of the cube it was found for, m."""
    targets: dict[str, float]
    """Joint targets by actuator name, rad or m."""


@dataclass(frozen=True, kw_only=True)
class Model:
    """The file and the model that a hand is made from."""

    name: str
    file: HandFile
    """The content of its file."""
    build: Callable[..., Any]
    """Function that returns the hand alone as a new mujoco.MjSpec: no ground, no
    object, no taxels.

    Its arguments are `visual`, True to keep what only pictures need, and `finger_gain`,
    by which the gain of the fingers' actuators is multiplied."""
    paths: tuple[Path, ...]
    """Files of its model, with what it includes and its meshes."""
    welded: dict[str, Frame]
    """Bodies of the model that are part of a link."""
    notes: tuple[str, ...]
    """Notes on what was left out or put in of its model, and what it cannot do."""


@dataclass(frozen=True, kw_only=True)
class Actuation:
    """Joints of a hand, and what moves them. The first joints and actuators are `SLIDES`."""

    joints: tuple[str, ...]
    """Joints in the order of the observation."""
    actuators: tuple[str, ...]
    """Actuators in the order of joint targets; each drives the joint of
    ``actuated``."""
    actuated: tuple[str, ...]
    couplings: tuple[Coupling, ...]
    """Couplings of joints that move with actuated ones."""
    opened: dict[str, float]
    """Targets by actuator of the open hand, from where fingers that close in groups set
    off, rad."""
    closed: dict[str, float]
    """Targets of the same actuators where the hand is closed, rad."""
    groups: dict[str, tuple[str, ...]]
    """The actuators that close together, each in one group, by what that is called."""
    action_map: LinearAction | ClosingAction
    action_names: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """The palm and the digits of a hand: where its points are, and where taxels may lie."""

    palm: str
    """Body whose ``palm_point`` is "the hand" in rewards."""
    palm_point: tuple[float, ...]
    fingertips: tuple[tuple[str, tuple[float, ...]], ...]
    """Body and point (m, body frame) of the tip of each digit it has."""
    surfaces: tuple[Surface, ...]
    pitch: Pitch
    sensors: Sensors
    reach: float = 0.15
    """Largest distance of its fingertips from the palm's point, m."""

    @property
    def digits(self) -> tuple[str, ...]:
        """Names of its digits."""
        names = [s.digit for s in self.surfaces if s.segment != "palm"]
        return tuple(dict.fromkeys(names))

    @property
    def finger_length(self) -> float:
        """Length of its longest digit, from knuckle to tip, m."""
        lengths = dict.fromkeys(self.digits, 0.0)
        for surface in self.surfaces:
            if surface.segment != "palm":
                low, high, _ = surface.span
                lengths[surface.digit] += high - low
        return max(lengths.values())


@dataclass(frozen=True, kw_only=True)
class Start:
    """Say where a hand is at first, and how it grasps from there.

    It hangs palm down above the origin of the world. Its slides, in m, are zero where
    it starts over an object no wider than ``start_clearance``.
    """

    start: dict[str, float]
    """Joint positions at reset, rad or m; 0 for joints that it does not name."""
    grasps: tuple[ScriptedGrasp, ...]
    start_clearance: ClassVar[float] = 0.05
    """Edge of the largest cube that lies free of the hand at the start, m. Over what is
    higher the hand hangs higher; over what is wider it starts further up its slide
    (`start_above`)."""


@dataclass(frozen=True, kw_only=True)
class Hand(Model, Actuation, Geometry, Start):
    """One hand."""

    def closing_from(self, start: float, actions: str) -> Hand:
        """Return the hand with slides that stand still and fingers that close and open.

        They begin at `start`, a share of the way from open to closed. One action closes
        all of them ("grip"), or one each group ("fingers").
        """
        action = self.closing(np.zeros(0), np.zeros((0, 2)), CLOSING_STEP)
        names, groups = tuple(self.groups), action.groups
        if actions == "grip":
            names, groups = ("closing of the hand",), (np.concatenate(groups),)
        opened = action.open + start * (action.closed - action.open)
        pose = self.start | dict(zip(self.actuated, opened.tolist(), strict=True))
        for coupling in self.couplings:
            pose[coupling.joint] = coupling.at(pose[coupling.driver])
        action = replace(action, open=opened, groups=groups)
        return replace(self, action_map=action, action_names=names, start=pose)

    def closing(
        self, slide_step: Array, slide_limits: Array, closing_step: float
    ) -> ClosingAction:
        """Return actions that move the slides, and close and open the hand's groups."""
        start = dict(zip(self.actuators, self.start_targets().tolist(), strict=True))
        opened, closed = (
            np.array([*(start | ends).values()]) for ends in (self.opened, self.closed)
        )
        groups = tuple(
            np.array([self.actuators.index(name) for name in names])
            for names in self.groups.values()
        )
        return ClosingAction(
            slide_step, slide_limits, closing_step, groups, opened, closed
        )

    def start_above(self, width: float, height: float) -> Hand:
        """Return the hand as it starts over an object of these measures, m.

        What is wider than `start_clearance` does not lie free between the fingers.
        Nothing of the hand is below the ground at the start, so raised by the object's
        height it is free of the object. The part of that above `start_clearance` is in
        how high the hand hangs, whatever the width.
        """
        if width <= self.start_clearance:
            return self
        start = self.start | {SLIDES[2]: min(height, self.start_clearance)}
        return replace(self, start=start)

    def start_positions(self) -> Array:
        """Return joint positions at reset in the order of ``joints``, shape (n_joints,)."""
        return np.array([self.start.get(joint, 0.0) for joint in self.joints])

    def start_targets(self) -> Array:
        """Return joint targets that hold the start pose, shape (n_actuators,)."""
        return np.array([self.start.get(joint, 0.0) for joint in self.actuated])


def short_digest(*parts: Path | bytes) -> str:
    """Return a digest, 16 hex digits, of bytes and of the content of files."""
    contents = (p if isinstance(p, bytes) else p.read_bytes() for p in parts)
    return hashlib.sha256(b"".join(contents)).hexdigest()[:16]
