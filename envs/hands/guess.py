"""Guess a hand's file from its model alone: from how its parts hang, are called and move.

Digits are the chains that branch from the palm. Each axis of the palm is tried as its palmar side; the
one on which the fingertips lie furthest in front of the palm while they close is kept.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from .. import validation
from ..state import Array
from . import model_file, mount
from .geometry import gap, geoms_of, meet, placed, posed, unit
from .hand import DIGITS
from .parts import Angles, HandFile, Parts, between

WORDS = {
    "thumb": "thumb th pollex",
    "index": "index fore ff if pointer",
    "middle": "middle mf mid",
    "ring": "ring rf",
    "little": "little pinky lf small",
}
MOST = 4  # links of a digit
AT_JOINT = 5e-3  # m: a link with its middle there points to where it is longest
WRIST = 2  # joints outside of a hand that are no arm
LEANING = 0.13  # share of its joints' ranges by which a digit bends further one way than the other
STEP = 0.01  # rad or m, by which a joint goes to see what it turns
NUDGE = 0.3  # rad, and at most a quarter of a range: how far a joint is tried
STEPS = 20  # of a digit's way to its closed end
TOUCHES, DEEP = 2e-3, 8e-3
"""m that fingers may be in the palm, and in each other, before they stop."""
LEAST = 0.4  # share of the way that the fingers of a hand with a thumb go all the same
NEARER = 5e-3  # m
ALONE = 0.5  # cosine by which a thumb goes another way than the other digits do
BEYOND = 0.5  # of the way of a finger's first joint, what those beyond it go
HALF_OPEN, OPENING = 0.5, 0.11
"""Least share of opening at the start, and distance between thumb and fingers there, m."""
PARALLEL = 0.7  # cosine between axes of a thumb's joints that flex
TURNED = 0.5  # cosine to the axis of a digit's last hinge, below which a hinge spreads or opposes
NEARLY = 0.75, 1.0  # shares of their way on which fingers lie in front of the palm
AXES = [*np.eye(3), *-np.eye(3)]


def describe(model: str, folder: Path, known: dict[str, Any]) -> tuple[str, list[str]]:
    """Return the text of a hand's file in a folder, and notes on what was guessed.

    `model` is written as in the file, `known` has keys of the file that are not to be guessed. Raises
    ValueError naming what the model does not say.
    """
    guess = Guess(model, folder, known)
    return guess.toml(), guess.notes


@dataclass
class Guess:
    """Find out what a model says of itself; ValueError naming what it does not say."""

    model: str
    folder: Path
    known: dict[str, Any]
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.keys: dict[str, Any] = {"model": self.model, **self.known}
        if self.keys.pop("servos", None):  # the library's
            self._drop([actuator.name for actuator in self._spec().actuators])
        roots = list(model_file.read(self._parts().unread.model).worldbody.bodies)
        if len(roots) > 1 and all(map(mount.is_loose, roots)):
            root = max(roots, key=lambda body: len(list(body.find_all("joint"))))
            self.keys["root"] = root.name
            self.notes.append(f"root: left out what is beside {root.name}")
        if empty := [body.name for body in mount.weightless(self._spec())]:
            self._drop(empty)
            names = ", ".join(empty)
            self.notes.append(f"drop: left out links without mass or shape: {names}")
        self._find_palm(self._spec())
        self.parts = self._parts()
        self.frame, self.compiled = self.parts.palm_frame, self.parts.model
        self.palm = self.frame.link
        self.chains = chains_of(self.parts, self.palm)

    def _parts(self) -> Parts:
        """Return what is known so far; the rest stands for nothing."""
        unknown = {"palm": "", "palm_point": [0, 0, 0], "digits": {}}
        axes = {"palmar": [1, 0, 0], "fingers": [0, 1, 0]}
        file = validation.fill(HandFile, {**unknown, **axes, **self.keys})
        return Parts(file, self.folder)

    def _spec(self) -> mujoco.MjSpec:
        return self._parts().unread.unfused()

    def _drop(self, names: list[str]) -> None:
        self.keys["drop"] = [*self.keys.get("drop", []), *names]

    def _find_palm(self, spec: mujoco.MjSpec) -> None:
        """Take the body from which most digits branch as the palm, and it or the link that it is part
        of as the root where it hangs on an arm; ValueError where none has two digits."""
        if "palm" not in self.keys:
            self.keys["palm"] = self._palm_of(spec)
        palm = spec.body(self.keys["palm"])
        if palm is None:
            raise ValueError(f"palm: found no body {self.keys['palm']!r} in the model")
        link = mount.link_of(palm)
        on_palm, on_link = (
            sum(len(list(child.find_all("joint"))) for child in body.bodies)
            for body in (palm, link)
        )
        has_other = on_link >= 2 * on_palm and len(list(palm.bodies)) > 1
        if on_palm == on_link or has_other:  # another hand on the same link
            link, on_link = palm, on_palm
        if len(list(spec.joints)) - on_link > WRIST:
            self.keys["root"] = link.name
            self.notes.append(f"root: cut off what {link.name} hangs on")

    def _palm_of(self, spec: mujoco.MjSpec) -> str:
        branches: dict[str, list[str]] = {}
        for body in spec.bodies[1:]:
            parent = body.parent
            if list(body.joints) and parent.name != "world" and body.find_all("geom"):
                branches.setdefault(mount.link_of(parent).name, []).append(parent.name)

        def rank(link: str) -> tuple[int, int]:
            return len(branches[link]), len(mount.chain(spec.body(link)))

        best = max(map(rank, branches), default=(0, 0))
        if best[0] < 2:
            raise ValueError(
                "palm: found no body from which two digits branch; name it with --palm"
            )
        parents = [branches[link] for link in branches if rank(link) == best]
        palms = [max(names, key=names.count) for names in parents]
        for names, first in zip(parents, palms.copy(), strict=True):
            n_digits = max(2, names.count(first))
            others = [name for name in dict.fromkeys(names) if name != first]
            palms += [name for name in others if names.count(name) == n_digits]
        if len(palms) > 1:
            self.notes.append(
                f"palm: found {len(palms)} ({', '.join(palms)}), took the first; --palm names another"
            )
        return palms[0]

    # -- the digits, and where they go -------------------------------------------------------

    @cached_property
    def digits(self) -> list[str]:
        """Names of the digits: by words in the names of links and joints, the others by what is left,
        from the thumb on. Without such a word the thumb is the digit that goes another way than all
        others."""
        names = [chain.name for chain in self.chains]
        names = [name if names.count(name) == 1 else "" for name in names]
        if "thumb" not in names:
            alike = (self.ways @ self.ways.T).sum(axis=1)
            thumb = int(np.argmin(alike)) if len(names) > 2 else 0
            others = np.delete(alike, thumb).mean()
            if len(names) == 2 or alike[thumb] < others - ALONE:
                names[thumb] = "thumb"
        away = np.zeros(len(names))
        if "thumb" in names:
            first = self.begins[names.index("thumb")]
            away = np.linalg.norm(self.begins - first, axis=1).round(3)
        more = map("finger{}".format, range(len(names)))
        left = iter([name for name in (*DIGITS[1:], *more) if name not in names])
        for number in np.argsort(away, kind="stable"):
            names[number] = names[number] or next(left)
        return names

    @cached_property
    def thumb(self) -> int | None:
        """Number of the digit that opposes the others; None where there are two, or none does."""
        has_thumb = len(self.digits) > 2 and "thumb" in self.digits
        return self.digits.index("thumb") if has_thumb else None

    @cached_property
    def fingers(self) -> list[int]:
        """Numbers of the digits but the thumb."""
        return [number for number in range(len(self.chains)) if number != self.thumb]

    def posed(self, angles: Angles) -> mujoco.MjData:
        """Return the hand with these joint angles, the others as near to 0 as they can be."""
        rest = {joint: self.parts.inside(joint) for joint in self.parts.joints} | angles
        return posed(self.compiled, rest | self.parts.followed(rest))

    def in_palm(self, data: mujoco.MjData, places: Any) -> Array:
        """Return places (n, 3) of the world in the frame of the body that is called the palm, m."""
        link = data.body(self.palm)
        in_link = (np.array(places) - link.xpos) @ link.xmat.reshape(3, 3)
        return np.asarray((in_link - self.frame.place) @ self.frame.turn)

    def tips(self, angles: Angles) -> Array:
        """Return where fingertips are (n, 3), m, in the palm's frame."""
        data = self.posed(angles)
        tips = [placed(data, chain.links[-1], chain.tip) for chain in self.chains]
        return self.in_palm(data, tips)

    @cached_property
    def begins(self) -> Array:
        """Places (n, 3) where digits begin, m, in the palm's frame."""
        data = self.posed({})
        places = [data.body(chain.links[0]).xpos for chain in self.chains]
        return self.in_palm(data, places)

    def turning(self, number: int, joint: str, angles: Angles) -> Array:
        """Return the axis (3,) about which a digit's last link turns as a joint goes up, as long as it
        turns rad per rad; zeros where it slides."""
        link, angle = self.chains[number].links[-1], self.parts.inside(joint)
        turns = [
            self.posed({joint: angle} | angles | step).body(link).xmat.reshape(3, 3)
            for step in ({}, {joint: angles.get(joint, angle) + STEP})
        ]
        return Rotation.from_matrix(turns[1] @ turns[0].T).as_rotvec() / STEP

    def limits(self, joint: str) -> tuple[float, float]:
        """Return between which angles a joint is driven, rad or m."""
        low, high = self.parts.range_of(joint)
        actuator = self.compiled.actuator(self.parts.driven[joint])
        if not actuator.ctrllimited[0]:
            return low, high
        least, most = actuator.ctrlrange.tolist()
        return max(low, least), min(high, most)

    @cached_property
    def ends(self) -> list[dict[str, tuple[float, float]]]:
        """(open, closed) of the joints that flex each digit, rad or m."""
        return [self._ends(number) for number in range(len(self.chains))]

    def _ends(self, number: int) -> dict[str, tuple[float, float]]:
        """Return (open, closed) of slides, and of hinges that turn about the axis of the last.

        Slides, and two digits that are all, close where the tip comes nearer to the others'. The hinges
        of other digits close together, to the side on which there is more of their ranges.
        """
        joints = self.chains[number].joints
        axes = {joint: self.turning(number, joint, {}) for joint in joints}
        axes = {joint: axis for joint, axis in axes.items() if axis @ axis > TURNED**2}
        turns = {joint: axis @ [*axes.values()][-1] for joint, axis in axes.items()}
        groups = [{joint: 1.0} for joint in joints if joint not in axes]
        groups.append(
            {j: np.sign(turn) for j, turn in turns.items() if abs(turn) > TURNED}
        )
        ends = {}
        for group in groups:
            begins = {joint: self.parts.inside(joint) for joint in group}
            limits = {joint: self.limits(joint) for joint in group}
            steps = {
                j: min(NUDGE, (high - low) / 4) for j, (low, high) in limits.items()
            }
            middle = self.tips({}).mean(axis=0)
            down, up = (
                self.tips({j: begins[j] + way * group[j] * steps[j] for j in group})[
                    number
                ]
                for way in (-1, 1)
            )
            nearer = np.linalg.norm(down - middle) - np.linalg.norm(up - middle)
            further = sum(group[j] * (sum(limits[j]) - 2 * begins[j]) for j in group)
            lean = further / max(1e-9, sum(map(np.ptp, limits.values())))
            by_tip = axes.keys().isdisjoint(group) or len(self.chains) == 2
            is_clear = abs(nearer) > NEARER
            way = nearer if is_clear and (by_tip or abs(lean) < LEANING) else lean
            for joint in group if way else ():
                other, end = limits[joint][:: 1 if way * group[joint] > 0 else -1]
                begin = begins[joint]
                is_long = abs(end - begin) >= abs(other - begin)
                ends[joint] = begin if is_long else other, end
        return {joint: ends[joint] for joint in joints if joint in ends}

    @cached_property
    def ways(self) -> Array:
        """Unit vectors (n, 3) from the open to the half closed fingertips."""
        half = {
            joint: (a + b) / 2 for ends in self.ends for joint, (a, b) in ends.items()
        }
        vectors = self.tips(half) - self.tips({})
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        return np.asarray(vectors / np.maximum(lengths, 1e-9))

    # -- the palm ----------------------------------------------------------------------------

    @cached_property
    def palm_skin(self) -> Array:
        """Corners (n, 3) of the palm's shapes, m, in its frame."""
        geoms = geoms_of(self.compiled, self.palm)
        points = [geom.points for geom in geoms] or [np.array([self.frame.place])]
        return np.asarray((np.concatenate(points) - self.frame.place) @ self.frame.turn)

    @cached_property
    def directions(self) -> tuple[Array, Array]:
        """(palmar, fingers), axes (3,) of the palm's frame.

        Fingers that close lie in front of the palmar side. Open ones lie in the direction of fingers;
        where they lie all around, that is across the way on which they close.
        """
        most = self.stop if self.thumb is None else 1.0
        closing = [self.tips(between(*self.bent, most * share)) for share in NEARLY]
        closed = np.mean(closing, axis=0)[self.fingers].mean(axis=0)
        palmar = max(AXES, key=lambda axis: axis @ closed - max(self.palm_skin @ axis))
        opened = self.tips({})[self.fingers]
        away = opened.mean(axis=0) - _middle(self.palm_skin)
        along = [axis for axis in AXES if not axis @ palmar]
        fingers = max(
            along, key=lambda axis: (round(axis @ away, 2), -np.ptp(opened @ axis))
        )
        return palmar, fingers

    def palm_point(self) -> Array:
        """Return the skin of the palm (3,), m, at the middle of where the fingers begin and its own
        middle, or near there."""
        geoms, frame = geoms_of(self.compiled, self.palm), self.frame
        bases, middle = self.begins[self.fingers].mean(axis=0), _middle(self.palm_skin)
        if not geoms:
            return np.asarray(bases)
        inward = -np.array(frame.direction(self.directions[0]))
        shares = (0.5, 0.25, 0.0, 0.75)
        places = [frame.point(middle + share * (bases - middle)) for share in shares]
        places += [geom.position for geom in geoms]
        met = [meet(geoms, np.array(place), inward) for place in places]
        skin = [(place - frame.place) @ frame.turn for place, _ in filter(None, met)]
        return np.asarray([*skin, middle][0])

    # -- open and closed ---------------------------------------------------------------------

    @cached_property
    def bent(self) -> tuple[Angles, Angles]:
        """(open, closed) angles of the fingers' joints, if nothing stops them."""
        opened, closed = dict[str, float](), dict[str, float]()
        for number in self.fingers:
            share = 1.0
            for joint, (begin, end) in self.ends[number].items():
                opened[joint], closed[joint] = begin, begin + share * (end - begin)
                share = 1.0 if self.thumb is None else BEYOND
        return opened, closed

    @cached_property
    def stop(self) -> float:
        """Share of that way that the fingers can go before a fingertip is in the palm, or a finger deep
        in another."""
        fingers = [self.chains[number] for number in self.fingers]
        pairs = [(self.palm, chain.links[-1], TOUCHES) for chain in fingers]
        for first, second in combinations(fingers, 2):
            pairs += [(*pair, DEEP) for pair in product(first.links, second.links)]

        def is_deep(share: float) -> Array:
            data = self.posed(between(*self.bent, share))
            gaps = [gap(self.compiled, data, a, b) + depth for a, b, depth in pairs]
            return np.array(gaps) < 0

        usual = is_deep(0.0)
        for step in range(1, STEPS + 1):
            if (is_deep(step / STEPS) & ~usual).any():
                least = 1 / STEPS if self.thumb is None else LEAST
                return max((step - 1) / STEPS, least)
        return 1.0

    @cached_property
    def poses(self) -> dict[str, Angles]:
        """Joint angles by title: open and closed, the fingers until they touch, the thumb so that it
        meets them; and the start, where an object just fits in."""
        opened, closed = self.bent[0].copy(), between(*self.bent, self.stop)
        if self.thumb is not None:
            half = between(opened, closed, 0.5)
            opposed = self._opposed(self.thumb, half)
            pose = opposed | half
            axes = {j: self.turning(self.thumb, j, pose) for j in opposed}
            for joint, end in opposed.items():
                flexes = abs(axes[joint] @ [*axes.values()][-1]) > PARALLEL
                opened[joint] = self.parts.inside(joint) if flexes else end
                closed[joint] = end
        start = self._wide_open(opened, closed) if len(self.chains) > 2 else opened
        return {"opened": opened, "closed": closed, "start": start}

    def _wide_open(self, opened: Angles, closed: Angles) -> Angles:
        """Return the pose on the way from closed to open in which an object just fits in."""
        first = self.thumb or 0
        for share in np.arange(HALF_OPEN, 1.0, 1 / STEPS):
            tips = self.tips(pose := between(closed, opened, float(share)))
            others = np.delete(tips, first, axis=0).mean(axis=0)
            if np.linalg.norm(tips[first] - others) > OPENING:
                return pose
        return opened

    def _opposed(self, thumb: int, fingers: Angles) -> Angles:
        """Return angles of the thumb's joints with which its tip comes nearest to those of the first
        two fingers, half closed, and from the other side."""
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
        keys = {key: value for key, value in self.keys.items() if value}
        for key, vector in vectors.items():
            keys[key] = (vector.round(4) + 0.0).tolist()
        lines = [f"{key} = {quoted(value)}" for key, value in keys.items()]
        lines += ["", "[digits]"]
        for name, chain in zip(self.digits, self.chains, strict=True):
            links, tip = quoted(chain.links), quoted(chain.tip)
            lines.append(f"{name} = {{ links = {links}, tip = {tip} }}")
        for title, pose in self.poses.items():
            lines += ["", f"[{title}]"]
            lines += [f"{quoted(joint)} = {angle:.4f}" for joint, angle in pose.items()]
        return "\n".join(lines) + "\n"


def _middle(points: Array) -> Array:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


# -- how the parts hang ----------------------------------------------------------------------


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
        is_known = {word, word.rstrip("0123456789j")} & {*known.split()}
        if is_known or word.startswith(digit):
            return digit
    return ""


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
