"""Running moments of observations, the same on all ranks, and the units in which networks see them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import Array, Communicator

ARRAYS = "as_is", "block", "min_std", "mean", "squares"
NUMBERS = "count", "block_squares"
MIN_STD = 0.01
"""Default floor of the standard deviation (OpenAI baselines): constant columns stay
near zero."""
BLOCK_NORM = 24.0
"""Mean squared norm that a block of columns is given: that of as many standardized
columns."""
PRIOR_ROWS = 1000
"""Rows, each of squared norm 1, that a block's moments begin with, so that its gain
never jumps."""


class Scaling(NamedTuple):
    """Map values, cut to ±bound, to (values - mean) / std, cut to ±limit.

    The mean is subtracted in two parts, so that float32 keeps the digits of values that
    lie far from zero.
    """

    mean_high: Tensor
    mean_low: Tensor
    inverse_std: Tensor
    limit: Tensor
    bound: Tensor

    def __call__(self, values: Tensor) -> Tensor:
        """Return normalized float32 (..., size) of float32 `values`."""
        high, low, inverse_std, limit, bound = (part.to(values.device) for part in self)
        centred = values.clamp(-bound, bound).sub_(high).sub_(low)
        return centred.mul_(inverse_std).clamp_(-limit, limit)


class Normalizer:
    """Track running moments of columns and scale each to mean 0 and standard deviation 1.

    Moments are merged batch by batch in float64 (Chan, Golub & LeVeque 1979), because
    E[x²] - E[x]² loses every digit when the mean is large against the spread.

    Two masks, bool (size,), name columns that are treated otherwise. Those of `as_is`
    are not changed at all. Those of `block` share one gain and keep their zero: the
    block's squared norm is `BLOCK_NORM` on average, however many columns it has and
    however rarely each is not zero. Its values are cut at ±`clip` like all others,
    which a rare single column may reach.

    Columns are divided by at least `min_std`: one for all, or one each (size,). What is
    beyond ±`bound` counts as if it were there.
    """

    def __init__(
        self,
        size: int,
        comm: Communicator,
        clip: float = math.inf,
        as_is: bool | Array = False,
        block: bool | Array = False,
        min_std: float | Array = MIN_STD,
        bound: float = math.inf,
    ) -> None:
        self.comm, self.clip, self.bound = comm, clip, bound
        self.min_std = np.full(size, min_std, np.float64)
        self.as_is, self.block = np.full(size, as_is), np.full(size, block)
        self.count = 0.0
        self.mean = np.zeros(size)
        self.squares = np.zeros(size)  # sum of squared deviations from the mean
        self.block_squares = 0.0  # sum of the block's squared norms

    @property
    def std(self) -> Array:
        """Divisor of each column, float64 (size,): at least `min_std`.

        Before the first update the deviation counts as 1, in a block as sqrt(1 / BLOCK_NORM).
        """
        is_new = self.count == 0
        variance = np.ones_like(self.mean) if is_new else self.squares / self.count
        norm = (PRIOR_ROWS + self.block_squares) / (PRIOR_ROWS + self.count)
        variance = np.where(self.block, norm / BLOCK_NORM, variance)
        return np.where(self.as_is, 1.0, np.maximum(np.sqrt(variance), self.min_std))

    def update(self, batch: Array) -> None:
        """Take in the rows (n, size) that each rank has; every rank must call it, n may be 0."""
        batch = np.asarray(batch, np.float64).clip(-self.bound, self.bound)
        block_squares = np.square(batch[:, self.block]).sum()
        total = self.comm.sum(np.append(batch.sum(axis=0), [block_squares, len(batch)]))
        count = float(total[-1])
        if not count:
            return
        mean = total[:-2] / count
        squares = self.comm.sum(np.square(batch - mean).sum(axis=0))
        gap, all_count = mean - self.mean, self.count + count
        self.squares += squares + np.square(gap) * (self.count * count / all_count)
        self.mean += gap * (count / all_count)
        self.count = all_count
        self.block_squares += float(total[-2])
        has_moments = ~(self.as_is | self.block)
        self.mean *= has_moments
        self.squares *= has_moments

    def scaling(self) -> Scaling:
        """Return what it does to values now; later updates do not change what was returned."""
        high = self.mean.astype(np.float32)
        low = (self.mean - high).astype(np.float32)
        inverse_std = (1.0 / self.std).astype(np.float32)
        limit = np.where(self.as_is, np.inf, self.clip).astype(np.float32)
        bound = np.full_like(high, self.bound)
        return Scaling(*map(torch.from_numpy, (high, low, inverse_std, limit, bound)))

    def state_dict(self) -> dict[str, Any]:
        """Return moments and masks, as tensors and numbers."""
        arrays = {name: torch.tensor(getattr(self, name)) for name in ARRAYS}
        return arrays | {name: getattr(self, name) for name in NUMBERS}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put back what `state_dict` returned."""
        for name in ARRAYS:
            if name in state:  # 0.5.0 saved no `min_std`
                setattr(self, name, state[name].numpy().copy())
        for name in NUMBERS:
            setattr(self, name, float(state[name]))
