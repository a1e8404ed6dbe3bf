"""Running mean and standard deviation of observations, the same on all ranks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import Array
from .mpi import Communicator

MIN_STD = 0.01  # OpenAI baselines' floor: constant columns stay near zero instead of exploding


class Scaling(NamedTuple):
    """(values - mean) / std, within ±`clip`.

    The mean is subtracted in two parts, so that float32 keeps the digits of values that lie far
    from zero.
    """

    high: Tensor
    low: Tensor
    scale: Tensor
    clip: float

    def __call__(self, values: Tensor) -> Tensor:
        """Normalised float32 (..., size) of `values`, float32."""
        high, low, scale = (part.to(values.device) for part in self[:3])
        return (values - high).sub_(low).mul_(scale).clamp_(-self.clip, self.clip)


class Normalizer:
    """Scales columns to mean 0 and standard deviation 1, within ±`clip`.

    Moments are merged batch by batch in float64 (Chan, Golub & LeVeque 1979), because
    E[x²] - E[x]² loses every digit when the mean is large against the spread.

    Columns of `as_is`, bool (size,), count as having mean 0 and standard deviation 1.
    """

    def __init__(
        self,
        size: int,
        comm: Communicator,
        clip: float = np.inf,
        as_is: Array | None = None,
    ) -> None:
        self.comm, self.clip, self.as_is = comm, clip, as_is
        self.count = 0.0
        self.mean = np.zeros(size)
        self._squares = np.zeros(size)  # sum of squared deviations from the mean

    @property
    def std(self) -> Array:
        """float64 (size,), at least `MIN_STD`; ones before the first update."""
        if not self.count:
            return np.ones_like(self.mean)
        return np.maximum(np.sqrt(self._squares / self.count), MIN_STD)

    def update(self, batch: Array) -> None:
        """Take in the rows (n, size) that each rank has; every rank must call it, n may be 0."""
        batch = np.asarray(batch, np.float64)
        total = self.comm.sum(np.append(batch.sum(axis=0), len(batch)))
        count = float(total[-1])
        if not count:
            return
        mean = total[:-1] / count
        squares = self.comm.sum(np.square(batch - mean).sum(axis=0))
        gap, all_count = mean - self.mean, self.count + count
        self._squares += squares + np.square(gap) * (self.count * count / all_count)
        self.mean += gap * (count / all_count)
        self.count = all_count
        if self.as_is is not None:
            self.mean[self.as_is], self._squares[self.as_is] = 0.0, all_count

    def scaling(self) -> Scaling:
        """What it does to values now; later updates do not change what was returned."""
        high = self.mean.astype(np.float32)
        parts = (
            high,
            (self.mean - high).astype(np.float32),
            (1.0 / self.std).astype(np.float32),
        )
        high_, low, scale = map(torch.from_numpy, parts)
        return Scaling(high_, low, scale, self.clip)

    def state_dict(self) -> dict[str, Any]:
        mean, squares = torch.tensor(self.mean), torch.tensor(self._squares)
        return {"count": self.count, "mean": mean, "squares": squares}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.count = float(state["count"])
        self.mean = state["mean"].numpy().copy()
        self._squares = state["squares"].numpy().copy()
