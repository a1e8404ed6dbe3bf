"""What a policy gradient is made of: advantages, densities, the clipped surrogate objective."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from . import Array

MAX_LOG_RATIO = 20.0  # exp(20) = 5e8: far outside any clip range, far inside float32


def gae(rewards: Array, values: Array, last_value: float, gamma: float, lam: float) -> Array:
    """Generalised advantages (n,) of one episode, float64 (Schulman et al. 2016, eq. 16).

    `values` (n,) are the critic's at each step, `last_value` the one after the last step:
    0 where nothing follows.
    """
    next_values = np.append(values[1:], last_value)
    deltas = (rewards + gamma * next_values - values).tolist()
    advantages = np.empty(len(deltas))
    running = 0.0
    for t in range(len(deltas) - 1, -1, -1):
        running = deltas[t] + gamma * lam * running
        advantages[t] = running
    return advantages


class Spread(nn.Module):
    """Standard deviations (d,) with which actions explore, in units where the bounds are ±1:
    sqrt(variance) · exp(log)."""

    def __init__(self, n_actions: int, variance: float) -> None:
        super().__init__()
        self.variance, self.log = variance, nn.Parameter(torch.zeros(n_actions))

    def set(self, variance: float) -> None:
        """The same variance for all dimensions."""
        self.log.data.fill_(0.5 * math.log(variance / self.variance))

    def std(self) -> Array:
        """float32 (d,)."""
        relative: Array = self.log.detach().cpu().exp().numpy()
        return np.float32(self.variance**0.5) * relative

    def away(self, actions: Tensor, mean: Tensor) -> Tensor:
        """How far (n, d) actions are from their mean, in units of exp(log)."""
        return (actions - mean) / self.log.exp()

    def log_prob(self, away: Tensor) -> Tensor:
        """Log density (n,) of normal actions that are so far `away` (n, d)."""
        squared, dimensions = away.square().sum(dim=-1), away.shape[-1]
        density = squared / self.variance + dimensions * math.log(2 * math.pi * self.variance)
        return -0.5 * density - self.log.sum()

    @torch.no_grad()
    def backward(self, away: Tensor, slope: Tensor, n: int) -> Tensor:
        """Gradient (m, d) of a loss by the means of the actions.

        `slope` (m,) is that of each transition's loss by its log density, `n` the size of the whole
        minibatch, of which the loss is the mean. Where `log` is learned, its gradient is written
        into its `grad`.
        """
        if self.log.grad is not None:
            by_log = (slope / n)[:, None] * (away.square() / self.variance - 1.0)
            self.log.grad.copy_(by_log.sum(dim=0))
        return (slope / (n * self.variance))[:, None] * away / self.log.exp()


def normalise(advantages: Array) -> Array:
    """Advantages (n,) with mean 0 and standard deviation 1; zeros where all are alike."""
    centred = advantages - advantages.mean()
    std = np.sqrt(np.square(centred).mean())
    return centred / std if std > 1e-10 * np.abs(advantages).max() else np.zeros_like(centred)


class Transitions(NamedTuple):
    """What is learned from, as tensors with a leading axis (n, ...)."""

    seen: Tensor
    """By the critic; it begins with what the actor sees."""
    actions: Tensor
    log_prob: Tensor
    """Of the actions, when they were taken."""
    advantages: Tensor
    returns: Tensor

    def minibatches(self, order: Tensor, n: int) -> list[Transitions]:
        """All of it in another order (n,), cut into `n` parts as equal as can be."""
        parts = (torch.tensor_split(values[order], n) for values in self)
        return [Transitions(*part) for part in zip(*parts, strict=True)]

    def share(self, rank: int, ranks: int) -> Transitions:
        """A rank's rows."""
        return Transitions(*(torch.tensor_split(values, ranks)[rank] for values in self))


class Surrogate(NamedTuple):
    """The clipped surrogate objective, negated, of each transition (n,), and what it is made of."""

    loss: Tensor
    slope: Tensor
    """Gradient of the loss by the log ratio."""
    kl: Tensor
    """Unbiased estimate of the KL divergence from the old policy."""
    is_clipped: Tensor
    """Is the ratio outside the clip range?"""


def surrogate(log_ratio: Tensor, advantages: Tensor, clip_range: float) -> Surrogate:
    """Schulman et al. 2017, eq. 7, from log ratios and advantages (n,).

    Log ratios are cut at ±20 first: no minimum changes, and an overflow cannot happen.
    """
    cut = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)
    ratio = cut.exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    gain, bounded = ratio * advantages, clipped * advantages
    counts = (gain <= bounded) & (cut == log_ratio)
    return Surrogate(
        loss=-torch.minimum(gain, bounded),
        slope=-gain * counts,
        kl=ratio - 1 - log_ratio,
        is_clipped=clipped != ratio,
    )


def gaussian(actions: Array, seen: Tensor, rng: np.random.Generator, std: Array) -> Array:
    """Actions (n, d) with independent normal noise of standard deviations `std` (d,), float32."""
    return actions + std * rng.standard_normal(actions.shape, dtype=np.float32)
