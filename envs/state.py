"""Hold what is true at one moment.

A simulator is read once per control step; touch, senses, tasks, rewards and pictures are functions
of its state, and of nothing else.

World frame, z up, ground at 0; SI units, quaternions wxyz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
        """Height, m."""
        return 2 * self.half_size[2]

    @property
    def volume(self) -> float:
        """Volume, m³."""
        x, y, z = self.half_size
        factor = {"box": 8.0, "sphere": 4 / 3 * math.pi, "cylinder": 2 * math.pi}
        return factor[self.kind] * x * y * z

    def squared_distance(self, points: Array) -> Array:
        """Return the squared distances (n,) in m² from points (n, 3) to the solid, 0 inside."""
        if self.kind == "sphere":
            from_centre = np.linalg.norm(points, axis=-1)
            return np.square(np.maximum(from_centre - self.half_size[0], 0.0))
        if self.kind == "cylinder":  # (radius, height)
            radii = np.hypot(points[:, 0], points[:, 1])
            points = np.stack([radii, points[:, 2]], axis=-1)
        beyond = np.abs(points)
        beyond -= self.half_size[-points.shape[-1] :]
        np.maximum(beyond, 0.0, out=beyond)
        return np.einsum("ni,ni->n", beyond, beyond)

    def half_height(self, rotation: Array) -> float:
        """Return how far the shape, turned by `rotation` (3, 3), reaches below its centre, m."""
        x, _, z = self.half_size
        if self.kind == "sphere":
            return x
        if self.kind == "cylinder":
            upright = np.abs(rotation[2, 2])
            return float(z * upright + x * np.sqrt(np.maximum(0.0, 1.0 - upright**2)))
        return float(np.abs(rotation[2]) @ self.half_size)


class Contacts(NamedTuple):
    """Contacts (k of them) at which the hand presses on the object."""

    points: Array
    """Places of the contacts (k, 3), m."""
    links: Array
    """Index (k,) of each contact's link in the state's ``links``."""
    forces: Array
    """Normal forces (k,), above 0, N."""
    normals: Array
    """Unit normals (k, 3), from the hand into the object."""


@dataclass(frozen=True)
class State:
    """A hand and an object at one moment."""

    shape: Shape
    """Shape of the object."""
    object_position: Array
    """Centre of the object (3,), m."""
    object_rotation: Array
    """Rotation matrix of the object (3, 3)."""
    object_orientation: Array
    """Orientation of the object as a quaternion (4,), wxyz."""
    object_velocity: Array
    """Velocity of the object's centre (3,), m/s."""
    object_angular_velocity: Array
    """Angular velocity of the object (3,), rad/s."""
    links: tuple[str, ...]
    """Names of the hand's bodies."""
    link_positions: Array
    """Positions of the links (n_links, 3), m."""
    link_rotations: Array
    """Rotation matrices of the links (n_links, 3, 3)."""
    palm: Array
    """Palm point (3,), m."""
    fingertips: Array
    """Tips of the digits (n_digits, 3), m."""
    joint_positions: Array
    """Joint positions (n_joints,) in the order of the hand's ``joints``, m and rad."""
    joint_velocities: Array
    """Joint velocities (n_joints,), m/s and rad/s."""
    targets: Array
    """Latest joint targets (n_actuators,), m and rad."""
    contacts: Contacts
    """Contacts at which the hand presses on the object."""
    sensors: Array
    """Readings of the simulator's own sensors, bool (n,): True where one feels a contact."""

    def poses(self, links: tuple[str, ...]) -> tuple[Array, Array]:
        """Return positions (k, 3) and rotations (k, 3, 3) of links.

        Raise ValueError for a name that no link has.
        """
        indices = places(self.links, links)
        return self.link_positions[indices], self.link_rotations[indices]

    @property
    def clearance(self) -> float:
        """Height of the object's lowest point over the ground, m."""
        lowest = self.shape.half_height(self.object_rotation)
        return float(self.object_position[2]) - lowest


@lru_cache(maxsize=1024)
def places(all_links: tuple[str, ...], links: tuple[str, ...]) -> Array:
    """Return the index of each of `links` among all; raise ValueError for a name that is not there."""
    return np.array([all_links.index(link) for link in links], int)
