"""Which bodies of a model are its palm and its digits: how they hang, and what they are called."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..state import Array
from . import mounting
from .parts import Parts, placed, posed, unit
from .skins import geoms_of, meet

WORDS = {
    "thumb": ("thumb", "th", "pollex"),
    "index": ("index", "fore", "ff", "if", "pointer"),
    "middle": ("middle", "mf", "mid"),
    "ring": ("ring", "rf"),
    "little": ("little", "pinky", "lf", "small"),
}
MOST = 4  # links of a digit
AT_JOINT = 5e-3  # m: a link with its middle there points to where it is longest


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
            while mounting.is_fixed(carrier):
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
        len(list(spec.body(name).joints)) for name in mounting.chain(spec.body(palm))
    )


def chains_of(parts: Parts, palm: str) -> list[Chain]:
    """The digits that hang on a palm: of what a closed loop joins, the chain that reaches furthest;
    ValueError for fewer than two."""
    spec, data = parts.spec, posed(parts.model, {})
    loops, groups = mounting.loops(spec), list[set[str]]()
    above = set(mounting.chain(spec.body(palm)))
    for leaf in [
        body for body in spec.body(palm).find_all("body") if not list(body.bodies)
    ]:
        chain = set(mounting.chain(leaf)) - above
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
    path = [name for name in mounting.chain(leaf) if name not in above]
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
