"""Describe the objects to grasp, and how they differ between episodes."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, get_args

import numpy as np

from .validation import hints, require_one_of, require_type

Kind = Literal["box", "sphere", "cylinder", "capsule", "ellipsoid"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Number = float | str
"""A value, or LOW..HIGH: drawn uniformly from there in every episode."""
Density = Annotated[float, "[1, 100000]"] | str
Friction = Annotated[float, "(0, 10]"] | str
SMALLEST = 0.001  # m: below, a simulator finds no mass in it
MAX_WIDTH = 0.08  # m, of an object across; the benchmark hard_cases goes up to it
TALLEST = 0.15  # m, of an object: held at its top, its centre is well above what counts as dropped
# m and rad: where the hand leaves room for what is 5 cm across
OFFSET, YAW = 0.005, 0.15
NEWTON_STEPS, TINY = 8, 1e-30  # for the distance of an ellipsoid
FURTHEST = 0.1  # m: at 5 cm, half of a hand's width, a hand's slides hardly get there


@dataclass(frozen=True)
class ObjectConfig:
    """Objects of a scene, and where they start."""

    object: str = "box"
    """box, sphere, cylinder, capsule or ellipsoid. Of several (box,sphere), each
    episode draws one."""
    object_size: tuple[Number, ...] = (0.05,)
    """Edge of a cube or three edges of a box, diameter of a sphere, three axes of an
    ellipsoid, diameter and height of a standing cylinder, or diameter and straight
    length of a lying capsule, m. Size, density and friction may be ranges, such as
    0.04..0.05."""
    object_density: Density = 567.0
    """Density, kg/m^3."""
    friction: Friction = 1.0
    """Coefficient of sliding friction of the object."""
    jitter: bool = True
    """Vary the start slightly in every episode (the paper does not)."""
    start_offset: Annotated[float, f"[0, {FURTHEST}]"] = OFFSET
    """Largest offset of the object along x and y with jitter, m."""
    start_yaw: Annotated[float, "[0, 3.142]"] = YAW
    """Largest turn of the object with jitter, rad."""

    @property
    def is_near(self) -> bool:
        """True if the object starts where the hand leaves room for it."""
        is_usual = self.start_offset <= OFFSET and self.start_yaw <= YAW
        return is_usual or not self.jitter


def namespace(values: Any) -> Any:
    """Return the module whose functions take these values: PyTorch for its tensors, else NumPy."""
    torch = sys.modules.get("torch")
    return torch if torch and isinstance(values, torch.Tensor) else np


def host(values: Any) -> np.ndarray:
    """Return an array or a tensor as NumPy's."""
    return np.asarray(values.detach().cpu() if hasattr(values, "cpu") else values)


def like(values: Any, other: Any) -> Any:
    """Return an array as another is: NumPy's, or a tensor on its device."""
    xp = namespace(other)
    return (
        values
        if xp is np
        else xp.as_tensor(values, dtype=other.dtype, device=other.device)
    )


@dataclass(frozen=True)
class Shape:
    """A primitive in its own frame, centred at the origin, in m.

    A cylinder stands along z, a capsule lies along x.

    It may stand for many of a kind: its measures are then arrays, whose axes lead in
    all results.
    """

    kind: Kind
    half_size: tuple[Any, Any, Any]
    """Half extents along its own axes, three numbers or three arrays (...), m."""

    @property
    def width(self) -> float:
        """Larger of its two measures across, m."""
        return 2 * max(self.half_size[:2])

    @property
    def height(self) -> float:
        """Height, m."""
        return 2 * self.half_size[2]

    @property
    def volume(self) -> Any:
        """Volume (...), m³."""
        x, y, z = self.half_size
        if self.kind == "capsule":
            return 2 * math.pi * y**2 * (x - y / 3)
        factor = {"box": 8.0, "cylinder": 2 * math.pi}.get(self.kind, 4 / 3 * math.pi)
        return factor * x * y * z

    @property
    def inertia(self) -> Any:
        """Moments of inertia of 1 kg about its axes (..., 3), m²."""
        x, y, z = self.half_size
        if self.kind == "cylinder":
            across = x**2 / 4 + z**2 / 3
            return np.stack([across, across, x**2 / 2], axis=-1)
        if self.kind == "capsule":  # of its caps, and of what is between
            ends = 2 * y / (3 * x - y)
            across = (1 - ends) * (y**2 / 4 + (x - y) ** 2 / 3)
            across += ends * (0.4 * y**2 + (x - y) * (x - y / 4))
            along = (0.5 - 0.1 * ends) * y**2
            return np.stack([along, across, across], axis=-1)
        squares = np.stack([y**2 + z**2, x**2 + z**2, x**2 + y**2], axis=-1)
        return squares / (3 if self.kind == "box" else 5)

    @property
    def measures(self) -> tuple[Any, Any, Any]:
        """Three numbers that describe it along MuJoCo's axes: a capsule is along z there, m."""
        x, y, z = self.half_size
        two = {"cylinder": (x, z, 0 * x), "capsule": (y, x - y, 0 * x)}
        return two.get(self.kind, self.half_size)

    @cached_property
    def _half(self) -> Any:
        """The half extents in one array, (3,) or (..., 1, 3)."""
        if isinstance(self.half_size[0], float):
            return np.array(self.half_size)
        xp = namespace(self.half_size[0])
        return xp.stack(self.half_size, axis=-1)[..., None, :]

    def squared_distance(self, points: Any) -> Any:
        """Return the squared distances (..., n) in m² from points (..., n, 3) to the solid, 0 inside.

        Points are NumPy's or PyTorch's.
        """
        xp, half = namespace(points), self._half
        if self.kind == "ellipsoid":
            return _beyond_ellipsoid(points, half, xp)
        if self.kind == "capsule":  # from its axis
            along = abs(points[..., 0]) - (half[..., 0] - half[..., 1])
            parts = along * (along > 0), points[..., 1], points[..., 2]
            points = xp.stack(parts, axis=-1)
        if self.kind in ("sphere", "capsule"):
            from_centre = xp.sqrt(xp.einsum("...i,...i->...", points, points))
            beyond = from_centre - half[..., 1]
            return (beyond * (beyond > 0)) ** 2
        if self.kind == "cylinder":  # (radius, height)
            radii = xp.hypot(points[..., 0], points[..., 1])
            points, half = xp.stack([radii, points[..., 2]], axis=-1), half[..., 1:]
        beyond = abs(points) - half
        beyond *= beyond > 0
        return xp.einsum("...i,...i->...", beyond, beyond)

    def half_height(self, rotation: Any) -> Any:
        """Return how deep the shape, turned by `rotation` (..., 3, 3), is below its centre, m (...)."""
        x, y, z = self.half_size
        if self.kind == "sphere":
            return x
        a, b, upright = np.moveaxis(np.abs(rotation[..., 2, :]), -1, 0)
        if self.kind == "cylinder":
            return z * upright + x * np.sqrt(np.maximum(0.0, 1.0 - upright**2))
        if self.kind == "capsule":
            return a * (x - y) + y
        if self.kind == "ellipsoid":
            return np.sqrt((a * x) ** 2 + (b * y) ** 2 + (upright * z) ** 2)
        return a * x + b * y + upright * z


def _beyond_ellipsoid(points: Any, half: Any, xp: Any) -> Any:
    """Return what `Shape.squared_distance` does for an ellipsoid, by Newton's method.

    With half axes a, the nearest point to p is p a² / (a² + t), where t puts it on the
    surface: 1 / |p a / (a² + t)| = 1. The left side is concave in t and nearly
    straight, so that no step goes too far. Of points up to 5 cm away, distances are
    exact to 1e-8 m for axes up to 25 times as long as others, and to 5e-6 m for the
    longest and shortest that a scene allows.
    """
    t = xp.zeros_like(points[..., :1])
    for _ in range(NEWTON_STEPS):
        squares = half**2 + t
        inside = points * half / squares
        length = xp.einsum("...i,...i->...", inside, inside)[..., None]
        slope = xp.einsum("...i,...i->...", inside, inside / squares)[..., None]
        t = t + length * (length**0.5 - 1) / (slope + TINY)
        t = t * (t > 0)
    offsets = points * t / (half**2 + t)
    return xp.einsum("...i,...i->...", offsets, offsets)


def make(kind: Kind, size: tuple[Any, ...]) -> Shape:
    """Return a shape from its measures in m; raise ValueError for another number of them.

    A box has edges (one: a cube), an ellipsoid axes, a sphere a diameter, a cylinder a
    diameter and a height (one: both), a capsule a diameter and the length between its
    caps (one: half of it).
    """
    numbers = {"sphere": "1", "cylinder": "1 or 2", "capsule": "1 or 2"}
    allowed = numbers.get(kind, "1 or 3")
    if str(len(size)) not in allowed.split():
        a = "an" if kind == "ellipsoid" else "a"
        raise ValueError(
            f"object_size: found {len(size)} numbers, allowed for {a} {kind}: {allowed}"
        )
    if kind == "capsule":
        straight = (*size, size[0] / 2)[1]
        size = (size[0] + straight, size[0], size[0])
    edges = {1: size * 3, 2: (size[0], size[0], size[-1]), 3: size}[len(size)]
    x, y, z = (edge / 2 for edge in edges)
    return Shape(kind, (x, y, z))


@dataclass(frozen=True)
class Item:
    """One object."""

    shape: Shape
    """Kind and size."""
    density: Any
    """Density, kg/m³."""
    friction: Any
    """Coefficient of sliding friction."""

    @property
    def mass(self) -> Any:
        """Mass, kg."""
        return self.density * self.shape.volume

    def describe(self) -> dict[str, Any]:
        """Return plain values, for ``info``.

        Edges are in m; those of a sphere or cylinder are of the box around it.
        """
        size = tuple(2 * half for half in self.shape.half_size)
        values = {"density": self.density, "mass": self.mass, "friction": self.friction}
        return {"kind": self.shape.kind, "size": size, **values}


class Items:
    """The objects that a configuration allows."""

    def __init__(self, config: ObjectConfig) -> None:
        """Read kinds, sizes and ranges; raise ValueError for one that is none."""
        kinds: Any = config.object.split(",")
        for kind in kinds:
            require_one_of(KINDS, kind, "object")
        self._kinds: list[Kind] = kinds
        self._sizes = [bounds("object_size", size) for size in config.object_size]
        self._density = bounds("object_density", config.object_density)
        self._friction = bounds("friction", config.friction)
        highest = tuple(high for _, high in self._sizes)
        largest = [make(kind, highest) for kind in self._kinds]
        self.width = max(shape.width for shape in largest)
        """Width of the widest object, m."""
        self.height = max(shape.height for shape in largest)
        """Height of the highest object, m."""
        self.smallest = min(low for low, _ in self._sizes)
        """Least of all measures, m."""
        self.first = Item(largest[0], self._density[1], self._friction[1])
        """The largest and heaviest object of the first kind."""

    def draw(self, rng: Any) -> Item:
        """Return the object of an episode; of many episodes, where `rng` draws for many (`Draws`)."""
        n = len(self._kinds)
        kind = self._kinds[rng.integers(n) if n > 1 else 0]
        shape = make(kind, tuple(rng.uniform(*size) for size in self._sizes))
        return Item(shape, rng.uniform(*self._density), rng.uniform(*self._friction))


def bounds(name: str, value: Number) -> tuple[float, float]:
    """Return lowest and highest of a number or of "LOW..HIGH"; raise ValueError, calling it `name`."""
    first, dots, last = str(value).partition("..")
    try:
        low, high = float(first), float(last if dots else first)
    except ValueError:
        low = high = math.nan
    if not low <= high:
        raise ValueError(
            f"{name}: found {value!r}, allowed a number, or LOW..HIGH with the lower one first"
        )
    return low, high


def require_ends(config: Any, *names: str) -> None:
    """Raise ValueError for an end of a range that the type of its field does not allow."""
    for name in names:
        for end in bounds(name, getattr(config, name)):
            require_type(end, hints(type(config))[name], name)  # type: ignore[arg-type]


def scaled(value: Any, factor: float) -> Any:
    """Return a number, a range or a list of them times `factor`, as a file would have it in m.

    It is rounded to a tenth of a millimetre.
    """
    if isinstance(value, list | tuple):
        return [scaled(item, factor) for item in value]
    low, high = (round(factor * end, 4) for end in bounds("a length", value))
    return f"{low:g}..{high:g}" if low < high else low


def validate(config: ObjectConfig) -> None:
    """Raise ValueError naming the first invalid field."""
    require_ends(config, "object_density", "friction")
    items = Items(config)
    for size, is_wrong, allowed in (
        (items.smallest, items.smallest < SMALLEST, f"{SMALLEST} m or more"),
        (items.width, items.width > MAX_WIDTH, f"up to {MAX_WIDTH} m across"),
        (items.height, items.height > TALLEST, f"up to {TALLEST} m in height"),
    ):
        if is_wrong:
            raise ValueError(f"object_size: found {size:g} m, allowed {allowed}")
