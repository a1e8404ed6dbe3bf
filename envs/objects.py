"""The object to grasp: its shape, and where its surface is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from .hands import Array

Kind = Literal["box", "sphere", "cylinder"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Shape:
    """A primitive in its own frame, centred at the origin; a cylinder stands along z."""

    kind: Kind
    half_size: tuple[float, float, float]
    """Half extents along its own axes, m."""

    @property
    def width(self) -> float:
        """The larger of its two measures across, m."""
        return 2 * max(self.half_size[:2])

    @property
    def height(self) -> float:
        """m"""
        return 2 * self.half_size[2]

    @property
    def volume(self) -> float:
        """m³"""
        x, y, z = self.half_size
        factor = {"box": 8.0, "sphere": 4 / 3 * math.pi, "cylinder": 2 * math.pi}
        return factor[self.kind] * x * y * z

    def squared_distance(self, points: Array) -> Array:
        """Squared distance (...) in m² from points (..., 3) to the solid, 0 inside."""
        if self.kind == "sphere":
            return np.square(np.maximum(np.linalg.norm(points, axis=-1) - self.half_size[0], 0.0))
        if self.kind == "cylinder":
            points = np.stack([np.hypot(points[..., 0], points[..., 1]), points[..., 2]], axis=-1)
        beyond = np.abs(points)
        beyond -= self.half_size[-points.shape[-1] :]
        np.maximum(beyond, 0.0, out=beyond)
        return np.einsum("...i,...i->...", beyond, beyond)

    def half_height(self, rotation: Array) -> float:
        """How far the shape reaches below its centre when turned by `rotation` (3, 3), m."""
        x, _, z = self.half_size
        if self.kind == "sphere":
            return x
        if self.kind == "cylinder":
            upright = abs(rotation[2, 2])
            return float(z * upright + x * math.sqrt(max(0.0, 1.0 - upright**2)))
        return float(np.abs(rotation[2]) @ self.half_size)


@dataclass(frozen=True)
class ObjectState:
    """Pose and velocity of the object, world frame, SI units."""

    position: Array
    """(3,)"""
    orientation: Array
    """(4,) quaternion wxyz."""
    rotation: Array
    """(3, 3), the same orientation as a matrix."""


def make(kind: Kind, size: tuple[float, ...]) -> Shape:
    """A shape from its measures in m: a box's edges (one: a cube), a sphere's diameter, a
    cylinder's diameter and height (one: both). ValueError for another number of them."""
    numbers = {"box": (1, 3), "sphere": (1,), "cylinder": (1, 2)}[kind]
    if len(size) not in numbers:
        raise ValueError(
            f"object_size: found {len(size)} numbers, allowed for a {kind}: "
            + " or ".join(map(str, numbers))
        )
    edges = {1: size * 3, 2: (size[0], size[0], size[-1]), 3: size}[len(size)]
    x, y, z = (edge / 2 for edge in edges)
    return Shape(kind, (x, y, z))


def cube(size: float) -> Shape:
    """A cube with edges of `size` m."""
    return make("box", (size,))
