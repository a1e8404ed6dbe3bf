"""Statistics of evaluations and studies: pure functions over arrays.

The first axis is always the samples: episodes or runs (independent seeds). Scores of
runs are shares of success in [0, 1].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # scipy.stats takes a while: it is loaded where it is first used

Array = np.ndarray
CONFIDENCE = 0.95
N_RESAMPLES = 50_000  # as the paper's learning curves have them
N_BINS = 50  # of the histogram behind the converged rate
END_SHARE = 0.2  # share of a run's points that count as its end


class Estimate(NamedTuple):
    """A value and its interval."""

    value: float
    low: float
    high: float


# -- one number per run ----------------------------------------------------------------------


def converged_rate(rates: Array) -> float:
    """Return the level at which a curve (points,) spends most of its points.

    The mode of the learning curve's histogram over [0, 1] (Melnik et al. 2021, "Using
    tactile sensing to improve the sample efficiency and performance of deep
    deterministic policy gradients for simulated in-hand manipulation tasks"): the mean
    of the points in the fullest bin. Of equally full bins the one that the curve
    visited last counts.
    """
    # Rounded, for 0.58 * 50 is 28.999999999999996.
    bins = np.minimum(np.floor(np.round(rates * N_BINS, 9)), N_BINS - 1).astype(int)
    counts = np.bincount(bins)[bins]  # at each point, of its bin
    last_of_fullest = np.flatnonzero(counts == counts.max())[-1]
    return float(rates[bins == bins[last_of_fullest]].mean())


def end_rate(rates: Array, share: float = END_SHARE) -> float:
    """Return the mean of the last fifth of a curve (points,), or another `share`; a point at least."""
    n_last = max(1, math.ceil(share * len(rates)))
    return float(rates[-n_last:].mean())


def area_under_curve(steps: Array, rates: Array) -> float:
    """Return the mean height of a curve: rates (points,) at steps (points,), by trapezoids."""
    if len(steps) == 1:
        return float(rates[0])
    return float(np.trapezoid(rates, steps) / (steps[-1] - steps[0]))


# -- over the runs ---------------------------------------------------------------------------


def resample(rng: np.random.Generator, n: int, n_resamples: int = N_RESAMPLES) -> Array:
    """Draw how often each of `n` samples is in each bootstrap resample; (n, n_resamples)."""
    drawn = rng.integers(n, size=(n_resamples, n)) + n * np.arange(n_resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape)
    return np.ascontiguousarray(counts.T)


def percentile_interval(
    distribution: Array, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the central part of a bootstrap distribution (n_resamples,), Efron's interval."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(distribution, [tail, 1 - tail])
    return float(low), float(high)


def wilson_interval(n_successes: int, n: int) -> tuple[float, float]:
    """Return the interval of a probability from `n_successes` of `n` (Wilson 1927)."""
    test = scipy.stats.binomtest(n_successes, n)
    interval = test.proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


# -- means of few samples, and pairs ------------------------------------------------------------


def expanded(n: int) -> float:
    """Return the confidence at which a percentile interval of the mean of `n` samples is right.

    Hesterberg 2015, "What teachers should know about the bootstrap"
    (https://arxiv.org/abs/1411.5279): a bootstrap's spread is too small by a factor of
    sqrt(1 - 1/n), and takes the spread of the samples for the true one, as a normal
    instead of a t quantile would.
    """
    wide = math.sqrt(n / (n - 1)) * scipy.stats.t.isf((1 - CONFIDENCE) / 2, n - 1)
    return 1 - 2 * float(scipy.stats.norm.sf(wide))


def mean(samples: Array, counts: Array) -> Estimate:
    """Return the mean of samples (n,), such as differences of pairs, with its expanded interval.

    It is NaN without samples, and its interval is NaN with a single one.
    """
    if len(samples) < 2:
        value = float(samples[0]) if len(samples) else math.nan
        return Estimate(value, math.nan, math.nan)
    means = samples @ counts / len(samples)
    interval = percentile_interval(means, expanded(len(samples)))
    return Estimate(float(samples.mean()), *interval)


def mean_curve(curves: Array, counts: Array) -> tuple[Array, Array]:
    """Return the mean over the runs at every point, with pointwise expanded intervals.

    (runs, points), counts (runs, n_resamples) → (points,), (points, 2).
    """
    intervals = [mean(point, counts)[1:] for point in curves.T]
    return curves.mean(axis=0), np.array(intervals)


def sign_flip_p(
    differences: Array, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> float:
    """Return the two-sided p-value of a mean difference (pairs,), by exchanging labels in pairs.

    It is exact up to 16 pairs (Fisher 1935); with three it cannot fall below 0.25. It
    is NaN with fewer than two.
    """
    if len(differences) < 2:
        return math.nan

    def rounded_mean(x: Array, axis: int) -> Array:
        return np.round(x.mean(axis), 12)  # ties may differ in their last bits

    test = scipy.stats.permutation_test(
        (differences,),
        rounded_mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=2 * n_resamples,  # opposite signs have the same mean
        batch=10_000,
        rng=rng,
    )
    return float(test.pvalue)


def fewest_pairs(alpha: float) -> int:
    """Return how many pairs let a two-sided sign-flip test fall to `alpha`: 6 for 0.05."""
    return math.ceil(1 - math.log2(alpha))


def holm(p_values: Sequence[float]) -> Array:
    """Correct the p-values of several comparisons so that the family keeps its level (Holm 1979).

    NaN stays NaN and does not count as a comparison.
    """
    from statsmodels.stats.multitest import multipletests

    corrected = np.array(p_values, float)
    known = ~np.isnan(corrected)
    if known.any():
        corrected[known] = multipletests(corrected[known], method="holm")[1]
    return corrected
