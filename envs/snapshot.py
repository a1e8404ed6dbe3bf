"""What is true after a control step: what tasks judge and what a policy is told of."""

from __future__ import annotations

from dataclasses import dataclass

from .hands import Array
from .objects import ObjectState, Shape


@dataclass(frozen=True)
class Snapshot:
    """A hand and an object, world frame, SI units."""

    hand: Array
    """(3,) palm point."""
    fingertips: Array
    """(n_digits, 3)"""
    joint_positions: Array
    """(n_joints,) in the order of the hand's ``joints``."""
    joint_velocities: Array
    """(n_joints,)"""
    targets: Array
    """(n_actuators,) the joint targets last asked for."""
    object: ObjectState
    shape: Shape

    @property
    def clearance(self) -> float:
        """Under the object's lowest point, m."""
        return float(self.object.position[2] - self.shape.half_height(self.object.rotation))
