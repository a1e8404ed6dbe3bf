"""Sensors with faults: what the environment does to readings on their way, done to recorded ones."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np

from ..envs.hands import Array
from ..envs.observations import SensorConfig, taxel_stages


@dataclass(frozen=True)
class TaxelFaults:
    """Broken taxels and false readings."""

    taxel_dead: float = 0.0
    """Share of taxels that never fire."""
    taxel_stuck: float = 0.0
    """Share of taxels that always fire."""
    taxel_false_on: float = 0.0
    """Probability that a taxel fires when it should not."""
    taxel_false_off: float = 0.0
    """Probability that a taxel does not fire when it should."""

    def validate(self) -> None:
        """Raise ValueError naming the first invalid share."""
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
        """The readings bool (n, taxels) with these faults: the same taxels are broken in all."""
        sensors = SensorConfig(**asdict(self), hand_seed=int(rng.integers(2**32)))
        faulty = readings
        for stage in taxel_stages(sensors, readings.shape[1]):
            stage.begin(rng)
            faulty = stage(faulty)
        return faulty.astype(bool)


def noisy_angles(angles: Array, noise: float, rng: np.random.Generator) -> Array:
    """Joint angles (n, joints) with white noise of `noise` rad; the same draws at any `noise`."""
    return angles + noise * rng.standard_normal(angles.shape)
