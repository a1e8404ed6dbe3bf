"""A soft covering of the hand: how a silicone pad gives way, as MuJoCo's contacts can follow it.

A fingertip that is pressed into a flat pad bonded to a rigid base meets, by Long et al.
(Biophysical Journal 101:643, 2011: finite elements, incompressible neo-Hookean, depths
up to 0.6 of the thickness), Hertz's force times a factor that depends on x = radius ×
depth / thickness² alone where the pad is no thicker than half of the radius. So force /
depth is modulus × thickness times a function of x. At rest MuJoCo's contact carries, by
its manual ("Computation", "Parameters"),

    force = stiffness × depth × d² / ((1 - d) × d_max² × ease),

with the impedance d, which grows with the depth, and `ease` the inverse masses of both
sides. Its five constants were fitted to the law for x from 0.1 to 2, on which the force
is wrong by less than 20 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .state import Array

RADIUS = 8e-3  # m, of a fingertip, or of what is pressed into the palm
STIFFNESS = 0.885  # times modulus × thickness × ease, 1/s²
# Of the impedance; the width is an x.
LEAST, MOST, WIDTH, POWER = 0.548, 0.95, 5.556, 12.0
RELAXATION = 0.01  # s, damping / stiffness
# What 1/s² × timestep² and 1/s × timestep may be, so that no contact shakes.
STEADY = 1.0


@dataclass(frozen=True)
class Skin:
    """A covering of silicone, which is the outermost part of a hand's links."""

    thickness: float
    """Thickness, m."""
    modulus: float
    """Young's modulus, Pa."""

    @property
    def solimp(self) -> tuple[float, ...]:
        """The impedance of a contact, as MuJoCo's `solimp` (5,)."""
        return LEAST, MOST, WIDTH * self.thickness**2 / RADIUS, 0.0, POWER

    def solref(self, ease: Array, timestep: float) -> Array:
        """Return MuJoCo's `solref` (..., 2) of contacts with these sums of inverse masses, 1/kg (...).

        Where a spring so stiff would shake at this timestep, s, it is softer: under a
        few grams.
        """
        stiffness = STIFFNESS * self.modulus * self.thickness * ease
        spring = stiffness[..., None] * [1.0, RELAXATION]
        return -np.minimum(spring, [STEADY / timestep**2, STEADY / timestep])
