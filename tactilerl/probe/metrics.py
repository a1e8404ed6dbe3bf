"""How good is a prediction? Each measure takes weights (b, n), how often each grasp counts, and
returns (b,): with all ones the value, with the counts of bootstrap samples its distribution."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import statistics
from ..envs.hands import Array

MEMORY = 4_000_000  # weights handled at once


@dataclass(frozen=True)
class Metric:
    """A measure of predictions against the truth."""

    name: str
    unit: str
    higher_is_better: bool
    measure: Callable[[Array, Array, Array], Array]
    """(truth, prediction, weights (b, n)) -> (b,)"""

    @property
    def sign(self) -> int:
        """Of a difference that is for the better."""
        return 1 if self.higher_is_better else -1

    def __call__(self, truth: Array, prediction: Array, weights: Array) -> Array:
        size = max(1, MEMORY // weights.shape[1])
        batches = (weights[i : i + size] for i in range(0, len(weights), size))
        parts = [self.measure(truth, prediction, w) for w in batches]
        return np.concatenate(parts)


def auc(held: Array, prediction: Array, weights: Array) -> Array:
    """Area under the ROC curve of the first column, ties counted half."""
    order = np.argsort(prediction[:, 0], kind="stable")
    scores, label = prediction[order, 0], held[order].astype(np.float32)
    counts = weights[:, order].astype(np.float32)  # whole numbers: sums are exact
    positive = counts * label
    negative = counts - positive
    starts = np.flatnonzero(np.r_[True, np.diff(scores) > 0])
    if len(starts) < len(scores):
        positive, negative = (np.add.reduceat(c, starts, axis=1) for c in (positive, negative))
    below = np.cumsum(negative, axis=1)
    below -= negative / 2
    pairs = np.einsum("bi,bi->b", positive, below, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return pairs / (positive.sum(1, dtype=np.float64) * negative.sum(1, dtype=np.float64))


def bits(held: Array, prediction: Array, weights: Array) -> Array:
    """Information about the outcome, bits a grasp: how much smaller the log loss of the first
    column's probabilities is than that of the second's, the share that held in training."""
    return _mean(-_surprise(held, prediction[:, 0]) + _surprise(held, prediction[:, 1]), weights)


def log_loss(held: Array, prediction: Array, weights: Array) -> Array:
    """Log loss of the first column's probabilities, bits a grasp."""
    return _mean(_surprise(held, prediction[:, 0]), weights)


def _surprise(held: Array, probability: Array) -> Array:
    return -np.log2(np.clip(np.where(held, probability, 1.0 - probability), 1e-12, 1.0))


def r_squared(truth: Array, prediction: Array, weights: Array) -> Array:
    """Share of the variance that is explained, mean over columns (n, d)."""
    weights = weights.astype(float)
    total = weights.sum(1, keepdims=True)
    variance = weights @ truth**2 / total - (weights @ truth / total) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        return (1.0 - (weights @ (truth - prediction) ** 2 / total) / variance).mean(axis=1)


def error_mm(truth: Array, prediction: Array, weights: Array) -> Array:
    """Root mean square distance of points (n, d) in m, in mm."""
    return 1e3 * np.sqrt(_mean(np.square(truth - prediction).sum(axis=1), weights))


def error_degrees(truth: Array, prediction: Array, weights: Array) -> Array:
    """Mean error of angles (n, 2), degrees: of the first column; the second is the period, rad."""
    period = truth[:, 1]
    off = np.abs((truth[:, 0] - prediction[:, 0] + period / 2) % period - period / 2)
    return np.degrees(_mean(off, weights))


def balanced_accuracy(truth: Array, prediction: Array, weights: Array) -> Array:
    """Share of right classes (n,) in each class, mean over the classes."""
    right, weights = (truth == prediction).astype(float), weights.astype(float)
    shares = []
    with np.errstate(invalid="ignore"):
        for label in np.unique(truth):
            is_one = truth == label
            shares.append((weights @ (right * is_one)) / (weights @ is_one.astype(float)))
    return np.mean(shares, axis=0)


def _mean(values: Array, weights: Array) -> Array:
    weights = weights.astype(float)
    return weights @ values / weights.sum(axis=1)


AUC = Metric("auc", "", True, auc)
BITS = Metric("bits", "bit", True, bits)
LOG_LOSS = Metric("log_loss", "bit", False, log_loss)
R_SQUARED = Metric("r2", "", True, r_squared)
ERROR_MM = Metric("error_mm", "mm", False, error_mm)
ERROR_DEGREES = Metric("error_deg", "°", False, error_degrees)
BALANCED_ACCURACY = Metric("balanced_accuracy", "", True, balanced_accuracy)


def number(value: float) -> float | None:
    """As JSON has it: None where there is no number."""
    return float(value) if math.isfinite(value) else None


def interval(samples: Array) -> list[float] | None:
    """Percentile interval [low, high] of bootstrap samples; None where there is no number."""
    low, high = statistics.percentile_interval(samples)
    return None if math.isnan(low) else [low, high]


def gain(samples: Array) -> dict[str, Any]:
    """As JSON has a gain: of all grasps, and its interval by the bootstrap samples behind it."""
    return {"gain": number(samples[0]), "gain_interval": interval(samples[1:])}
