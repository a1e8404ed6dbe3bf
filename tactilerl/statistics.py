"""What episodes, grasps and runs say, and how sure one can be: pure functions over arrays.

The first axis is always the samples: episodes, grasps or runs (independent seeds). Scores of runs are
shares of success in [0, 1] where nothing else is said. The aggregates and their bootstrap are those
of Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical
precipice" (https://arxiv.org/abs/2108.13264).

All three aggregates (median, IQM, mean) are trimmed means. So a resample need not be sorted again:
sort the runs once and count how often each of them was drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy  # scipy.stats takes a while: it is loaded where it is first used

Array = np.ndarray
Metric = Literal["median", "iqm", "mean"]
METRICS: tuple[Metric, ...] = ("median", "iqm", "mean")

CONFIDENCE = 0.95
N_RESAMPLES = 50_000  # as the paper's learning curves have them
N_BINS = 50  # of the histogram behind the converged rate
TAIL = 0.1  # share of a run's points that count as its end
TRIM = 0.25  # the IQM leaves out this share of the runs at each end
FEW_RUNS = 10  # below this a percentile interval is too narrow: docs/statistics.md has the coverage


class Estimate(NamedTuple):
    """A value and its interval."""

    value: float
    low: float
    high: float


# -- one number per run ----------------------------------------------------------------------


def converged_rate(curves: Array) -> Array:
    """The level at which each curve spends most of its points; (runs, points) → (runs,).

    The mode of the learning curve's histogram over [0, 1] (Melnik et al. 2021, "Using tactile
    sensing to improve the sample efficiency and performance of deep deterministic policy gradients
    for simulated in-hand manipulation tasks"): the mean of the points in the fullest bin. Of
    equally full bins the one that the curve visited last counts. Points without a value (NaN) are
    left out; a run without any is NaN.
    """
    if np.nanmin(curves, initial=0.0) < 0 or np.nanmax(curves, initial=0.0) > 1:
        raise ValueError("curves: found rates outside of [0, 1], allowed from 0 to 1")
    modes = np.full(len(curves), math.nan)
    for run, curve in enumerate(curves):
        if len(rates := curve[~np.isnan(curve)]):
            # Rounded, for 0.58 * 50 is 28.999999999999996.
            bins = np.minimum(np.floor(np.round(rates * N_BINS, 9)), N_BINS - 1).astype(
                int
            )
            counts = np.bincount(bins)[bins]  # at each point, of its bin
            last_of_fullest = np.flatnonzero(counts == counts.max())[-1]
            modes[run] = rates[bins == bins[last_of_fullest]].mean()
    return modes


def final_rate(curves: Array, tail: float = TAIL) -> Array:
    """Mean over the last tenth of each curve's points, at least one; (runs, points) → (runs,)."""
    n_last = max(1, math.ceil(tail * curves.shape[1]))
    return np.asarray(curves[:, -n_last:].mean(axis=1))


def area_under_curve(steps: Array, curves: Array) -> Array:
    """Mean height of each curve by the trapezoidal rule; (points,), (runs, points) → (runs,)."""
    if len(steps) == 1:
        return curves[:, 0].copy()
    return np.asarray(np.trapezoid(curves, steps, axis=1) / (steps[-1] - steps[0]))


def steps_to_threshold(steps: Array, curves: Array, threshold: float) -> Array:
    """Steps at each curve's first point at or above `threshold`; infinite where it never gets there.

    (points,), (runs, points) → (runs,). All runs of a study are equally long, so quantiles over runs
    are right as they are.
    """
    reached = curves >= threshold
    return np.where(reached.any(axis=1), steps[reached.argmax(axis=1)], np.inf)


# -- over the runs ---------------------------------------------------------------------------


def trimmed(metric: Metric, n_runs: int) -> int:
    """How many runs an aggregate leaves out at each end: all three are trimmed means.

    The IQM drops int(n / 4), as scipy.stats.trim_mean and rliable do: of ten runs two at each end.
    """
    return {"mean": 0, "iqm": int(TRIM * n_runs), "median": (n_runs - 1) // 2}[metric]


def aggregate(scores: Array, metric: Metric) -> Array:
    """Median, IQM or mean over the runs; (runs, ...) → (...)."""
    dropped = trimmed(metric, len(scores))
    return np.asarray(
        np.sort(scores, axis=0)[dropped : len(scores) - dropped].mean(axis=0)
    )


def resample(rng: np.random.Generator, n: int, n_resamples: int = N_RESAMPLES) -> Array:
    """How often each of `n` runs is drawn in each bootstrap resample; (n, n_resamples)."""
    drawn = np.empty((n_resamples, n), np.uint8)  # nobody is drawn 256 times
    for part in np.array_split(drawn, 1 + drawn.size // 2**20):  # for the memory's sake
        runs = rng.integers(n, size=part.shape)
        runs += n * np.arange(len(part))[:, None]
        part[:] = np.bincount(runs.ravel(), minlength=part.size).reshape(part.shape)
    return np.ascontiguousarray(drawn.T)


def bootstrap(scores: Array, metric: Metric, counts: Array) -> Array:
    """The aggregate in every resample; scores (runs,), counts (runs, n_resamples) → (n_resamples,).

    With the runs sorted and C[i] the number drawn up to run i, run i takes the places C[i-1] to
    C[i] of the sorted resample. With k places trimmed at each end, W[i] = clip(C[i], k, n - k) - k
    of those up to C[i] are kept, so the aggregate is Σ x[i] (W[i] - W[i-1]) / (n - 2k); it is
    summed by parts.
    """
    n, k = len(scores), trimmed(metric, len(scores))
    order = np.argsort(scores, kind="stable")
    drawn = np.ascontiguousarray(counts[order[:-1]], np.min_scalar_type(n))
    for run in range(1, n - 1):  # np.cumsum over the first axis takes ten times as long
        drawn[run] += drawn[run - 1]
    kept = np.clip(drawn, k, n - k, out=drawn) - drawn.dtype.type(k)
    ordered = scores[order]
    return np.asarray(ordered[-1] - (np.diff(ordered) / (n - 2 * k)) @ kept)


def percentile_interval(
    distribution: Array, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """The central part of a bootstrap distribution (n_resamples,): Efron's percentile interval.
    Resamples without a number are left out; NaN where there is no other."""
    distribution = distribution[np.isfinite(distribution)]
    if not len(distribution):
        return math.nan, math.nan
    tail = (1 - confidence) / 2
    low, high = np.quantile(distribution, [tail, 1 - tail])
    return float(low), float(high)


def estimate(
    scores: Array, metric: Metric, counts: Array, confidence: float = CONFIDENCE
) -> Estimate:
    """An aggregate of scores (runs,) with its percentile interval from `resample`'s counts."""
    value = float(aggregate(scores, metric))
    return Estimate(
        value, *percentile_interval(bootstrap(scores, metric, counts), confidence)
    )


def sample_efficiency(
    curves: Array, metric: Metric, counts: Array
) -> tuple[Array, Array]:
    """Aggregate over the runs at every point, with pointwise percentile intervals.

    (runs, points), counts (runs, n_resamples) → (points,), (points, 2). One point at a time, so
    that memory does not grow with their number; points at which the runs' scores are the same are
    computed once.
    """
    distinct, place = np.unique(curves, axis=1, return_inverse=True)
    intervals = np.array(
        [estimate(scores, metric, counts)[1:] for scores in distinct.T]
    )
    return aggregate(curves, metric), intervals[place.ravel()]


def wilson_interval(n_successes: int, n: int) -> tuple[float, float]:
    """Interval of a probability from `n_successes` of `n` (Wilson 1927, scipy)."""
    found = scipy.stats.binomtest(n_successes, n).proportion_ci(
        CONFIDENCE, method="wilson"
    )
    return float(found.low), float(found.high)


# -- means of few samples, and pairs ------------------------------------------------------------


def expanded(n: int, confidence: float = CONFIDENCE) -> float:
    """Confidence at which a percentile interval of the mean of `n` samples is as wide as one of that
    `confidence` should be.

    Hesterberg 2015, "What teachers should know about the bootstrap" (https://arxiv.org/abs/1411.5279):
    a bootstrap's spread is too small by a factor of sqrt(1 - 1/n), and takes the spread of the samples
    for the true one, as a normal instead of a t quantile would.
    """
    if n < 2:
        return confidence
    wide = math.sqrt(n / (n - 1)) * scipy.stats.t.isf((1 - confidence) / 2, n - 1)
    return 1 - 2 * float(scipy.stats.norm.sf(wide))


def mean(samples: Array, counts: Array, confidence: float = CONFIDENCE) -> Estimate:
    """Mean of samples (n,), such as differences of pairs, with its expanded percentile interval; NaN
    without samples, and no interval of a single one."""
    if len(samples) < 2:
        return Estimate(
            float(samples[0]) if len(samples) else math.nan, math.nan, math.nan
        )
    return estimate(samples, "mean", counts, expanded(len(samples), confidence))


def share(gain: Array, room: Array, counts: Array) -> Estimate:
    """Mean `gain` over mean `room`, both (pairs,), with its expanded percentile interval."""
    with np.errstate(divide="ignore", invalid="ignore"):  # where there is no room
        drawn = bootstrap(gain, "mean", counts) / bootstrap(room, "mean", counts)
        value = float(gain.mean() / room.mean())
    return Estimate(value, *percentile_interval(drawn, expanded(len(gain))))


def sign_flips(
    n: int, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> Array:
    """Ways to exchange the labels within `n` pairs, as signs of the differences; (ways, n), the first
    as they are.

    Every way once where there are no more than `n_resamples`, as with 16 pairs; opposite ways, whose
    means differ by the sign alone, count as one. Beyond, `n_resamples` random ones.
    """
    if 2 ** max(0, n - 1) <= n_resamples:
        bits = np.arange(2 ** max(0, n - 1))[:, None] >> np.arange(n)
        return (1 - 2 * (bits & 1)).astype(np.int8)
    signs = rng.integers(0, 2, (n_resamples + 1, n), np.int8) * 2 - 1
    signs[0] = 1
    return signs


def fewest_pairs(alpha: float) -> int:
    """Pairs with which a two-sided sign-flip test can fall to `alpha`: 6 for 0.05."""
    return math.ceil(1 - math.log2(alpha))


def sign_flip_p(
    differences: Array, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> float:
    """Two-sided p-value of a mean difference (pairs,) when the labels are exchanged within pairs
    (Fisher 1935).

    Exact where `sign_flips` is; with three it cannot fall below 0.25. NaN with fewer than two.
    """
    if (n := len(differences)) < 2:
        return math.nan
    return sequential_sign_flips(differences, [(n, 0.0)], n, rng, n_resamples)[
        0
    ].p_value


class Look(NamedTuple):
    """What a sequential test says at one look."""

    p_value: float
    """Probability under no difference to have stopped at an earlier look, or to see so much here."""
    level: float
    """Of this look alone: intervals at 1 - level hold at all looks together."""


def sequential_sign_flips(
    differences: Array,
    looks: Sequence[tuple[int, float]],
    n_planned: int,
    rng: np.random.Generator,
    n_resamples: int = N_RESAMPLES,
) -> list[Look]:
    """The sign-flip test on the first pairs, at every look that there is data for.

    `looks` are (pairs at hand, error that may be spent up to there); it stops for a difference at the
    first whose p-value is no more than that error. As in AdaStop (Mathieu et al., TMLR 2024,
    https://arxiv.org/abs/2306.10882) all ways to exchange labels go through all looks, so that ways
    that stopped earlier are known, and dependence between looks is exact. What is spent when is a
    spending function (Lan and DeMets 1983); p-values are ordered by stages (Fairbanks and Madsen
    1982); intervals at 1 - level are repeated ones (Jennison and Turnbull 1989).
    """
    is_exact = 2 ** (n_planned - 1) <= n_resamples
    signs = sign_flips(len(differences) if is_exact else n_planned, rng, n_resamples)
    has_stopped, found = np.zeros(len(signs), bool), []
    for n, error in looks:
        # Rounded: ties that differ in the last bit are ties.
        gaps = np.round(np.abs(signs[:, :n] @ differences[:n]) / max(1, n), 12)
        going = np.sort(gaps[~has_stopped])
        as_large = len(going) - np.searchsorted(going, gaps)
        p_values = (has_stopped.sum() + as_large) / len(signs)
        stops = ~has_stopped & (p_values <= error + 1e-12)
        left = error - float(has_stopped.mean())
        level = float(np.mean(gaps >= gaps[stops].min())) if stops.any() else left
        found.append(Look(float(p_values[0]), max(level, 1e-9)))
        has_stopped |= stops
        if has_stopped[0]:
            break
    return found


# -- several p-values -------------------------------------------------------------------------


def bootstrap_p(distribution: Array) -> float:
    """Two-sided p-value of a difference from 0, from its bootstrap distribution (n_resamples,).
    Resamples without a number are left out."""
    distribution = distribution[np.isfinite(distribution)]
    n = len(distribution)
    one_sided = min(int((distribution <= 0).sum()), int((distribution >= 0).sum()))
    return min(1.0, 2 * (one_sided + 1) / (n + 1))


def holm(p_values: Sequence[float]) -> Array:
    """p-values of several comparisons, corrected so that the family keeps its level (Holm 1979).
    NaN stays NaN and does not count as a comparison."""
    corrected = np.array(p_values, float)
    known = np.flatnonzero(~np.isnan(corrected))
    order = known[np.argsort(corrected[known], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(
        1.0, np.maximum.accumulate(factors * corrected[order])
    )
    return corrected
