"""Guess a hand's file from its model alone: from how its parts hang, are called and move.

Digits are chains that branch from the palm. Of the palm's axes, fingers point along one, and they
bend, or where they close on each other point, to the palmar side.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from .. import validation
from ..state import Array
from . import model_file, mount
from .geometry import gap, geoms_of, meet, placed, posed, unit
from .hand import DIGITS
from .parts import Angles, HandFile, Parts

WORDS = {
    "thumb": "thumb th pollex",
    "index": "index fore ff if pointer",
    "middle": "middle mf mid",
    "ring": "ring rf",
    "little": "little pinky lf small",
}
MOST = 4  # links of a digit
AT_JOINT = 5e-3  # m: a link with its middle there points to where it is longest
WRIST = 2  # joints above the palm that are no arm
ASYMMETRIC = 1.3  # of a range's ends: such a joint flexes
NUDGE = 0.3  # rad, and at most a quarter of a range: how far a joint is tried
STEPS = 20  # of a digit's way to its closed end
TOUCHES, DEEP = 2e-3, 8e-3
"""m that fingers may be in the palm, and in each other, before they stop."""
LEAST = 0.4  # share of the way that they go all the same
SAMPLES = 600  # of the thumb's joints
NEARER = 5e-3  # m
OPPOSED = 0.45  # length of the mean of the ways that digits go, below which they oppose each other
ALONE = 0.5  # cosine by which a thumb goes another way than the other digits do
BEYOND = 0.5  # of the way of a finger's first joint, what those beyond it go
HALF_OPEN, OPENING = 0.5, 0.11
"""How open a hand is at least, and m between its thumb and fingers."""
PARALLEL = 0.7  # cosine between axes of a thumb's joints that flex
TURNED = 0.5  # cosine to the axis of a digit's last hinge, below which a hinge spreads or opposes


def describe(model: str, folder: Path, said: dict[str, Any]) -> tuple[str, list[str]]:
    """Return the text of a hand's file in a folder, and notes on what was guessed; `said`: keys that
    are known. ValueError naming what the model does not say."""
    guess = Guess(model, folder, said)
    return guess.toml(), guess.notes


@dataclass
class Guess:
    """What a model says of itself; ValueError naming what it does not say."""

    model: str
    """As in the hand's file."""
    folder: Path
    said: dict[str, Any]
    """Keys that are known already."""
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.data: dict[str, Any] = {"model": self.model, **self.said}
        if self.data.pop("servos", None):  # the library's
            self._leave_out([actuator.name for actuator in self._unfused().actuators])
        roots = list(model_file.read(self._parts().unread.model).worldbody.bodies)
        if len(roots) > 1 and any(map(mount.is_loose, roots)):
            root = max(roots, key=lambda body: len(list(body.find_all("joint"))))
            self.data["root"] = root.name
            self.notes.append(f"root: left out what is beside {root.name}")
        if empty := [body.name for body in mount.weightless(self._unfused())]:
            self._leave_out(empty)
            self.notes.append(
                f"drop: left out links without mass or shape: {', '.join(empty)}"
            )
        spec = self._unfused()
        palm = self.data.get("palm") or palm_of(spec)
        self.data["palm"] = palm
        if spec.body(palm) is None:
            raise ValueError(f"palm: found no body {palm!r} in the model")
        carrying = mount.chain(spec.body(palm))
        above = sum(len(list(spec.body(name).joints)) for name in carrying)
        if above > WRIST:
            self.data["root"] = palm
            self.notes.append(f"root: cut off {above} joints above the palm")
        self.parts = self._parts()
        self.compiled, self.palm = self.parts.model, self.parts.palm_frame.link
        self.chains = chains_of(self.parts, self.palm)

    def _parts(self) -> Parts:
        """Return what is known so far; the rest stands for nothing."""
        unknown = {"palm": "", "palm_point": [0, 0, 0], "digits": {}}
        axes = {"palmar": [1, 0, 0], "fingers": [0, 1, 0]}
        file = validation.fill(HandFile, {**unknown, **axes, **self.data})
        return Parts(file, self.folder)

    def _unfused(self) -> Any:
        return self._parts().unread.unfused()

    def _leave_out(self, names: list[str]) -> None:
        self.data["drop"] = [*self.data.get("drop", []), *names]

    # -- the digits, and where they go -------------------------------------------------------

    @cached_property
    def digits(self) -> list[str]:
        """Names by words in the names of links and joints; else the digit that goes another way than
        the others is the thumb."""
        names = [chain.name for chain in self.chains]
        if None in names or len(set(names)) < len(names):
            alike = (self.ways @ self.ways.T).sum(axis=1)
            thumb = int(np.argmin(alike)) if len(names) > 2 else 0
            others = np.delete(alike, thumb).mean()
            names = [*DIGITS[1:], *map("finger{}".format, range(len(names)))]
            if len(self.chains) == 2 or alike[thumb] < others - ALONE:
                names.insert(thumb, DIGITS[0])
        return [str(name) for name in names[: len(self.chains)]]

    @cached_property
    def thumb(self) -> int | None:
        """Which digit opposes the fingers of a hand like ours; None for what closes like a gripper."""
        is_like_ours = len(self.digits) > 2 and not self.grips
        return (
            self.digits.index("thumb")
            if is_like_ours and "thumb" in self.digits
            else None
        )

    def in_palm(self, data: mujoco.MjData, places: Any) -> Array:
        """Return places (n, 3) of the world in the palm's frame, m."""
        palm = data.body(self.palm)
        return np.asarray((np.array(places) - palm.xpos) @ palm.xmat.reshape(3, 3))

    def posed(self, angles: Angles) -> mujoco.MjData:
        """Return the hand with these joint angles, the others as near to 0 as they can be."""
        rest = {joint: self.parts.inside(joint) for joint in self.parts.joints} | angles
        return posed(self.compiled, rest | self.parts.followed(rest))

    def tips(self, angles: Angles) -> Array:
        """Return where fingertips are (n, 3), m, in the palm's frame."""
        data = self.posed(angles)
        tips = [placed(data, chain.links[-1], chain.tip) for chain in self.chains]
        return self.in_palm(data, tips)

    def _axis(self, joint: str, angles: Angles) -> Array:
        return np.array(self.posed(angles).joint(joint).xaxis)

    def _limits(self, joint: str) -> tuple[float, float]:
        low, high = self.parts.range_of(joint)
        actuator = self.compiled.actuator(self.parts.driven[joint])
        if not actuator.ctrllimited[0]:
            return low, high
        least, most = actuator.ctrlrange.tolist()
        return max(low, least), min(high, most)

    @cached_property
    def ends(self) -> list[dict[str, tuple[float, float]]]:
        """(open, closed) of the joints that flex each digit."""
        return [self._ends(number) for number in range(len(self.chains))]

    def _ends(self, number: int) -> dict[str, tuple[float, float]]:
        """Return the ends of slides, and of hinges that turn about the axis of the last. What slides,
        and two digits that are all, go to where the tip is nearer to the others'. Other hinges go from
        near 0 to the end that is further away; where both are as far, the way of the others, or also
        nearer."""
        joints = self.chains[number].joints
        axes = {joint: self._axis(joint, {}) for joint in joints}
        slides = {j for j in joints if self.parts.spec.joint(j).type == mount.LINEAR}
        hinges = [axes[joint] for joint in joints if joint not in slides]
        ends: dict[str, tuple[float, float]] = {}
        unclear, turning = {}, np.zeros(3)
        for joint in joints:
            if joint not in slides and abs(axes[joint] @ hinges[-1]) <= TURNED:
                continue
            (low, high), begin = self._limits(joint), self.parts.inside(joint)
            up, down = high - begin, begin - low
            nearer = self._nearer(number, joint, begin, min(NUDGE, (high - low) / 4))
            is_clear = abs(nearer) > NEARER
            if joint in slides or (len(self.chains) == 2 and is_clear):
                way, other = (up, low) if nearer > 0 else (-down, high)
                is_long = abs(way) >= abs(other - begin)
                ends[joint] = begin if is_long else other, begin + way
            elif max(up, down) > ASYMMETRIC * min(up, down):
                ends[joint] = begin, high if up > down else low
                turning += np.sign(up - down) * axes[joint]
            else:
                unclear[joint] = begin, low, high, nearer if is_clear else 0.0
        for joint, (begin, low, high, nearer) in unclear.items():
            along = float(axes[joint] @ turning) if turning.any() else nearer
            if along:
                ends[joint] = begin, high if along > 0 else low
        return {joint: ends[joint] for joint in joints if joint in ends}

    def _nearer(self, number: int, joint: str, begin: float, step: float) -> float:
        """Return how much nearer a digit's tip comes to the middle of all as a joint goes up than down,
        m."""
        middle = self.tips({}).mean(axis=0)
        down, up = (self.tips({joint: begin + way})[number] for way in (-step, step))
        return float(np.linalg.norm(down - middle) - np.linalg.norm(up - middle))

    @cached_property
    def ways(self) -> Array:
        """Unit vectors (n, 3): where the tips go when the digits close by half."""
        half = {
            joint: (a + b) / 2 for ends in self.ends for joint, (a, b) in ends.items()
        }
        return _rows(self.tips(half) - self.tips({}))

    @cached_property
    def pointing(self) -> Array:
        """The axis of the palm's frame, a unit vector (3,), along which the digits point."""
        data = self.posed({})
        begin = [data.body(chain.links[0]).xpos for chain in self.chains]
        return _axis(_rows(self.tips({}) - self.in_palm(data, begin)).mean(axis=0))

    @cached_property
    def beside(self) -> Array:
        """What of their ways (n, 3) is at right angles to where the digits point."""
        return self.ways * (self.pointing == 0)

    @cached_property
    def grips(self) -> bool:
        """Whether the digits close on each other, and not all to one side."""
        return bool(np.linalg.norm(_rows(self.beside).mean(axis=0)) < OPPOSED)

    @cached_property
    def directions(self) -> tuple[Array, Array]:
        """(palmar, fingers), axes (3,) of the palm's frame: fingers bend to the palmar side; where they
        close on each other, as a gripper's, they point there."""
        if not self.grips:
            return _axis(self.beside.mean(axis=0)), self.pointing
        apart = np.abs(self.beside).sum(axis=0) + 1e-9 * (self.pointing == 0)
        return self.pointing, np.cross(self.pointing, _axis(apart))

    # -- open and closed ---------------------------------------------------------------------

    @cached_property
    def poses(self) -> tuple[Angles, Angles, Angles]:
        """(open, closed, start): the fingers from near 0 to the end that bends them, or until they
        touch; the thumb so that it meets them. A grasp starts where an object just fits in."""
        opened, closed = dict[str, float](), dict[str, float]()
        for number, ends in enumerate(self.ends):
            share = 1.0
            for joint, (begin, end) in ends.items() if number != self.thumb else ():
                opened[joint], closed[joint] = begin, begin + share * (end - begin)
                share = 1.0 if self.thumb is None else BEYOND
        closed = _between(opened, closed, self._until_contact(opened, closed))
        if self.thumb is not None:
            half = _between(opened, closed, 0.5)
            mine = self._opposed(self.thumb, half)
            axes = {joint: self._axis(joint, mine | half) for joint in mine}
            for joint, end in mine.items():
                flexes = abs(axes[joint] @ axes[list(mine)[-1]]) > PARALLEL
                opened[joint] = self.parts.inside(joint) if flexes else end
                closed[joint] = end
        start = self._wide_open(opened, closed) if len(self.chains) > 2 else opened
        opened, closed, start = (
            {joint: round(angle, 4) for joint, angle in pose.items()}
            for pose in (opened, closed, start)
        )
        return opened, closed, start

    def _wide_open(self, opened: Angles, closed: Angles) -> Angles:
        """Return the pose on the way from closed to open in which an object just fits in."""
        first = self.thumb or 0
        for share in np.arange(HALF_OPEN, 1.0, 1 / STEPS):
            tips = self.tips(pose := _between(closed, opened, float(share)))
            others = np.delete(tips, first, axis=0).mean(axis=0)
            if np.linalg.norm(tips[first] - others) > OPENING:
                return pose
        return opened

    def _opposed(self, thumb: int, fingers: Angles) -> Angles:
        """Return angles of the thumb's joints with which its tip comes nearest to those of the first
        two fingers, half closed, and from the other side."""
        first = [k for k, name in enumerate(self.digits) if name in ("index", "middle")]
        first = first or [k for k in range(len(self.chains)) if k != thumb]
        goal = self.tips(fingers)[first].mean(axis=0) + 0.01 * self.directions[0]
        joints, rng = self.chains[thumb].joints, np.random.default_rng(0)
        low, high = np.array([self._limits(joint) for joint in joints]).T
        least, best = math.inf, low
        for number in range(SAMPLES):
            if number < SAMPLES // 2:
                angles = rng.uniform(low, high)
            else:
                step = rng.normal(0, 0.1, len(joints)) * (high - low)
                angles = np.clip(best + step, low, high)
            drawn = dict(zip(joints, angles.tolist(), strict=True))
            away = float(np.linalg.norm(self.tips(fingers | drawn)[thumb] - goal))
            if away < least:
                least, best = away, angles
        return dict(zip(joints, best.tolist(), strict=True))

    def _until_contact(self, opened: Angles, closed: Angles) -> float:
        """Return which share of their way the fingers can go before a fingertip is in the palm, or a
        finger deep in another."""
        fingers = [c for number, c in enumerate(self.chains) if number != self.thumb]
        pairs = [(self.palm, chain.links[-1], TOUCHES) for chain in fingers]
        for first, second in combinations(fingers, 2):
            pairs += [(*pair, DEEP) for pair in product(first.links, second.links)]

        def stopped(share: float) -> set[tuple[str, str]]:
            data = self.posed(_between(opened, closed, share))
            return {
                (a, b)
                for a, b, depth in pairs
                if gap(self.compiled, data, a, b) < -depth
            }

        usual = stopped(0.0)
        for step in range(1, STEPS + 1):
            if stopped(step / STEPS) - usual:
                return max((step - 1) / STEPS, 1 / STEPS if self.grips else LEAST)
        return 1.0

    # -- what comes of it --------------------------------------------------------------------

    def toml(self) -> str:
        """Return the text of a hand's file."""
        frame, (palmar, fingers) = self.parts.palm_frame, self.directions
        guessed = {
            "palmar": palmar,
            "fingers": fingers,
            "palm_point": self._palm_point() - frame.place,
        }
        known = {key: value for key, value in self.data.items() if value}
        for key, vector in guessed.items():
            known[key] = (frame.turn.T @ vector).round(4).tolist()
        lines = [f"{key} = {json.dumps(value)}" for key, value in known.items()]
        lines += ["", "[digits]"]
        for name, chain in zip(self.digits, self.chains, strict=True):
            links = json.dumps(list(chain.links))
            lines.append(f"{name} = {{ links = {links}, tip = {list(chain.tip)} }}")
        titles = ("opened", "closed", "start")
        for title, pose in zip(titles, self.poses, strict=True):
            angles = [f"{json.dumps(joint)} = {angle}" for joint, angle in pose.items()]
            lines += ["", f"[{title}]", *angles]
        return "\n".join(lines) + "\n"

    def _palm_point(self) -> Array:
        """Return the skin of the palm at the middle of where the fingers begin and the palm's own
        middle, or near there."""
        geoms, data = geoms_of(self.compiled, self.palm), self.posed({})
        begin = [data.body(chain.links[0]).xpos for chain in self.chains]
        if "thumb" in self.digits:
            del begin[self.digits.index("thumb")]
        bases = self.in_palm(data, begin).mean(axis=0)
        if not geoms:
            return np.asarray(bases)
        middle = _middle(np.concatenate([geom.points for geom in geoms]))
        places = [middle + share * (bases - middle) for share in (0.5, 0.25, 0.0, 0.75)]
        places += [np.array(geom.position) for geom in geoms]
        met = [meet(geoms, place, -self.directions[0]) for place in places]
        return next((place for place, _ in filter(None, met)), middle)


def _between(opened: Angles, closed: Angles, share: float) -> Angles:
    return {
        joint: opened[joint] + share * (end - opened[joint])
        for joint, end in closed.items()
    }


def _rows(vectors: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-9))


def _axis(direction: Array) -> Array:
    """Return the axis of the frame that is nearest to a direction, (3,)."""
    nearest = int(np.argmax(np.abs(direction)))
    return np.sign(direction[nearest]) * np.eye(3)[nearest]


def _middle(points: Array) -> Array:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


# -- how the parts hang ----------------------------------------------------------------------


class Chain(NamedTuple):
    """A digit."""

    links: tuple[str, ...]
    """Those with a shape, from the palm on."""
    joints: tuple[str, ...]
    """Driven ones, that move it."""
    tip: tuple[float, ...]
    """In the frame of the last link, m."""

    @property
    def name(self) -> str | None:
        """What its links or joints call it."""
        for text in (*self.links, *self.joints):
            for word in re.split(r"[-:._]", text.lower()):
                for digit, known in WORDS.items():
                    is_known = {word, word.rstrip("0123456789j")} & {*known.split()}
                    if is_known or word.startswith(digit):
                        return digit
        return None


def palm_of(spec: mujoco.MjSpec) -> str:
    """Return the body from which most digits branch; ValueError where none has two."""
    branches: dict[str, list[str]] = {}
    for body in spec.bodies[1:]:
        if list(body.joints) and body.parent.name != "world" and body.find_all("geom"):
            carrier = body.parent
            while mount.is_fixed(carrier):
                carrier = carrier.parent
            branches.setdefault(carrier.name, []).append(body.parent.name)
    most = max(branches.values(), key=len, default=[])
    if len(most) < 2:
        raise ValueError(
            "palm: found no body from which two digits branch; name it with --palm"
        )
    return max(most, key=most.count)


def chains_of(parts: Parts, palm: str) -> list[Chain]:
    """Return the digits that hang on a palm: of what a closed loop joins, the chain that reaches
    furthest; ValueError for fewer than two."""
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

    digits = []
    for paths in groups.values():
        group = set[str]().union(*paths)
        chains = [_chain(parts, path, group) for path in paths]
        if made := [chain for chain in chains if chain]:
            digits.append(max(made, key=reach))
    if len(digits) < 2:
        raise ValueError(
            f"digits: found {len(digits)} from body {palm!r}, allowed 2 or more"
        )
    return digits


def _chain(parts: Parts, path: list[str], group: set[str]) -> Chain | None:
    """Return the digit of a path from the palm to a leaf, of what has a shape; None where nothing has,
    or drives it or what a closed loop joins to it."""
    links = [name for name in path if geoms_of(parts.model, name)][-MOST:]
    follows = {coupling.joint: coupling.driver for coupling in parts.follows}
    moving = [j.name for j in parts.spec.joints if j.parent.name in group]
    drivers = dict.fromkeys(follows.get(joint, joint) for joint in moving)
    joints = tuple(joint for joint in drivers if joint in parts.driven)
    if not links or not joints:
        return None
    return Chain(tuple(links), joints, _tip(parts, links[-1]))


def _tip(parts: Parts, link: str) -> tuple[float, ...]:
    """Return the end of a link, seen from its joint."""
    geoms = geoms_of(parts.model, link)
    points: Array = np.concatenate([geom.points for geom in geoms])
    middle = away = _middle(points)
    if np.linalg.norm(middle) <= AT_JOINT:
        away = points[np.argmax(np.linalg.norm(points, axis=1))]
    away = unit(away, link)
    end = meet(geoms, middle, -away)
    return tuple(np.round(middle if end is None else end[0] - 1e-3 * away, 4).tolist())
