"""What happens to readings on their way: pure functions of what was recorded.

Whether a taxel is dead or stuck is its own fate for life, so it is drawn for each taxel once; a
false reading is drawn for each reading.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class TaxelFaults:
    """Shares of taxels, and probabilities of readings, that are wrong."""

    taxel_dead: float = 0.0
    """Share of taxels that never fire."""
    taxel_stuck: float = 0.0
    """Share of taxels that always fire."""
    taxel_false_on: float = 0.0
    """Probability that a taxel fires which should not."""
    taxel_false_off: float = 0.0
    """Probability that a taxel does not fire which should."""

    def validate(self) -> None:
        """Raise ValueError naming the first share that cannot be."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{field.name}: found {value}, allowed from 0 to 1")
        if self.taxel_dead + self.taxel_stuck > 1.0:
            raise ValueError(
                f"taxel_stuck: found {self.taxel_stuck}, allowed up to {1 - self.taxel_dead:g}, "
                "what is not dead"
            )

    def apply(self, readings: Array, rng: np.random.Generator) -> Array:
        """The readings bool (n, taxels) with these faults. The shares are met as nearly as whole
        taxels allow."""
        order = rng.permutation(readings.shape[1])
        n_dead, n_stuck = (round(s * len(order)) for s in (self.taxel_dead, self.taxel_stuck))
        chance = rng.random(readings.shape)
        felt = np.where(readings, chance >= self.taxel_false_off, chance < self.taxel_false_on)
        felt[:, order[:n_dead]] = False
        felt[:, order[len(order) - n_stuck :]] = True
        return felt


def noisy_angles(angles: Array, noise: float, rng: np.random.Generator) -> Array:
    """Joint angles (n, joints) with white noise of `noise` rad; the same draws at any `noise`."""
    return angles + noise * rng.standard_normal(angles.shape)
