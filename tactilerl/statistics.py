"""Statistics of evaluations and studies: pure functions over arrays.

The first axis is always the samples: episodes or runs (independent seeds). Scores of runs are
shares of success in [0, 1]. The interquartile mean (IQM) and its bootstrap are those of Agarwal et
al. 2021, "Deep reinforcement learning at the edge of the statistical precipice"
(https://arxiv.org/abs/2108.13264).

Mean and IQM are trimmed means. So a resample need not be sorted again: sort the runs once and count
how often each of them was drawn.
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
TRIM = 0.25  # the IQM leaves out this share of the runs at each end
FEW_RUNS = 10  # below this a percentile interval is too narrow: docs/statistics.md has the coverage


class Estimate(NamedTuple):
    """A value and its interval."""

    value: float
    low: float
    high: float


# -- one number per run ----------------------------------------------------------------------


def converged_rate(rates: Array) -> float:
    """Return the level at which a curve (points,) spends most of its points.

    The mode of the learning curve's histogram over [0, 1] (Melnik et al. 2021, "Using tactile
    sensing to improve the sample efficiency and performance of deep deterministic policy gradients
    for simulated in-hand manipulation tasks"): the mean of the points in the fullest bin. Of
    equally full bins the one that the curve visited last counts.
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


def iqm(scores: Array) -> Array:
    """Return the interquartile mean over the runs; (runs, ...) → (...).

    It drops int(n / 4) runs at each end, as rliable does: two of ten.
    """
    return np.asarray(scipy.stats.trim_mean(scores, TRIM, axis=0))


def resample(rng: np.random.Generator, n: int, n_resamples: int = N_RESAMPLES) -> Array:
    """Draw how often each of `n` runs is in each bootstrap resample; (n, n_resamples)."""
    drawn = np.empty((n_resamples, n), np.uint8)  # no run is drawn 256 times
    for part in np.array_split(drawn, 1 + drawn.size // 2**20):  # to save memory
        runs = rng.integers(n, size=part.shape)
        runs += n * np.arange(len(part))[:, None]
        part[:] = np.bincount(runs.ravel(), minlength=part.size).reshape(part.shape)
    return np.ascontiguousarray(drawn.T)


def bootstrap(scores: Array, counts: Array, trim: float = 0.0) -> Array:
    """Return the trimmed mean of each resample; (runs,), (runs, n_resamples) → (n_resamples,).

    `trim` is the share of runs left out at each end: 0 for the mean, `TRIM` for the IQM.

    With the runs sorted and C[i] the number drawn up to run i, run i takes the places C[i-1] to
    C[i] of the sorted resample. With k places trimmed at each end, W[i] = clip(C[i], k, n - k) - k
    of those up to C[i] are kept, so the aggregate is Σ x[i] (W[i] - W[i-1]) / (n - 2k); it is
    summed by parts.
    """
    n, k = len(scores), int(trim * len(scores))
    order = np.argsort(scores, kind="stable")
    drawn = np.ascontiguousarray(counts[order[:-1]], np.min_scalar_type(n))
    for run in range(1, n - 1):  # np.cumsum over the first axis takes ten times as long
        drawn[run] += drawn[run - 1]
    weights = np.clip(drawn, k, n - k, out=drawn) - drawn.dtype.type(k)
    ordered = scores[order]
    return np.asarray(ordered[-1] - (np.diff(ordered) / (n - 2 * k)) @ weights)


def percentile_interval(
    distribution: Array, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the central part of a bootstrap distribution (n_resamples,), Efron's interval."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(distribution, [tail, 1 - tail])
    return float(low), float(high)


def sample_efficiency(curves: Array, counts: Array) -> tuple[Array, Array]:
    """Return the IQM over the runs at every point, with pointwise percentile intervals.

    (runs, points), counts (runs, n_resamples) → (points,), (points, 2). One point at a time, so
    that memory does not grow with their number; points at which the runs' scores are the same are
    computed once.
    """
    distinct, place = np.unique(curves, axis=1, return_inverse=True)
    intervals = np.array(
        [percentile_interval(bootstrap(point, counts, TRIM)) for point in distinct.T]
    )
    return iqm(curves), intervals[place.ravel()]


def wilson_interval(n_successes: int, n: int) -> tuple[float, float]:
    """Return the interval of a probability from `n_successes` of `n` (Wilson 1927)."""
    test = scipy.stats.binomtest(n_successes, n)
    interval = test.proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


# -- means of few samples, and pairs ------------------------------------------------------------


def expanded(n: int) -> float:
    """Return the confidence at which a percentile interval of the mean of `n` samples is right.

    Hesterberg 2015, "What teachers should know about the bootstrap" (https://arxiv.org/abs/1411.5279):
    a bootstrap's spread is too small by a factor of sqrt(1 - 1/n), and takes the spread of the samples
    for the true one, as a normal instead of a t quantile would.
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
    interval = percentile_interval(bootstrap(samples, counts), expanded(len(samples)))
    return Estimate(float(samples.mean()), *interval)


def sign_flip_p(
    differences: Array, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> float:
    """Return the two-sided p-value of a mean difference (pairs,), by exchanging labels in pairs.

    It is exact up to 16 pairs (Fisher 1935); with three it cannot fall below 0.25. It is NaN with
    fewer than two.
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
