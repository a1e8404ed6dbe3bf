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

    def signed_distance(self, points: Array) -> Array:
        """Distance (n,) in m from points (n, 3) to the surface, negative inside."""
        outside = np.abs(points) - self.half_size
        beyond = np.maximum(outside, 0.0)
        return np.sqrt(np.einsum("...i,...i", beyond, beyond)) + np.minimum(outside.max(-1), 0.0)

    def half_height(self, rotation: Array) -> float:
        """How far the shape reaches below its centre when turned by `rotation` (3, 3), m."""
        return float(np.abs(rotation[2]) @ self.half_size)


def cube(size: float) -> Shape:
    """A cube with edges of `size` m."""
    return Shape("box", (size / 2, size / 2, size / 2))
