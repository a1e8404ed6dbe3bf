"""Hold what is true at one moment.

A simulator is asked once per control step; touch, senses, tasks, rewards and pictures are functions
of what it says, and of nothing else.

World frame, z up, ground at 0; SI units, quaternions wxyz. Arrays may have leading axes (...), of many
moments or many worlds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np

Array = np.ndarray
Kind = Literal["box", "sphere", "cylinder"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Shape:
    """A primitive in its own frame, centred at the origin; a cylinder stands along z. In m."""

    kind: Kind
    half_size: tuple[float, float, float]
    """Half extents along its own axes, m."""

    @property
    def width(self) -> float:
        """Larger of its two measures across, m."""
        return 2 * max(self.half_size[:2])

    @property
    def height(self) -> float:
        return 2 * self.half_size[2]

    @property
    def volume(self) -> float:
        """Volume, m³."""
        x, y, z = self.half_size
        factor = {"box": 8.0, "sphere": 4 / 3 * math.pi, "cylinder": 2 * math.pi}
        return factor[self.kind] * x * y * z

    def squared_distance(self, points: Array) -> Array:
        """Return the squared distance (...) in m² from points (..., 3) to the solid, 0 inside."""
        if self.kind == "sphere":
            return np.square(
                np.maximum(np.linalg.norm(points, axis=-1) - self.half_size[0], 0.0)
            )
        if self.kind == "cylinder":
            points = np.stack(
                [np.hypot(points[..., 0], points[..., 1]), points[..., 2]], axis=-1
            )
        beyond = np.abs(points)
        beyond -= self.half_size[-points.shape[-1] :]
        np.maximum(beyond, 0.0, out=beyond)
        return np.einsum("...i,...i->...", beyond, beyond)

    def half_height(self, rotation: Array) -> Array:
        """Return how far (...) the shape, turned by `rotation` (..., 3, 3), reaches below its centre.

        The distance is in m.
        """
        x, _, z = self.half_size
        if self.kind == "sphere":
            return np.full(rotation.shape[:-2], x)
        if self.kind == "cylinder":
            upright = np.abs(rotation[..., 2, 2])
            return np.asarray(
                z * upright + x * np.sqrt(np.maximum(0.0, 1.0 - upright**2))
            )
        return np.asarray(np.abs(rotation[..., 2, :]) @ self.half_size)


class Contacts(NamedTuple):
    """Hold the contacts (k of them) at which the hand presses on the object."""

    points: Array
    """(k, 3), m."""
    links: Array
    """(k,) int, of the state's ``links``."""
    forces: Array
    """(k,) normal force, above 0, N."""
    normals: Array
    """(k, 3) unit, from the hand into the object."""


def _nothing() -> Array:
    return np.zeros(0)


NO_CONTACTS = Contacts(
    np.zeros((0, 3)), np.zeros(0, int), np.zeros(0), np.zeros((0, 3))
)


@dataclass(frozen=True)
class State:
    """A hand and an object. What was not recorded is empty."""

    shape: Shape
    """Shape of the object."""
    object_position: Array
    """(..., 3) of the object's centre, m."""
    object_rotation: Array
    """(..., 3, 3)"""
    links: tuple[str, ...]
    """Names of the hand's bodies."""
    link_positions: Array
    """(..., n_links, 3)"""
    link_rotations: Array
    """(..., n_links, 3, 3)"""
    object_orientation: Array = field(default_factory=_nothing)
    """(..., 4), the same orientation as a quaternion."""
    object_velocity: Array = field(default_factory=_nothing)
    """(..., 3) of its centre, m/s."""
    object_angular_velocity: Array = field(default_factory=_nothing)
    """(..., 3) rad/s."""
    palm: Array = field(default_factory=_nothing)
    """(..., 3) the palm point."""
    fingertips: Array = field(default_factory=_nothing)
    """(..., n_digits, 3)"""
    joint_positions: Array = field(default_factory=_nothing)
    """(..., n_joints) in the order of the hand's ``joints``, m and rad."""
    joint_velocities: Array = field(default_factory=_nothing)
    """(..., n_joints)"""
    targets: Array = field(default_factory=_nothing)
    """(..., n_actuators) the joint targets last asked for."""
    contacts: Contacts = NO_CONTACTS
    sensors: Array = field(default_factory=_nothing)
    """(..., n) bool: do the sensors that the simulator itself has feel a contact?"""

    def poses(self, links: tuple[str, ...]) -> tuple[Array, Array]:
        """Return positions (..., k, 3) and rotations (..., k, 3, 3) of some links.

        ValueError for a name that none has.
        """
        at = places(self.links, links)
        return self.link_positions.take(at, axis=-2), self.link_rotations.take(
            at, axis=-3
        )

    @property
    def clearance(self) -> Array:
        """Height (...) of the object's lowest point over the ground, m."""
        return self.object_position[..., 2] - self.shape.half_height(
            self.object_rotation
        )


@lru_cache(maxsize=1024)
def places(links: tuple[str, ...], some: tuple[str, ...]) -> Array:
    """Return where some links are among all; ValueError for a name that none has."""
    return np.array([links.index(link) for link in some], int)
