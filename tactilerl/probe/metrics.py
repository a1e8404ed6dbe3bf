"""How good is a prediction? Each measure takes weights (b, n), how often each grasp counts, and
returns (b,): with all ones the value, with the counts of bootstrap samples its distribution."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from .. import statistics
from ..envs.state import Array

MEMORY = 4_000_000  # weights handled at once
LOWER_IS_BETTER = ("log_loss", "error_mm", "error_deg")


def measure(name: str, truth: Array, prediction: Array, weights: Array) -> Array:
    """The measure of that name, (b,)."""
    size = max(1, MEMORY // weights.shape[1])
    batches = (weights[i : i + size] for i in range(0, len(weights), size))
    return np.concatenate(
        [MEASURES[name](truth, prediction, batch) for batch in batches]
    )


def sign(name: str) -> int:
    """Of a difference that is for the better."""
    return -1 if name in LOWER_IS_BETTER else 1


def auc(held: Array, prediction: Array, weights: Array) -> Array:
    """Area under the ROC curve of the first column, ties counted half."""
    order = np.argsort(prediction[:, 0], kind="stable")
    scores, label = prediction[order, 0], held[order].astype(np.float32)
    counts = weights[:, order].astype(np.float32)  # whole numbers: sums are exact
    positive = counts * label
    negative = counts - positive
    starts = np.flatnonzero(np.r_[True, np.diff(scores) > 0])
    if len(starts) < len(scores):
        positive, negative = (
            np.add.reduceat(c, starts, axis=1) for c in (positive, negative)
        )
    below = np.cumsum(negative, axis=1)
    below -= negative / 2
    pairs = np.einsum("bi,bi->b", positive, below, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return pairs / (
            positive.sum(1, dtype=np.float64) * negative.sum(1, dtype=np.float64)
        )


def bits(held: Array, prediction: Array, weights: Array) -> Array:
    """Information about the outcome, bits a grasp: how much smaller the log loss of the first
    column's probabilities is than that of the second's, the share that held in training."""
    return _mean(
        -_surprise(held, prediction[:, 0]) + _surprise(held, prediction[:, 1]), weights
    )


def log_loss(held: Array, prediction: Array, weights: Array) -> Array:
    """Log loss of the first column's probabilities, bits a grasp."""
    return _mean(_surprise(held, prediction[:, 0]), weights)


def _surprise(held: Array, probability: Array) -> Array:
    return -np.log2(np.clip(np.where(held, probability, 1.0 - probability), 1e-12, 1.0))


def r2(truth: Array, prediction: Array, weights: Array) -> Array:
    """Share of the variance that is explained, mean over columns (n, d)."""
    variance = _mean(truth**2, weights) - _mean(truth, weights) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        return (1.0 - _mean((truth - prediction) ** 2, weights) / variance).mean(axis=1)


def error_mm(truth: Array, prediction: Array, weights: Array) -> Array:
    """Root mean square distance of points (n, d) in m, in mm."""
    return 1e3 * np.sqrt(_mean(np.square(truth - prediction).sum(axis=1), weights))


def error_deg(truth: Array, prediction: Array, weights: Array) -> Array:
    """Mean error of angles (n, 2), degrees: of the first column; the second is the period, rad. What
    is predicted is the point (n, 2) on a circle of one period."""
    yaw, period = truth.T
    found = np.arctan2(prediction[:, 1], prediction[:, 0]) * (period / (2 * math.pi))
    off = np.abs((yaw - found + period / 2) % period - period / 2)
    return np.degrees(_mean(off, weights))


def balanced_accuracy(truth: Array, prediction: Array, weights: Array) -> Array:
    """Share of right classes (n,) in each class, mean over the classes."""
    right, classes = truth == prediction, (truth == label for label in np.unique(truth))
    with np.errstate(invalid="ignore"):
        return np.mean([_mean(right[one], weights[:, one]) for one in classes], axis=0)


def _mean(values: Array, weights: Array) -> Array:
    """(n,) -> (b,), (n, d) -> (b, d)."""
    weights = weights.astype(float)
    return ((weights @ values).T / weights.sum(axis=1)).T


MEASURES: dict[str, Callable[[Array, Array, Array], Array]] = {
    each.__name__: each
    for each in (auc, bits, log_loss, r2, error_mm, error_deg, balanced_accuracy)
}
"""(truth, prediction, weights (b, n)) -> (b,), by name."""


def estimate(name: str, samples: Array, interval: str = "interval") -> dict[str, Any]:
    """As JSON has a value: of all grasps, and its percentile interval [low, high] by the bootstrap
    samples behind it, under these names; None where there is no number."""
    low, high = statistics.percentile_interval(samples[1:])
    ends = None if math.isnan(low) else [low, high]
    return {
        name: float(samples[0]) if math.isfinite(samples[0]) else None,
        interval: ends,
    }


def gain(samples: Array) -> dict[str, Any]:
    """As JSON has a gain."""
    return estimate("gain", samples, "gain_interval")
