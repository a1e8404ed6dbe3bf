"""Hold what is true at one moment.

A simulator is read once per control step; touch, senses, tasks, rewards and pictures
are functions of its state, and of nothing else. They take the state of one scene, and
as well that of many: its arrays then have a leading axis, of scenes, and may be
PyTorch's tensors.

World frame, z up, ground at 0; SI units, quaternions wxyz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from .objects import Shape

Array = np.ndarray


class Contacts(NamedTuple):
    """Contacts (k of them) at which the hand presses on the object."""

    points: Array
    """Places of the contacts (..., k, 3), m."""
    links: Array
    """Index (..., k) of each contact's link in the state's ``links``."""
    forces: Array
    """Normal forces (..., k), above 0, N; 0 where one of many scenes has fewer contacts
    than others."""
    normals: Array
    """Unit normals (..., k, 3), from the hand into the object."""


@dataclass(frozen=True)
class State:
    """A hand and an object at one moment."""

    shape: Shape
    """Shape of the object."""
    object_position: Array
    """Centre of the object (..., 3), m."""
    object_rotation: Array
    """Rotation matrix of the object (..., 3, 3)."""
    object_orientation: Array
    """Orientation of the object as a quaternion (..., 4), wxyz."""
    object_velocity: Array
    """Velocity of the object's centre (..., 3), m/s."""
    object_angular_velocity: Array
    """Angular velocity of the object (..., 3), rad/s."""
    links: tuple[str, ...]
    """Names of the hand's bodies."""
    link_positions: Array
    """Positions of the links (..., n_links, 3), m."""
    link_rotations: Array
    """Rotation matrices of the links (..., n_links, 3, 3)."""
    palm: Array
    """Palm point (..., 3), m."""
    fingertips: Array
    """Tips of the digits (..., n_digits, 3), m."""
    joint_positions: Array
    """Joint positions (..., n_joints) in the order of the hand's ``joints``, m and
    rad."""
    joint_velocities: Array
    """Joint velocities (..., n_joints), m/s and rad/s."""
    targets: Array
    """Latest joint targets (..., n_actuators), m and rad."""
    contacts: Contacts
    """Contacts at which the hand presses on the object."""
    sensors: Array
    """Readings of the simulator's own sensors, bool (..., n): True where one feels a
    contact."""

    def poses(self, links: tuple[str, ...]) -> tuple[Array, Array]:
        """Return positions (..., k, 3) and rotations (..., k, 3, 3) of links.

        Raise ValueError for a name that no link has.
        """
        indices = places(self.links, links)
        return self.link_positions[..., indices, :], self.link_rotations[
            ..., indices, :, :
        ]

    @property
    def clearance(self) -> Any:
        """Height of the object's lowest point over the ground (...), m."""
        return self.object_position[..., 2] - self.shape.half_height(
            self.object_rotation
        )

    def map(self, change: Callable[[Any], Any]) -> State:
        """Return a state of many scenes with each of its arrays changed."""
        fixed = "shape", "links", "contacts"
        return replace(
            self,
            shape=replace(
                self.shape, half_size=tuple(map(change, self.shape.half_size))
            ),
            contacts=Contacts(*map(change, self.contacts)),
            **{
                name: change(value)
                for name, value in vars(self).items()
                if name not in fixed
            },
        )


@lru_cache(maxsize=1024)
def places(all_links: tuple[str, ...], links: tuple[str, ...]) -> Array:
    """Return the index of each of `links` among all; raise ValueError for a name that is not there."""
    return np.array([all_links.index(link) for link in links], int)
