"""The object to grasp: its shape, and where its surface is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .hands import Array

Kind = Literal["box"]


@dataclass(frozen=True)
class Shape:
    """A primitive in its own frame, centred at the origin."""

    kind: Kind
    half_size: tuple[float, float, float]
    """Half extents along its own axes, m."""

    def squared_distance(self, points: Array) -> Array:
        """Squared distance (n,) in m² from points (n, 3) to the solid, 0 inside."""
        beyond = np.abs(points)
        beyond -= self.half_size
        np.maximum(beyond, 0.0, out=beyond)
        return np.einsum("ij,ij->i", beyond, beyond)

    def half_height(self, rotation: Array) -> float:
        """How far the shape reaches below its centre when turned by `rotation` (3, 3), m."""
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


def cube(size: float) -> Shape:
    """A cube with edges of `size` m."""
    return Shape("box", (size / 2, size / 2, size / 2))
