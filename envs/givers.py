"""Who brings the object to the hand: someone who holds it softly, moves it and lets go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .hands import Array


@dataclass(frozen=True)
class Giver:
    """Holds the object by a damped spring and carries its weight.

    The spring's rest point moves at `speed`, so what stands in the way is pressed on more and more
    softly yielding, and never with more than `force`.
    """

    stiffness: float = 80.0
    """N/m"""
    damping: float = 4.0
    """N s/m; about critical for 50 g."""
    force: float = 1.0
    """The most along each axis, N."""
    speed: float = 0.6
    """m/s"""

    def pull(self, rest: Array, position: Array, velocity: Array) -> Array:
        """The spring's force (3,) in N on an object at `position`, its rest point being `rest`."""
        force = self.stiffness * (rest - position) - self.damping * velocity
        return np.clip(force, -self.force, self.force)
