"""Guess a hand's file from its model alone: from how its parts hang, are called and move.

Digits are the chains that branch from the palm. Each axis of the palm is tried as its
palmar side; the one on which the fingertips lie furthest in front of the palm while
they close is kept.
"""

from __future__ import annotations

import re
from collections import Counter
from functools import cached_property
from itertools import combinations, product
from pathlib import Path
from statistics import mode
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from .envs import validation
from .envs.hands import mount
from .envs.hands.geometry import gap, geoms_of, meet, placed, posed, unit
from .envs.hands.hand import DIGITS
from .envs.hands.parts import Angles, Parts, between
from .envs.hands.tables import HandFile
from .envs.state import Array

WORDS = {
    "thumb": "thumb|th|pollex",
    "index": "index|fore|ff|if|pointer",
    "middle": "middle|mf|mid",
    "ring": "ring|rf",
    "little": "little|pinky|lf|small",
}
MAX_LINKS = 4  # of a digit, counted from its tip
MAX_WRIST_JOINTS = 2  # joints outside of a hand that are no arm
STEP = 0.01  # rad or m, by which a joint goes to see what it turns
TRIAL_ANGLE = 0.3  # rad, and at most a quarter of a range: how far a joint is tried
MIN_APPROACH = 5e-3  # m by which a tip comes nearer to others when a joint closes
N_STEPS = 20  # of a digit's way to its closed end
IN_PALM, IN_FINGER = 2e-3, 8e-3
"""m that fingers may be in the palm, and in each other, before they stop."""
MAX_THUMB_COSINE = (
    0.5  # cosine by which a thumb goes another way than the other digits do
)
DISTAL_SHARE = 0.5  # of the way of a finger's first joint, what those beyond it go
HALF_OPEN, OPENING = 0.5, 0.11
"""Least share of opening at the start, and distance between thumb and fingers there,
m."""
FLEXING = 0.5  # cosine to the axis of a digit's last hinge, below which a hinge spreads or opposes
ALMOST_CLOSED = 0.85  # share of their way where fingers lie in front of the palm
AXES = [*np.eye(3), *-np.eye(3)]


class Guess:
    """Guess palm, digits and poses of a model. Raise ValueError naming what it does not say."""

    def __init__(self, model: str, folder: Path, known: dict[str, Any]) -> None:
        """Find the palm and the chains of links that hang on it.

        `model` is written as in the hand's file, which is to lie in `folder`. `known`
        has keys of the file that are not to be guessed, and `servos` where the model's
        are to be dropped.
        """
        self.folder = folder
        unknown = {"palmar": [1, 0, 0], "fingers": [0, 1, 0], "palm_point": [0, 0, 0]}
        empty = {"palm": "", "digits": {}, "drop": []}
        self.keys: dict[str, Any] = {"model": model, **empty, **unknown, **known}
        if self.keys.pop("servos", None):
            self.keys["drop"] += [servo.name for servo in self._whole().actuators]
        spec = self._whole()
        self.keys["palm"] = self.keys["palm"] or _palm_of(spec)
        bodies = [body.name for body in spec.bodies]
        validation.require_one_of(bodies, self.keys["palm"], "palm")
        root = _root_of(spec.body(self.keys["palm"]))
        if len(spec.joints) - _n_joints(root) > MAX_WRIST_JOINTS:
            self.keys["root"] = root.name
        self.parts = self._parts()
        self.frame = self.parts.palm_frame
        self.chains = chains_of(self.parts, self.frame.link)

    def _whole(self) -> mujoco.MjSpec:
        """Return the model with whatever the hand hangs on, which may have joints of any kind."""
        parts = self._parts()
        return mount.cleaned(parts.path, parts.file, visual=False)

    def _parts(self) -> Parts:
        """Return the parts of a hand of which only the keys so far are known."""
        return Parts(validation.fill(HandFile, self.keys), self.folder)

    # -- the digits, and where they go -------------------------------------------------------

    @cached_property
    def digits(self) -> list[str]:
        """Names of the digits: by words in names of links and joints, others counted from the thumb.

        Without such a word the thumb is the digit that goes another way than all
        others.
        """
        names = [chain.name for chain in self.chains]
        names = [name if names.count(name) == 1 else "" for name in names]
        if "thumb" not in names:
            alike = (self.ways @ self.ways.T).sum(axis=1).round(6)
            loner = int(np.argmin(alike))
            others = np.delete(alike, loner).mean()
            if len(names) == 2 or alike[loner] < others - MAX_THUMB_COSINE:
                names[loner] = "thumb"
        free = iter([name for name in DIGITS[1:] if name not in names])
        from_thumb = np.zeros(len(names))
        if "thumb" in names:
            away = self.begins - self.begins[names.index("thumb")]
            from_thumb = np.linalg.norm(away, axis=1).round(6)
        for number in np.argsort(from_thumb, kind="stable"):
            names[number] = names[number] or next(free, f"finger{number + 1}")
        return names

    @cached_property
    def thumb(self) -> int | None:
        """Number of the digit that opposes the others; None where there are two, or none does."""
        if len(self.digits) > 2 and "thumb" in self.digits:
            return self.digits.index("thumb")
        return None

    @cached_property
    def fingers(self) -> list[int]:
        """Numbers of the digits but the thumb."""
        return [number for number in range(len(self.chains)) if number != self.thumb]

    def posed(self, angles: Angles) -> mujoco.MjData:
        """Return the hand with these joint angles, the others as near to 0 as they can be."""
        return posed(self.parts.model, self.parts.completed(angles))

    def in_palm(self, points: Any) -> Array:
        """Return points (n, 3) of the palm's link in the frame of the body called palm, m."""
        return (np.array(points) - self.frame.place) @ self.frame.turn

    def places(self, angles: Angles, points: list[tuple[str, Any]]) -> Array:
        """Return points of links (n, 3), m, in the palm's frame, of the hand at these angles."""
        data = self.posed(angles)
        palm = data.body(self.frame.link)
        away = np.array([placed(data, *point) for point in points]) - palm.xpos
        return self.in_palm(away @ palm.xmat.reshape(3, 3))

    def tips(self, angles: Angles) -> Array:
        """Return where fingertips are (n, 3), m, in the palm's frame."""
        return self.places(angles, [(each.links[-1], each.tip) for each in self.chains])

    @cached_property
    def begins(self) -> Array:
        """Places (n, 3) where digits begin, m, in the palm's frame."""
        return self.places({}, [(chain.links[0], np.zeros(3)) for chain in self.chains])

    def turning(self, number: int, joint: str, pose: Angles) -> Array:
        """Return the axis (3,) about which a digit's last link turns as a joint goes up.

        It is as long as the link turns rad per rad: zeros where it slides.
        """
        link = self.chains[number].links[-1]
        angle = pose.get(joint, self.parts.inside(joint))
        before, after = (
            self.posed(pose | step).body(link).xmat.reshape(3, 3)
            for step in ({}, {joint: angle + STEP})
        )
        return Rotation.from_matrix(after @ before.T).as_rotvec() / STEP

    def limits(self, joint: str) -> list[float]:
        """Return between which angles a joint is driven, its followers in their ranges, rad or m."""
        limits = np.array(self.parts.range_of(joint))
        for coupling in self.parts.follows:
            if coupling.driver == joint and coupling.is_rigid and coupling.ratio:
                followed = np.array(self.parts.range_of(coupling.joint))
                ends = np.sort((followed - coupling.offset) / coupling.ratio)
                limits = limits.clip(*ends)
        actuator = self.parts.model.actuator(self.parts.driven[joint])
        if actuator.ctrllimited[0]:
            limits = limits.clip(*actuator.ctrlrange)
        return limits.tolist()

    @cached_property
    def ends(self) -> list[dict[str, tuple[float, float]]]:
        """(open, closed) of the joints that flex each digit, rad or m."""
        return [self._ends(number) for number in range(len(self.chains))]

    def _ends(self, number: int) -> dict[str, tuple[float, float]]:
        """Return (open, closed) of slides, and of hinges that turn about the axis of the last.

        A joint closes to the side on which the tip comes nearer to the others', or else
        to that on which there is more of its range.
        """
        joints = self.chains[number].joints
        axes = {joint: self.turning(number, joint, {}) for joint in joints}
        hinges = [axis for axis in axes.values() if np.linalg.norm(axis) > FLEXING]
        middle, ends = self.tips({}).mean(axis=0), {}
        for joint, axis in axes.items():
            is_hinge = np.linalg.norm(axis) > FLEXING
            if is_hinge and abs(axis @ hinges[-1]) <= FLEXING:
                continue
            begin, (low, high) = self.parts.inside(joint), self.limits(joint)
            step = min(TRIAL_ANGLE, (high - low) / 4)
            tips = [self.tips({joint: begin + way * step})[number] for way in (-1, 1)]
            down, up = np.linalg.norm(tips - middle, axis=1)
            way = down - up
            if abs(way) <= MIN_APPROACH:
                way = low + high - 2 * begin
            opened, closed = (low, high) if way > 0 else (high, low)
            is_long = abs(closed - begin) >= abs(opened - begin)
            ends[joint] = begin if is_long else opened, closed
        return ends

    @cached_property
    def ways(self) -> Array:
        """Unit vectors (n, 3) from the open to the half closed fingertips."""
        half = {
            joint: sum(both) / 2 for ends in self.ends for joint, both in ends.items()
        }
        ways = self.tips(half) - self.tips({})
        return ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)

    # -- the palm ----------------------------------------------------------------------------

    @cached_property
    def palm_skin(self) -> Array:
        """Corners (n, 3) of the palm's shapes, m, in its frame."""
        geoms = geoms_of(self.parts.model, self.frame.link)
        points = [point for geom in geoms for point in geom.points]
        return self.in_palm(points or [self.frame.place])

    @cached_property
    def directions(self) -> tuple[Array, Array]:
        """(palmar, fingers), axes (3,) of the palm's frame.

        Fingers that close lie in front of the palmar side. Open ones lie in the
        direction of fingers; where they lie all around, that is across the way on which
        they close.
        """
        way = ALMOST_CLOSED * (self.stop if self.thumb is None else 1.0)
        closed = self.tips(between(*self.bent, way))[self.fingers].mean(axis=0)
        palmar = max(AXES, key=lambda axis: axis @ closed - max(self.palm_skin @ axis))
        opened = self.tips({})[self.fingers]
        away = opened.mean(axis=0) - _middle(self.palm_skin)
        along = [axis for axis in AXES if not axis @ palmar]
        fingers = max(
            along, key=lambda axis: (round(axis @ away, 2), -np.ptp(opened @ axis))
        )
        return palmar, fingers

    def palm_point(self) -> Array:
        """Return a point (3,) of the palm's skin, m, between its middle and where fingers begin."""
        geoms = geoms_of(self.parts.model, self.frame.link)
        inward = -np.array(self.frame.direction(self.directions[0]))
        bases, middle = self.begins[self.fingers].mean(axis=0), _middle(self.palm_skin)
        place = np.array(self.frame.point((middle + bases) / 2))
        met = meet(geoms, place, inward)
        return middle if met is None else self.in_palm(met[0])

    # -- open and closed ---------------------------------------------------------------------

    @cached_property
    def bent(self) -> tuple[Angles, Angles]:
        """(open, closed) angles of the fingers' joints, if nothing stops them."""
        opened, closed = dict[str, float](), dict[str, float]()
        for number in self.fingers:
            share = 1.0
            for joint, (begin, end) in self.ends[number].items():
                opened[joint], closed[joint] = begin, begin + share * (end - begin)
                share = 1.0 if self.thumb is None else DISTAL_SHARE
        return opened, closed

    @cached_property
    def stop(self) -> float:
        """Share of that way that the fingers can go.

        There a fingertip is in the palm, or a finger deep in another.
        """
        fingers = [self.chains[number].links for number in self.fingers]
        pairs = [(self.frame.link, links[-1], IN_PALM) for links in fingers]
        for first, second in combinations(fingers, 2):
            pairs += [(*pair, IN_FINGER) for pair in product(first, second)]

        def is_deep(share: float) -> Array:
            data = self.posed(between(*self.bent, share))
            gaps = [gap(self.parts.model, data, a, b) + depth for a, b, depth in pairs]
            return np.array(gaps) < 0

        usual = is_deep(0.0)
        for step in range(1, N_STEPS + 1):
            if (is_deep(step / N_STEPS) & ~usual).any():
                return max(step - 1, 1) / N_STEPS
        return 1.0

    @cached_property
    def poses(self) -> dict[str, Angles]:
        """Joint angles of three poses, by the title of their table.

        Open and closed: the fingers until they touch, the thumb so that it meets them.
        At the start an object just fits in.
        """
        opened, closed = self.bent[0].copy(), between(*self.bent, self.stop)
        if self.thumb is not None:
            half = between(opened, closed, 0.5)
            opposed = self._opposed(self.thumb, half)
            axes = {j: self.turning(self.thumb, j, half | opposed) for j in opposed}
            *_, last = axes.values()
            for joint, angle in opposed.items():
                flexes = abs(axes[joint] @ last) > FLEXING
                opened[joint] = self.parts.inside(joint) if flexes else angle
                closed[joint] = angle
        start = self._wide_open(opened, closed) if len(self.chains) > 2 else opened
        return {"opened": opened, "closed": closed, "start": start}

    def _wide_open(self, opened: Angles, closed: Angles) -> Angles:
        """Return the pose on the way from closed to open in which an object just fits in."""
        first = self.thumb or 0
        for share in np.arange(HALF_OPEN, 1.0, 1 / N_STEPS):
            pose = between(closed, opened, float(share))
            tips = self.tips(pose)
            others = np.delete(tips, first, axis=0).mean(axis=0)
            if np.linalg.norm(tips[first] - others) > OPENING:
                return pose
        return opened

    def _opposed(self, thumb: int, fingers: Angles) -> Angles:
        """Return angles of the thumb's joints with which it opposes the first two fingers.

        Its tip comes nearest to theirs, which are half closed, from the other side.
        """
        first = [k for k, name in enumerate(self.digits) if name in ("index", "middle")]
        tips = self.tips(fingers)[first or self.fingers]
        goal = tips.mean(axis=0) + 0.01 * self.directions[0]
        joints = self.chains[thumb].joints
        limits = [self.limits(joint) for joint in joints]

        def away(angles: Array) -> float:
            pose = fingers | dict(zip(joints, angles.tolist(), strict=True))
            return float(np.linalg.norm(self.tips(pose)[thumb] - goal))

        best = minimize(away, np.mean(limits, axis=1), method="Powell", bounds=limits)
        return dict(zip(joints, best.x.tolist(), strict=True))

    # -- what comes of it --------------------------------------------------------------------

    def toml(self) -> str:
        """Return the text of a hand's file."""
        quoted = validation.quoted
        palmar, fingers = self.directions
        vectors = {
            "palmar": palmar,
            "fingers": fingers,
            "palm_point": self.palm_point(),
        }
        for key, vector in vectors.items():
            self.keys[key] = (vector.round(4) + 0.0).tolist()
        keys = self.keys.items()
        lines = [f"{key} = {quoted(value)}" for key, value in keys if value]
        lines += ["", "[digits]"]
        for name, chain in zip(self.digits, self.chains, strict=True):
            links, tip = quoted(chain.links), quoted(chain.tip)
            lines.append(f"{name} = {{ links = {links}, tip = {tip} }}")
        for title, pose in self.poses.items():
            lines += ["", f"[{title}]"]
            lines += [f"{quoted(joint)} = {angle:.4f}" for joint, angle in pose.items()]
        return "\n".join(lines) + "\n"


def _middle(points: Array) -> Array:
    return (points.min(axis=0) + points.max(axis=0)) / 2


# -- how the parts hang ----------------------------------------------------------------------


def _palm_of(spec: mujoco.MjSpec) -> str:
    """Return the body of the link from which most digits branch, furthest from the root."""
    bases: dict[str, list[str]] = {}  # bodies on which digits begin, by their link
    for body in spec.bodies[1:]:
        above = body.parent
        if list(body.joints) and above.name != "world" and body.find_all("geom"):
            bases.setdefault(mount.link_of(above).name, []).append(above.name)

    def rank(link: str) -> tuple[int, int]:
        return len(bases[link]), len(mount.chain(spec.body(link)))

    link = max(bases, key=rank, default="")
    if len(bases.get(link, ())) < 2:
        raise ValueError(
            "palm: found no body from which two digits branch; name it with --palm"
        )
    return mode(bases[link])


def _root_of(palm: mujoco.MjsBody) -> mujoco.MjsBody:
    """Return where the hand of a palm begins if it is cut off what it hangs on.

    That is the palm, or the link that it is part of where more digits hang on other
    parts of that link. As many are those of another hand.
    """
    link = mount.link_of(palm)
    n_others = _n_joints(link) - _n_joints(palm)
    has_other_hand = n_others >= _n_joints(palm) and len(palm.bodies) > 1
    return palm if n_others == 0 or has_other_hand else link


def _n_joints(body: mujoco.MjsBody) -> int:
    """Return how many joints move what hangs on a body."""
    return sum(len(child.find_all("joint")) for child in body.bodies)


class Chain(NamedTuple):
    """A digit."""

    links: tuple[str, ...]
    """Links with a shape, from the palm on."""
    joints: tuple[str, ...]
    """Driven joints that move it."""
    tip: tuple[float, ...]
    """The fingertip in the frame of the last link, m."""
    name: str
    """The digit that its links or joints are named after, or ""."""


def chains_of(parts: Parts, palm: str) -> list[Chain]:
    """Return the digits that hang on a palm: of what a closed loop joins, the furthest chain.

    What carries several of them belongs to none. Raises ValueError for fewer than two.
    """
    spec, data, loops = parts.spec, posed(parts.model, {}), mount.loops(parts.spec)
    above = mount.chain(spec.body(palm))
    groups: dict[Any, list[list[str]]] = {}
    for body in spec.body(palm).find_all("body"):
        if not list(body.bodies):
            path = mount.chain(body)[len(above) :]
            joining = [number for number, loop in enumerate(loops) if loop & {*path}]
            groups.setdefault(joining[0] if joining else body.name, []).append(path)

    def reach(chain: Chain) -> float:
        tip = placed(data, chain.links[-1], chain.tip)
        return float(np.linalg.norm(tip - data.body(palm).xpos))

    members = [set[str]().union(*paths) for paths in groups.values()]
    carried = Counter(link for links in members for link in links)
    shared = {link for link in carried if carried[link] > 1}
    digits = list[Chain]()
    for paths, links in zip(groups.values(), members, strict=True):
        own = ([link for link in path if link not in shared] for path in paths)
        chains = filter(None, (_chain(parts, path, links - shared) for path in own))
        digits += sorted(chains, key=reach, reverse=True)[:1]
    if len(digits) < 2:
        raise ValueError(
            f"digits: found {len(digits)} from body {palm!r}, allowed 2 or more"
        )
    return digits


def _chain(parts: Parts, path: list[str], group: set[str]) -> Chain | None:
    """Return the digit of a path from the palm to a leaf, with those links that have a shape.

    None where none has, or nothing drives it or what a closed loop joins to it.
    """
    links = [name for name in path if geoms_of(parts.model, name)][-MAX_LINKS:]
    drivers = {coupling.joint: coupling.driver for coupling in parts.follows}
    moving = [j.name for j in parts.spec.joints if j.parent.name in group]
    joints = dict.fromkeys(drivers.get(joint, joint) for joint in moving)
    driven = tuple(joint for joint in joints if joint in parts.driven)
    if not links or not driven:
        return None
    return Chain(tuple(links), driven, _tip(parts, links[-1]), _named(links + moving))


def _named(texts: list[str]) -> str:
    """Return the digit that the first of some names to do so names, or ""."""
    words = [word for text in texts for word in re.split(r"[-:._]", text.lower())]
    for word, (digit, known) in product(words, WORDS.items()):
        if re.fullmatch(rf"({known})[\dj]*|{digit}.*", word):
            return digit
    return ""


def _tip(parts: Parts, link: str) -> tuple[float, ...]:
    """Return the end of a link, seen from its joint."""
    geoms = geoms_of(parts.model, link)
    points: Array = np.concatenate([geom.points for geom in geoms])
    middle = _middle(points)
    away = unit(middle, link)
    end = meet(geoms, middle, -away)
    return tuple(np.round(middle if end is None else end[0] - 1e-3 * away, 4).tolist())
