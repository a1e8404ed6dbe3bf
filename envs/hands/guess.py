"""Guess a hand's file from its model alone: from how its parts hang, are called and move."""

from __future__ import annotations

import json
import math
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
from .geometry import Distances, gap, geoms_of, meet, placed, posed, unit
from .hand import DIGITS
from .parts import Angles, HandFile, Parts

WORDS = {
    "thumb": ("thumb", "th", "pollex"),
    "index": ("index", "fore", "ff", "if", "pointer"),
    "middle": ("middle", "mf", "mid"),
    "ring": ("ring", "rf"),
    "little": ("little", "pinky", "lf", "small"),
}
MOST = 4  # links of a digit
AT_JOINT = 5e-3  # m: a link with its middle there points to where it is longest
WRIST = 2  # joints above the palm that are no arm
ASYMMETRIC = 1.3  # of a range's ends: such a joint flexes
NUDGE = 0.3  # rad, and at most a quarter of a range: how far a joint is tried
STEPS = 20  # of a digit's way to its closed end
TOUCHES, DEEP = (
    2e-3,
    8e-3,
)  # m that fingers may be in the palm, and in each other, before they stop
LEAST = 0.4  # share of the way that they go all the same
SAMPLES = 600  # of the thumb's joints
NEARER = 5e-3  # m
OPPOSED = 0.4  # length of the mean of the ways that digits go, below which they oppose each other
ALONE = 0.5  # cosine by which a thumb goes another way than the other digits do
BEYOND = 0.5  # of the way of a finger's first joint, what those beyond it go
HALF_OPEN, OPENING = (
    0.5,
    0.11,
)  # how open a hand is at least, and m between its thumb and fingers
PARALLEL = 0.7  # cosine between axes of a thumb's joints that flex
TURNED = 0.5  # cosine to the axis of a digit's last hinge, below which a hinge spreads or opposes


def describe(model: str, folder: Path, said: dict[str, Any]) -> tuple[str, list[str]]:
    """The text of a hand's file in a folder, and notes on what was guessed; `said`: keys that are
    known. ValueError naming what the model does not say."""
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
        if "palm" not in self.data:
            self.data["palm"] = palm_of(self._unfused())
        if (above := joints_above(self._unfused(), self.data["palm"])) > WRIST:
            self.data["root"] = self.data["palm"]
            self.notes.append(f"root: cut off {above} joints above the palm")
        self.parts = self._parts()
        self.compiled, self.palm = self.parts.model, self.parts.palm_frame.link

    def _parts(self) -> Parts:
        """What is known so far; the rest stands for nothing."""
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
    def chains(self) -> list[Chain]:
        return chains_of(self.parts, self.palm)

    @cached_property
    def digits(self) -> dict[str, Chain]:
        """By name: by words in the names of links and joints, else the one that goes another way than
        the others is the thumb."""
        found = [chain.name for chain in self.chains]
        if None in found or len(set(found)) < len(found):
            alike = (self.ways @ self.ways.T).sum(axis=1)
            thumb = int(np.argmin(alike)) if len(found) > 2 else 0
            is_alone = (
                len(found) == 2 or alike[thumb] < np.delete(alike, thumb).mean() - ALONE
            )
            names = iter(
                DIGITS[1:]
                if len(found) <= len(DIGITS)
                else map("finger{}".format, range(99))
            )
            found = [
                "thumb" if is_alone and k == thumb else next(names)
                for k in range(len(found))
            ]
        return dict(zip(map(str, found), self.chains, strict=True))

    @cached_property
    def thumb(self) -> int | None:
        """Which opposes the fingers of a hand like ours; None for what closes like a gripper."""
        names = list(self.digits)
        return (
            names.index("thumb")
            if "thumb" in names and len(names) > 2 and not self.grips
            else None
        )

    @cached_property
    def grips(self) -> bool:
        """Do the digits close on each other, and not all to one side?"""
        ends = [end for flexes in self.ends for end in flexes.items()]
        along = self._along({joint: (a + b) / 2 for joint, (a, b) in ends}).mean(axis=0)
        beside = self.ways.mean(axis=0)
        beside = beside - (beside @ along) * along / max(float(along @ along), 1e-9)
        return bool(np.linalg.norm(beside) < OPPOSED)

    def tips(self, angles: Angles) -> Array:
        """(n, 3), m, in the palm's frame."""
        data = posed(self.compiled, self._whole(angles))
        world = [placed(data, chain.links[-1], chain.tip) for chain in self.chains]
        palm = data.body(self.palm)
        return np.asarray((np.array(world) - palm.xpos) @ palm.xmat.reshape(3, 3))

    def _along(self, angles: Angles, moving: bool = True) -> Array:
        """(n, 3), unit: from where the digits begin, or begin to flex, to their tips."""
        data = posed(self.compiled, self._whole(angles))
        palm = data.body(self.palm)
        begin = [data.joint(next(iter(ends))).xanchor if moving and ends else data.body(c.links[0]).xpos
                 for c, ends in zip(self.chains, self.ends, strict=True)]  # fmt: skip
        return _rows(
            self.tips(angles) - (np.array(begin) - palm.xpos) @ palm.xmat.reshape(3, 3)
        )

    def _whole(self, angles: Angles) -> Angles:
        rest = {joint: self.parts.inside(joint) for joint in self.parts.joints}
        return rest | angles | self.parts.followed(rest | angles)

    def _axis(self, joint: str, angles: Angles) -> Array:
        return np.array(posed(self.compiled, self._whole(angles)).joint(joint).xaxis)

    def _limits(self, joint: str) -> tuple[float, float]:
        low, high = self.parts.range_of(joint)
        actuator = self.compiled.actuator(self.parts.driven[joint])
        if actuator.ctrllimited[0]:
            low, high = (
                max(low, actuator.ctrlrange[0]),
                min(high, actuator.ctrlrange[1]),
            )
        return float(low), float(high)

    @cached_property
    def ends(self) -> list[dict[str, tuple[float, float]]]:
        """(open, closed) of the joints that flex each digit."""
        return [self._ends(number, chain) for number, chain in enumerate(self.chains)]

    def _ends(self, number: int, chain: Chain) -> dict[str, tuple[float, float]]:
        """Slides, and hinges that turn about the axis of the last. What slides, and two digits that
        are all, go to where the tip is nearer to the others'. Other hinges go from near 0 to the end
        that is further away; where both are as far, the way of the others, or also nearer."""
        spans = {joint: self._limits(joint) for joint in chain.joints}
        begin = {joint: self.parts.inside(joint) for joint in chain.joints}
        slides = {j for j in spans if self.parts.spec.joint(j).type == mount.LINEAR}
        axes = {joint: self._axis(joint, {}) for joint in spans}
        last = next(
            (axes[joint] for joint in reversed(spans) if joint not in slides),
            np.zeros(3),
        )
        flexing = [j for j in spans if j in slides or abs(axes[j] @ last) > TURNED]
        nearer = {
            j: self._nearer(number, j, begin[j], min(NUDGE, np.ptp(spans[j]) / 4))
            for j in flexing
        }
        found: dict[str, tuple[float, float]] = {}
        turning = np.zeros(3)
        for joint in flexing:
            low, high = spans[joint]
            up, down = high - begin[joint], begin[joint] - low
            if joint in slides or (
                len(self.chains) == 2 and abs(nearer[joint]) > NEARER
            ):
                end, other = (high, low) if nearer[joint] > 0 else (low, high)
                is_long = abs(end - begin[joint]) >= abs(other - begin[joint])
                found[joint] = begin[joint] if is_long else other, end
            elif max(up, down) > ASYMMETRIC * min(up, down):
                found[joint] = begin[joint], high if up > down else low
                turning += np.sign(up - down) * axes[joint]
        for joint in (joint for joint in flexing if joint not in found):
            along = float(axes[joint] @ turning)
            if not turning.any():
                along = nearer[joint] if abs(nearer[joint]) > NEARER else 0.0
            if along:
                found[joint] = begin[joint], spans[joint][int(along > 0)]
        return {joint: found[joint] for joint in chain.joints if joint in found}

    def _nearer(self, number: int, joint: str, begin: float, step: float) -> float:
        """How much nearer a digit's tip comes to the middle of all as a joint goes up than down, m."""
        middle = self.tips({}).mean(axis=0)
        down, up = (
            self.tips({joint: begin + way})[number] - middle for way in (-step, step)
        )
        return float(np.linalg.norm(down) - np.linalg.norm(up))

    @cached_property
    def ways(self) -> Array:
        """Unit vectors (n, 3): where the tips go when the digits close by half."""
        half = {
            joint: (a + b) / 2 for ends in self.ends for joint, (a, b) in ends.items()
        }
        return _rows(self.tips(half) - self.tips({}))

    @cached_property
    def directions(self) -> tuple[Array, Array]:
        """(palmar, fingers), unit vectors (3,) in the palm's frame: fingers bend to the palmar side;
        where they close on each other, as a gripper's, they point there."""
        along = self._along({}, moving=self.grips)
        if self.grips:
            across = np.linalg.svd(self.ways - self.ways.mean(axis=0))[2][0]
            towards = along.mean(axis=0)
            towards = unit(towards - (towards @ across) * across, "fingers")
            return _snapped(towards), _snapped(
                unit(np.cross(across, towards), "fingers")
            )
        fingers = unit(along.mean(axis=0), "fingers")
        beside = (self.ways - np.outer(self.ways @ fingers, fingers)).mean(axis=0)
        if self.thumb is not None:
            fingers = unit(np.delete(along, self.thumb, axis=0).mean(axis=0), "fingers")
        palmar = unit(beside - (beside @ fingers) * fingers, "palmar")
        return _snapped(palmar), _snapped(fingers)

    # -- open and closed ---------------------------------------------------------------------

    @cached_property
    def poses(self) -> tuple[Angles, Angles, Angles]:
        """(open, closed, start): the fingers from near 0 to the end that bends them, or until they
        touch; the thumb so that it meets them. A grasp starts where an object just fits in."""
        opened, closed = dict[str, float](), dict[str, float]()
        for number, ends in enumerate(self.ends):
            for count, (joint, (begin, end)) in enumerate(
                ends.items() if number != self.thumb else ()
            ):
                share = BEYOND if count and self.thumb is not None else 1.0
                opened[joint], closed[joint] = begin, begin + share * (end - begin)
        closed = _between(opened, closed, self._until_contact(opened, closed))
        if self.thumb is not None:
            half = _between(opened, closed, 0.5)
            mine = self._opposed(self.thumb, half)
            last = self._axis(list(mine)[-1], mine | half)
            for joint, end in mine.items():
                flexes = abs(self._axis(joint, mine | half) @ last) > PARALLEL
                opened[joint], closed[joint] = (
                    self.parts.inside(joint) if flexes else end,
                    end,
                )
        start = self._wide_open(opened, closed) if len(self.chains) > 2 else opened
        opened, closed, start = (
            {joint: round(angle, 4) for joint, angle in pose.items()}
            for pose in (opened, closed, start)
        )
        return opened, closed, start

    def _wide_open(self, opened: Angles, closed: Angles) -> Angles:
        """On the way from closed to open, as soon as an object fits in."""
        for share in np.arange(HALF_OPEN, 1.0, 1 / STEPS):
            tips = self.tips(pose := _between(closed, opened, float(share)))
            first = self.thumb or 0
            if (
                np.linalg.norm(
                    tips[first] - np.delete(tips, first, axis=0).mean(axis=0)
                )
                > OPENING
            ):
                return pose
        return opened

    def _opposed(self, thumb: int, fingers: Angles) -> Angles:
        """Angles of the thumb's joints with which its tip comes nearest to those of the first two
        fingers, half closed, and from the other side."""
        first = [k for k, name in enumerate(self.digits) if name in ("index", "middle")]
        first = first or [k for k in range(len(self.chains)) if k != thumb]
        goal = self.tips(fingers)[first].mean(axis=0) + 0.01 * self.directions[0]
        rng, best = np.random.default_rng(0), (math.inf, dict[str, float]())
        spans = {joint: self._limits(joint) for joint in self.chains[thumb].joints}
        for number in range(SAMPLES):
            if number < SAMPLES // 2:
                drawn = {
                    j: float(rng.uniform(low, high)) for j, (low, high) in spans.items()
                }
            else:
                near = (
                    (j, best[1][j] + rng.normal(0, 0.1) * (b - a))
                    for j, (a, b) in spans.items()
                )
                drawn = {j: float(np.clip(x, *spans[j])) for j, x in near}
            away = float(np.linalg.norm(self.tips(fingers | drawn)[thumb] - goal))
            if away < best[0]:
                best = away, drawn
        return best[1]

    def _until_contact(self, opened: Angles, closed: Angles) -> float:
        """Which share of their way the fingers can go before a fingertip is in the palm, or a finger
        deep in another."""
        model, fingers = self.compiled, list(self.chains)
        if self.thumb is not None:
            del fingers[self.thumb]
        pairs = [(self.palm, chain.links[-1], TOUCHES) for chain in fingers]
        for first, second in combinations(fingers, 2):
            pairs += [(*pair, DEEP) for pair in product(first.links, second.links)]

        def stopped(share: float) -> set[tuple[str, str]]:
            data = posed(model, self._whole(_between(opened, closed, share)))
            return {(a, b) for a, b, depth in pairs
                    if gap(model, data, model.body(a).id, model.body(b).id) < -depth}  # fmt: skip

        usual = stopped(0.0)
        steps = (step / STEPS for step in range(1, STEPS + 1))
        share = next((share for share in steps if stopped(share) - usual), 1.0)
        return max(
            share - 1 / STEPS if share < 1 else share,
            1 / STEPS if self.grips else LEAST,
        )

    # -- what comes of it --------------------------------------------------------------------

    def toml(self) -> str:
        """The text of a hand's file."""
        (palmar, fingers), (opened, closed, start) = self.directions, self.poses
        frame, known = self.parts.palm_frame, {k: v for k, v in self.data.items() if v}
        guessed = {
            "palmar": palmar,
            "fingers": fingers,
            "palm_point": self._palm_point() - frame.place,
        }
        known |= {
            key: (frame.turn.T @ value).round(4).tolist()
            for key, value in guessed.items()
        }
        lines = [f"{key} = {json.dumps(value)}" for key, value in known.items()]
        lines += ["", "[digits]"]
        for name, chain in self.digits.items():
            links, side = (
                json.dumps(list(chain.links)),
                self._side(chain, opened, closed),
            )
            palm = f", palmar = {side}" if side else ""
            lines.append(
                f"{name} = {{ links = {links}, tip = {list(chain.tip)}{palm} }}"
            )
        for title, pose in (("opened", opened), ("closed", closed), ("start", start)):
            lines += [
                "",
                f"[{title}]",
                *(f"{json.dumps(j)} = {angle}" for j, angle in pose.items()),
            ]
        return "\n".join(lines) + "\n"

    def _palm_point(self) -> Array:
        """The skin of the palm, at the middle of where the fingers begin and the palm's own middle."""
        geoms = geoms_of(self.compiled, self.compiled.body(self.palm).id)
        data = posed(self.compiled, self._whole({}))
        palm = data.body(self.palm)
        begin = [
            data.body(chain.links[0]).xpos
            for name, chain in self.digits.items()
            if name != "thumb"
        ]
        bases = (np.mean(begin, axis=0) - palm.xpos) @ palm.xmat.reshape(3, 3)
        if not geoms:
            return np.asarray(bases)
        points = np.concatenate([geom.points for geom in geoms])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        for share in (0.5, 0.25, 0.0, 0.75):
            if found := meet(
                geoms, (1 - share) * middle + share * bases, -self.directions[0]
            ):
                return np.asarray(found[0])
        nearest, _ = Distances(list(geoms)).nearest([*range(len(geoms))], middle)
        return np.array(geoms[nearest].position)

    def _side(
        self, chain: Chain, opened: Angles, closed: Angles
    ) -> list[list[float]] | None:
        """Palmar directions of the links, where no joint of theirs or above tells: where they go."""
        spec, moved = self.parts.spec, {j for j in closed if closed[j] != opened[j]}
        moved |= {c.joint for c in self.parts.follows if c.driver in moved}
        carried = mount.chain(spec.body(chain.links[-1]))
        if any(spec.joint(joint).parent.name in carried for joint in moved):
            return None
        data, me = posed(self.compiled, self._whole(opened)), self.chains.index(chain)
        tips = self.tips(opened)
        ends = tips[me], np.delete(tips, me, axis=0).mean(axis=0)
        tip, middle = (placed(data, self.palm, end) for end in ends)
        found = []
        for link in chain.links:
            body = data.body(link)
            turn = body.xmat.reshape(3, 3).T
            along, towards = (
                unit(turn @ (tip - body.xpos), link),
                turn @ (middle - body.xpos),
            )
            found.append(
                unit(towards - (towards @ along) * along, link).round(3).tolist()
            )
        return found


def _between(opened: Angles, closed: Angles, share: float) -> Angles:
    return {
        joint: opened[joint] + share * (end - opened[joint])
        for joint, end in closed.items()
    }


def _rows(vectors: Array) -> Array:
    return np.asarray(
        vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None]
    )


def _snapped(direction: Array) -> Array:
    """An axis of the frame, where it is nearly one."""
    axis = int(np.argmax(np.abs(direction)))
    return (
        np.sign(direction[axis]) * np.eye(3)[axis]
        if abs(direction[axis]) > 0.95
        else direction
    )


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
            words = (
                text.lower().translate(dict.fromkeys(map(ord, "-:."), "_")).split("_")
            )
            for digit, known in WORDS.items():
                if any(w in known or w.rstrip("0123456789j") in known or w.startswith(known[0])
                       for w in words):  # fmt: skip
                    return digit
        return None


def palm_of(spec: mujoco.MjSpec) -> str:
    """The body from which most digits branch; ValueError where none has two."""
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


def joints_above(spec: mujoco.MjSpec, palm: str) -> int:
    """How many move the palm; ValueError where there is no such body."""
    if spec.body(palm) is None:
        raise ValueError(f"palm: found no body {palm!r} in the model")
    return sum(
        len(list(spec.body(name).joints)) for name in mount.chain(spec.body(palm))
    )


def chains_of(parts: Parts, palm: str) -> list[Chain]:
    """The digits that hang on a palm: of what a closed loop joins, the chain that reaches furthest;
    ValueError for fewer than two."""
    spec, data = parts.spec, posed(parts.model, {})
    loops, groups = mount.loops(spec), list[set[str]]()
    above = set(mount.chain(spec.body(palm)))
    for leaf in [
        body for body in spec.body(palm).find_all("body") if not list(body.bodies)
    ]:
        chain = set(mount.chain(leaf)) - above
        joined = [
            group
            for group in groups
            if any(loop & chain and loop & group for loop in loops)
        ]
        groups = [group for group in groups if group not in joined] + [
            chain.union(*joined)
        ]

    def reach(chain: Chain) -> float:
        tip = placed(data, chain.links[-1], chain.tip)
        return float(np.linalg.norm(tip - data.body(palm).xpos))

    found = []
    for group in groups:
        ends = [
            spec.body(name)
            for name in group
            if all(
                below.name not in group for below in spec.body(name).find_all("body")
            )
        ]
        if chains := [
            made for end in ends if (made := _chain(parts, end, group, above))
        ]:
            found.append(max(chains, key=reach))
    if len(found) < 2:
        raise ValueError(
            f"digits: found {len(found)} from body {palm!r}, allowed 2 or more"
        )
    return found


def _chain(parts: Parts, leaf: Any, group: set[str], above: set[str]) -> Chain | None:
    """From the palm to a leaf, of what has a shape; None where nothing has, or drives it."""
    path = [name for name in mount.chain(leaf) if name not in above]
    links = [name for name in path if geoms_of(parts.model, parts.model.body(name).id)][
        -MOST:
    ]
    follows = {coupling.joint: coupling.driver for coupling in parts.follows}
    moving = [
        joint.name
        for joint in parts.spec.joints
        if joint.parent.name in {*path, *group}
    ]
    drivers = dict.fromkeys(follows.get(joint, joint) for joint in moving)
    joints = tuple(joint for joint in drivers if joint in parts.driven)
    return (
        Chain(tuple(links), joints, _tip(parts, links[-1]))
        if links and joints
        else None
    )


def _tip(parts: Parts, link: str) -> tuple[float, ...]:
    """The end of a link, seen from its joint."""
    geoms = geoms_of(parts.model, parts.model.body(link).id)
    points: Array = np.concatenate([geom.points for geom in geoms])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    away = middle
    if np.linalg.norm(middle) <= AT_JOINT:
        away = points[np.argmax(np.linalg.norm(points, axis=1))]
    away = unit(away, link)
    end = meet(geoms, middle, -away)
    return tuple(np.round(middle if end is None else end[0] - 1e-3 * away, 4).tolist())
