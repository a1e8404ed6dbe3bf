"""A hand's file from its model alone: what its parts are, guessed from how they hang and move."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..state import Array
from . import mounting
from .checks import touching
from .hand import DIGITS
from .parts import Angles, Parts, posed, unit
from .skins import Distances, geoms_of, meet

WORDS = {
    "thumb": ("thumb", "th", "pollex"),
    "index": ("index", "fore", "ff", "if", "pointer"),
    "middle": ("middle", "mf", "mid"),
    "ring": ("ring", "rf"),
    "little": ("little", "pinky", "lf", "small"),
}
WRIST = 2  # joints above the palm that are no arm
ASYMMETRIC = 1.3  # of a range's ends: such a joint flexes
STEPS = 20  # of a digit's way to its closed end
TOUCHES, DEEP = 2e-3, 8e-3  # m that fingers may be in the palm, and in each other, before they stop
LEAST = 0.4  # share of the way that they go all the same
SAMPLES = 600  # of the thumb's joints
NEARER = 5e-3  # m
OPPOSED = 0.4  # length of the mean of the ways that digits go, below which they oppose each other
BEYOND = 0.5  # of the way of a finger's first joint, what those beyond it go
HALF_OPEN, OPENING = 0.5, 0.11  # how open a hand is at least, and m between its thumb and fingers
PARALLEL = 0.7  # cosine between axes of joints that flex


def describe(model: str, folder: Path, said: dict[str, Any]) -> tuple[str, list[str]]:
    """The text of a hand's file in a folder, and notes on what was guessed; `said`: keys that are
    known. ValueError naming what the model does not say."""
    guess = Guess(model, folder, said)
    return guess.toml(), guess.notes


class Chain(NamedTuple):
    """A digit."""

    links: tuple[str, ...]
    """Those with a shape, from the palm on."""
    joints: tuple[str, ...]
    """Driven ones, that move it."""
    tip: tuple[float, ...]
    """In the frame of the last link, m."""


@dataclass
class Guess:
    """What a model says of itself; ValueError naming what it does not say."""

    model: str
    """As in the hand's file."""
    folder: Path
    said: dict[str, Any] = field(default_factory=dict)
    """Keys that are known already."""
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.data: dict[str, Any] = {"model": self.model, **self.said}
        if self.data.pop("servos", None):  # the library's
            names = [actuator.name for actuator in self._parts().asked.unfused().actuators]
            self.data["drop"] = [*self.data.get("drop", []), *names]
        parts = self._parts()
        self._leave_out_dummies(parts)
        self._find_palm()

    def _parts(self) -> Parts:
        """With what is known so far."""
        return Parts({"palm": self.data.get("palm"), **self.data}, self.folder)

    # -- what hangs on what ------------------------------------------------------------------

    def _leave_out_dummies(self, parts: Parts) -> None:
        empty = [body.name for body in mounting.weightless(parts.asked.unfused())]
        if empty:
            self.data["drop"] = [*self.data.get("drop", []), *empty]
            self.notes.append(f"drop: left out links without mass or shape: {', '.join(empty)}")

    def _find_palm(self) -> None:
        """The body from which most digits branch; an arm above it is cut off."""
        if "palm" not in self.data:
            spec = self._parts().asked.unfused()
            fixed = {name: _carrier(spec, name) for name in mounting.fixed_bodies(spec)}
            branches: dict[str, list[str]] = {}
            for body in spec.bodies[1:]:
                if list(body.joints) and body.parent.name != "world" and _ends_in_shape(body):
                    parent = body.parent.name
                    branches.setdefault(fixed.get(parent, parent), []).append(parent)
            most = max(branches.values(), key=len, default=[])
            if len(most) < 2:
                raise ValueError(
                    "palm: found no body from which two digits branch; name it with --palm"
                )
            self.data["palm"] = max(most, key=most.count)
        spec = self._parts().asked.unfused()
        body, above = spec.body(self.data["palm"]), 0
        if body is None:
            raise ValueError(f"palm: found no body {self.data['palm']!r} in the model")
        while body.name != "world":
            above += len(list(body.joints))
            body = body.parent
        if above > WRIST:
            self.data["root"] = self.data["palm"]
            self.notes.append(f"root: cut off {above} joints above the palm")
        self.parts = parts = self._parts()
        self.model_, self.palm = parts.model, parts.palm_frame.link

    def digits(self) -> dict[str, Chain]:
        """By name, each from the palm to its tip."""
        spec = self.parts.spec
        loops, found = mounting.loops(spec), list[Chain]()
        groups: list[set[str]] = []
        for first in spec.body(self.palm).bodies:
            for leaf in _leaves(first):
                chain = mounting.chain(leaf) - mounting.chain(spec.body(self.palm))
                joined = [
                    group for group in groups if any(loop & chain and loop & group for loop in loops)
                ]
                groups = [group for group in groups if group not in joined]
                groups.append(chain.union(*joined))
        for group in groups:
            leaves = [spec.body(name) for name in group if not group & _below(spec.body(name))]
            chains = [made for leaf in leaves if (made := self._chain(leaf, group))]
            if chains:
                found.append(max(chains, key=self._length))
        if len(found) < 2:
            raise ValueError(f"digits: found {len(found)} from body {self.palm!r}, allowed 2 or more")
        return dict(zip(self._names(found), found, strict=True))

    def _chain(self, leaf: Any, group: set[str]) -> Chain | None:
        """From the palm to a leaf, of what has a shape; None where nothing has, or drives it."""
        parts, above = self.parts, mounting.chain(self.parts.spec.body(self.palm))
        names = [name for name in _path(leaf) if name not in above]
        links = [name for name in names if geoms_of(self.model_, self.model_.body(name).id)]
        within = set(names) | group
        follows = {coupling.joint: coupling.driver for coupling in parts.follows}
        joints = [joint.name for joint in parts.spec.joints if joint.parent.name in within]
        driven = [
            joint for joint in (follows.get(name, name) for name in joints) if joint in parts.driven
        ]
        if not links or not driven:
            return None
        links = links[-4:]
        return Chain(tuple(links), tuple(dict.fromkeys(driven)), self._tip(links[-1], leaf.name))

    def _tip(self, link: str, leaf: str) -> tuple[float, ...]:
        """The end of a link, seen from its joint."""
        geoms = geoms_of(self.model_, self.model_.body(link).id)
        points = np.concatenate([geom.points for geom in geoms])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        axis = unit(points[np.argmax(np.linalg.norm(points, axis=1))], link)
        away = unit(middle, link) if np.linalg.norm(middle) > 5e-3 else axis
        end = meet(geoms, middle, -away)
        return tuple(np.round(middle if end is None else end[0] - 1e-3 * away, 4).tolist())

    def _length(self, chain: Chain) -> float:
        data = posed(self.model_, {})
        link = data.body(chain.links[-1])
        tip = link.xpos + link.xmat.reshape(3, 3) @ chain.tip
        return float(np.linalg.norm(tip - data.body(self.palm).xpos))

    def _names(self, chains: list[Chain]) -> list[str]:
        """By words in the names of links and joints; else the one that opposes most is the thumb."""
        found = [_named(chain) for chain in chains]
        if None not in found and len(set(found)) == len(found):
            return [str(name) for name in found]
        ways = self._ways(chains)
        alike = ways @ ways.T
        thumb = int(np.argmin(alike.sum(axis=1))) if len(chains) > 2 else 0
        others = iter(
            DIGITS[1:] if len(chains) <= len(DIGITS) else [f"finger{k}" for k in itertools.count(1)]
        )
        return ["thumb" if k == thumb else str(next(others)) for k in range(len(chains))]

    # -- how it moves ------------------------------------------------------------------------

    def tips(self, chains: list[Chain], angles: Angles) -> Array:
        """(n, 3), m, in the palm's frame."""
        data = posed(self.model_, self._whole(angles))
        links = [data.body(chain.links[-1]) for chain in chains]
        world = np.array([link.xpos + link.xmat.reshape(3, 3) @ chain.tip
                          for link, chain in zip(links, chains, strict=True)])  # fmt: skip
        palm = data.body(self.palm)
        return np.asarray((world - palm.xpos) @ palm.xmat.reshape(3, 3))

    def _whole(self, angles: Angles) -> Angles:
        rest = {joint: self.parts.inside(joint) for joint in self.parts.joints}
        return rest | angles | self.parts.followed(rest | angles)

    def _limits(self, joint: str) -> tuple[float, float]:
        low, high = self.parts.range_of(joint)
        actuator = self.model_.actuator(self.parts.driven[joint])
        if actuator.ctrllimited[0]:
            low, high = max(low, actuator.ctrlrange[0]), min(high, actuator.ctrlrange[1])
        return float(low), float(high)

    def _ends(self, chain: Chain, chains: list[Chain]) -> dict[str, tuple[float, float]]:
        """(open, closed) of the joints that flex a digit: from near 0 to the end that is further away.
        Where both are as far, a joint goes the way of those that turn about the same axis; where there
        are none, to where its tip is nearer to the others'."""
        spans = {joint: self._limits(joint) for joint in chain.joints}
        begin = {joint: self.parts.inside(joint) for joint in chain.joints}
        ends, axes = {}, {joint: self._axis(joint, {}) for joint in chain.joints}
        for joint, (low, high) in spans.items():
            ways = high - begin[joint], begin[joint] - low
            if max(ways) > ASYMMETRIC * min(ways):
                ends[joint] = begin[joint], high if ways[0] > ways[1] else low
        turning = sum((np.sign(end - start) * axes[j] for j, (start, end) in ends.items()), np.zeros(3))
        for joint, (low, high) in spans.items():
            if joint in ends:
                continue
            alike = float(axes[joint] @ turning) / max(float(np.linalg.norm(turning)), 1e-9)
            if not ends or turning @ turning == 0:
                near = [
                    self._gathered(chain, chains, {joint: begin[joint] + step}) for step in (-0.3, 0.3)
                ]
                alike = (
                    near[0] - near[1] if abs(near[0] - near[1]) < NEARER else np.sign(near[0] - near[1])
                )
            if abs(alike) > PARALLEL:
                ends[joint] = begin[joint], high if alike > 0 else low
        return {joint: ends[joint] for joint in chain.joints if joint in ends}

    def _gathered(self, chain: Chain, chains: list[Chain], angles: Angles) -> float:
        """How far a digit's tip is from the middle of all, m."""
        tips = self.tips(chains, angles)
        middle = self.tips(chains, {}).mean(axis=0)
        return float(np.linalg.norm(tips[chains.index(chain)] - middle))

    def _ways(self, chains: list[Chain]) -> Array:
        """Unit vectors (n, 3): where the tips go when the digits close by half."""
        begin = self.tips(chains, {})
        half: Angles = {}
        for chain in chains:
            ends = self._ends(chain, chains)
            half |= {joint: (a + b) / 2 for joint, (a, b) in ends.items()}
        moved = self.tips(chains, half) - begin
        return np.asarray(moved / np.maximum(np.linalg.norm(moved, axis=1), 1e-9)[:, None])

    def directions(self, digits: dict[str, Chain]) -> tuple[Array, Array]:
        """(palmar, fingers), unit vectors (3,) in the palm's frame: fingers bend to the palmar side;
        where they close on each other, as a gripper's, they point there."""
        chains = list(digits.values())
        data = posed(self.model_, self._whole({}))
        palm = data.body(self.palm)
        turn = palm.xmat.reshape(3, 3)
        bases = np.array([(data.body(chain.links[0]).xpos - palm.xpos) @ turn for chain in chains])
        along, ways = _unit_rows(self.tips(chains, {}) - bases), self._ways(chains)
        fingers = unit(along.mean(axis=0), "fingers")
        beside = ways - np.outer(ways @ fingers, fingers)
        mean = beside.mean(axis=0)
        if np.linalg.norm(mean) < OPPOSED:
            across = np.linalg.svd(beside - mean)[2][0]  # along which they close on each other
            return _snapped(fingers), _snapped(unit(np.cross(across, fingers), "fingers"))
        if "thumb" in digits and len(digits) > 2:
            fingers = along[[name != "thumb" for name in digits]].mean(axis=0)
        palmar = unit(mean - (mean @ fingers) * fingers / (fingers @ fingers), "palmar")
        return _snapped(palmar), _snapped(unit(fingers, "fingers"))

    def poses(self, digits: dict[str, Chain]) -> tuple[Angles, Angles]:
        """(open, closed): the fingers from near 0 to the end that bends them, or until they touch; the
        thumb so that it meets them."""
        chains = list(digits.values())
        opened, closed = dict[str, float](), dict[str, float]()
        is_like_ours = "thumb" in digits and len(digits) > 2
        for name, chain in digits.items():
            if name != "thumb" or not is_like_ours:
                for count, (joint, (begin, end)) in enumerate(self._ends(chain, chains).items()):
                    share = BEYOND if count and is_like_ours else 1.0
                    opened[joint], closed[joint] = begin, begin + share * (end - begin)
        share = self._until_contact(digits, opened, closed)
        closed = {joint: opened[joint] + share * (end - opened[joint]) for joint, end in closed.items()}
        if is_like_ours:
            half = {joint: opened[joint] + 0.5 * (end - opened[joint]) for joint, end in closed.items()}
            mine = self._opposed(digits, half)
            last = self._axis(list(mine)[-1], mine | half)
            for joint, end in mine.items():
                flexes = abs(self._axis(joint, mine | half) @ last) > PARALLEL
                opened[joint], closed[joint] = self.parts.inside(joint) if flexes else end, end
            opened = self._wide_open(digits, opened, closed)
        rounded = [{j: round(a, 3) for j, a in pose.items()} for pose in (opened, closed)]
        return rounded[0], rounded[1]

    def _wide_open(self, digits: dict[str, Chain], opened: Angles, closed: Angles) -> Angles:
        """On the way from closed to open, as soon as an object fits between thumb and fingers."""
        thumb, chains = list(digits).index("thumb"), list(digits.values())
        for share in np.arange(HALF_OPEN, 1.0, 1 / STEPS):
            pose = {joint: end + share * (opened[joint] - end) for joint, end in closed.items()}
            tips = self.tips(chains, pose)
            if np.linalg.norm(tips[thumb] - np.delete(tips, thumb, axis=0).mean(axis=0)) > OPENING:
                return pose
        return opened

    def _axis(self, joint: str, angles: Angles) -> Array:
        data = posed(self.model_, self._whole(angles))
        return np.array(data.joint(joint).xaxis)

    def _opposed(self, digits: dict[str, Chain], fingers: Angles) -> Angles:
        """Angles of the thumb's joints with which its tip comes nearest to those of the first two
        fingers, half closed, and from the other side."""
        thumb, chains = digits["thumb"], list(digits.values())
        others = [k for k, name in enumerate(digits) if name != "thumb"]
        first = [k for k in others if list(digits)[k] in ("index", "middle")] or others
        me = list(digits).index("thumb")
        tips = self.tips(chains, fingers)
        palmar, _ = self.directions(digits)
        goal = tips[first].mean(axis=0) + 0.01 * palmar
        rng, best = np.random.default_rng(0), (math.inf, dict[str, float]())
        spans = {joint: self._limits(joint) for joint in thumb.joints}
        for number in range(SAMPLES):
            if number < SAMPLES // 2:
                drawn = {j: float(rng.uniform(low, high)) for j, (low, high) in spans.items()}
            else:
                near = ((j, best[1][j] + rng.normal(0, 0.1) * (b - a)) for j, (a, b) in spans.items())
                drawn = {j: float(np.clip(x, *spans[j])) for j, x in near}
            away = float(np.linalg.norm(self.tips(chains, fingers | drawn)[me] - goal))
            if away < best[0]:
                best = away, drawn
        return best[1]

    def _until_contact(self, digits: dict[str, Chain], opened: Angles, closed: Angles) -> float:
        """Which share of their way the fingers can go before one is in the palm, or deep in its
        neighbour."""
        model, palm = self.model_, self.model_.body(self.palm).id
        owner = {model.body(link).id: name for name, chain in digits.items() for link in chain.links}

        def stopped(share: float) -> set[tuple[int, ...]]:
            angles = {j: opened[j] + share * (closed[j] - opened[j]) for j in closed}
            found = set()
            for contact in touching(model, posed(model, self._whole(angles))):
                bodies = model.geom_bodyid[contact.geom]
                names = {owner.get(int(body)) for body in bodies} - {None, "thumb"}
                depth = TOUCHES if palm in bodies else DEEP if len(names) == 2 else math.inf
                if -contact.dist > depth:
                    found.add(tuple(sorted(contact.geom.tolist())))
            return found

        usual = stopped(0.0)
        steps = (step / STEPS for step in range(1, STEPS + 1))
        share = next((share for share in steps if stopped(share) - usual), 1.0)
        return max(share - 1 / STEPS if share < 1 else share, LEAST)

    # -- what comes of it --------------------------------------------------------------------

    def toml(self) -> str:
        """The text of a hand's file."""
        digits = self.digits()
        palmar, fingers = self.directions(digits)
        opened, closed = self.poses(digits)
        known = {key: self.data[key] for key in ("model", "root", "drop", "palm") if self.data.get(key)}
        frame = self.parts.palm_frame
        turn = np.eye(3) if frame.turn is None else frame.turn
        known |= {
            "palmar": (turn.T @ palmar).round(4).tolist(),
            "fingers": (turn.T @ fingers).round(4).tolist(),
        }
        point = self._palm_point(palmar, digits)
        place = np.zeros(3) if frame.place is None else frame.place
        known["palm_point"] = (turn.T @ (point - place)).round(4).tolist()
        known |= {key: value for key, value in self.said.items() if key in known}
        lines = [f"{key} = {json.dumps(value)}" for key, value in known.items()]
        lines += ["", "[digits]"]
        for name, chain in digits.items():
            links, tip = json.dumps(list(chain.links)), list(chain.tip)
            side = self._side(chain, opened, closed, palmar, digits)
            palm = f", palmar = {side}" if side else ""
            lines.append(f"{name} = {{ links = {links}, tip = {tip}{palm} }}")
        for title, pose in (("opened", opened), ("closed", closed)):
            lines += [
                "",
                f"[{title}]",
                *(f"{json.dumps(joint)} = {angle}" for joint, angle in pose.items()),
            ]
        return "\n".join(lines) + "\n"

    def _palm_point(self, palmar: Array, digits: dict[str, Chain]) -> Array:
        """The skin of the palm, at the middle of where the fingers begin and the palm's own middle."""
        geoms = geoms_of(self.model_, self.model_.body(self.palm).id)
        data = posed(self.model_, self._whole({}))
        palm = data.body(self.palm)
        names = [chain.links[0] for name, chain in digits.items() if name != "thumb"]
        bases = np.mean(
            [(data.body(n).xpos - palm.xpos) @ palm.xmat.reshape(3, 3) for n in names], axis=0
        )
        if not geoms:
            return np.asarray(bases)
        points = np.concatenate([geom.points for geom in geoms])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        for share in (0.5, 0.25, 0.0, 0.75):
            if found := meet(geoms, (1 - share) * middle + share * bases, -palmar):
                return np.asarray(found[0])
        nearest, _ = Distances(list(geoms)).nearest([*range(len(geoms))], middle)
        return np.array(geoms[nearest].position)

    def _side(
        self, chain: Chain, opened: Angles, closed: Angles, palmar: Array, digits: dict[str, Chain]
    ) -> list[list[float]] | None:
        """Palmar directions of the links, where no joint of theirs or above tells: where they go."""
        spec, moved = self.parts.spec, {j for j in closed if closed[j] != opened[j]}
        moved |= {c.joint for c in self.parts.follows if c.driver in moved}
        carried = mounting.chain(spec.body(chain.links[-1]))
        if any(spec.joint(joint).parent.name in carried for joint in moved):
            return None
        others = [other for other in digits.values() if other is not chain]
        data = posed(self.model_, self._whole(opened))
        palm = data.body(self.palm)
        middle = palm.xpos + palm.xmat.reshape(3, 3) @ self.tips(others, opened).mean(axis=0)
        last = data.body(chain.links[-1])
        tip, found = last.xpos + last.xmat.reshape(3, 3) @ chain.tip, []
        for link in chain.links:
            body = data.body(link)
            turn = body.xmat.reshape(3, 3).T
            along = unit(turn @ (tip - body.xpos), link)
            towards = turn @ (middle - body.xpos)
            found.append(unit(towards - (towards @ along) * along, link).round(3).tolist())
        return found


def _unit_rows(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None])


def _snapped(direction: Array) -> Array:
    """An axis of the frame, where it is nearly one."""
    axis = int(np.argmax(np.abs(direction)))
    return np.sign(direction[axis]) * np.eye(3)[axis] if abs(direction[axis]) > 0.95 else direction


def _named(chain: Chain) -> str | None:
    """The digit that a chain is called after."""
    for text in (*chain.links, *chain.joints):
        words = text.lower().replace("-", "_").replace(":", "_").replace(".", "_").split("_")
        for digit, known in WORDS.items():
            if any(word in known or word.rstrip("0123456789j") in known or word.startswith(known[0])
                   for word in words):  # fmt: skip
                return digit
    return None


def _carrier(spec: mujoco.MjSpec, name: str) -> str:
    body = spec.body(name)
    while mounting.is_fixed(body):
        body = body.parent
    return str(body.name)


def _ends_in_shape(body: mujoco.MjsBody) -> bool:
    return bool(list(body.geoms)) or any(map(_ends_in_shape, body.bodies))


def _leaves(body: mujoco.MjsBody) -> list[Any]:
    return [leaf for child in body.bodies for leaf in _leaves(child)] or [body]


def _below(body: mujoco.MjsBody) -> set[str]:
    return {name for child in body.bodies for name in ({child.name} | _below(child))}


def _path(body: mujoco.MjsBody) -> list[str]:
    """Names from the root to a body."""
    found = [body.name]
    while body.parent.name != "world":
        body = body.parent
        found.append(body.name)
    return found[::-1]
