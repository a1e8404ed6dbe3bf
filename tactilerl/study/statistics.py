"""What the runs of a study say, and how sure one can be: pure functions over arrays of runs.

The first axis is always the runs (independent seeds). Scores are shares of success in [0, 1] where
nothing else is said. The aggregates and the stratified bootstrap are those of Agarwal et al. 2021,
"Deep reinforcement learning at the edge of the statistical precipice"
(https://arxiv.org/abs/2108.13264).

All three aggregates (median, IQM, mean) are trimmed means. So a resample need not be sorted again:
sort the runs once and count how often each of them was drawn.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Literal, NamedTuple

import numpy as np
from scipy import stats

Array = np.ndarray
Metric = Literal["median", "iqm", "mean"]
METRICS: tuple[Metric, ...] = ("median", "iqm", "mean")

CONFIDENCE = 0.95
N_RESAMPLES = 50_000  # as the paper's learning curves have them
N_BINS = 50  # of the histogram behind the converged rate
TAIL = 0.1  # share of a run's points that count as its end
TRIM = 0.25  # the IQM leaves out this share of the runs at each end
FEW_RUNS = 10  # below this an interval is too narrow: docs/statistics.md has the measured coverage


class Estimate(NamedTuple):
    """A value and its interval."""

    value: float
    low: float
    high: float


# -- one number per run ----------------------------------------------------------------------


def converged_rate(curves: Array, n_bins: int = N_BINS) -> Array:
    """The level at which each curve spends most of its points; (runs, points) → (runs,).

    The mode of the learning curve's histogram over [0, 1] (Melnik et al. 2021, "Using tactile
    sensing to improve the sample efficiency and performance of deep deterministic policy gradients
    for simulated in-hand manipulation tasks"): the mean of the points in the fullest bin. Of
    equally full bins the one that the curve visited last counts. Points without a value (NaN) are
    left out; a run without any is NaN.
    """
    if np.nanmin(curves, initial=0.0) < 0 or np.nanmax(curves, initial=0.0) > 1:
        raise ValueError("curves: found rates outside of [0, 1], allowed from 0 to 1")
    return np.array([_mode(curve[~np.isnan(curve)], n_bins) for curve in curves])


def _mode(rates: Array, n_bins: int) -> float:
    if not len(rates):
        return math.nan
    # Rounded, for 0.58 * 50 is 28.999999999999996.
    bins = np.minimum(np.floor(np.round(rates * n_bins, 9)), n_bins - 1).astype(int)
    counts = np.bincount(bins, minlength=n_bins)
    fullest = np.flatnonzero(counts == counts.max())
    last_visit = [np.flatnonzero(bins == index)[-1] for index in fullest]
    return float(rates[bins == fullest[int(np.argmax(last_visit))]].mean())


def final_rate(curves: Array, tail: float = TAIL) -> Array:
    """Mean over the last tenth of each curve's points, at least one; (runs, points) → (runs,)."""
    n_last = max(1, math.ceil(tail * curves.shape[1]))
    return np.asarray(curves[:, -n_last:].mean(axis=1))


def area_under_curve(steps: Array, curves: Array) -> Array:
    """Mean height of each curve over its steps, by the trapezoidal rule; (points,), (runs, points)
    → (runs,).
    """
    if len(steps) == 1:
        return curves[:, 0].copy()
    return np.asarray(np.trapezoid(curves, steps, axis=1) / (steps[-1] - steps[0]))


def steps_to_threshold(steps: Array, curves: Array, threshold: float) -> Array:
    """Steps at each curve's first point at or above `threshold`; infinite where it never gets
    there.

    (points,), (runs, points) → (runs,). All runs of a study are equally long, so an infinite value
    is a run censored at the same place as the others, and quantiles over runs are right as they
    are.
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
    return np.asarray(np.sort(scores, axis=0)[dropped : len(scores) - dropped].mean(axis=0))


def resample(
    rng: np.random.Generator, strata: int | Sequence[int], n_resamples: int = N_RESAMPLES
) -> Array:
    """How often each run is drawn in each stratified bootstrap resample; (runs, n_resamples).

    `strata` are the numbers of runs of each stratum, one after another; a resample of a stratum has
    as many runs as the stratum.
    """
    sizes = [strata] if isinstance(strata, int) else list(strata)
    kind = np.min_scalar_type(sum(sizes))
    drawn = [rng.multinomial(n, np.full(n, 1 / n), n_resamples).astype(kind).T for n in sizes]
    return np.ascontiguousarray(np.concatenate(drawn))


def bootstrap(scores: Array, metric: Metric, counts: Array) -> Array:
    """The aggregate in every resample; scores (runs,), counts (runs, n_resamples) → (n_resamples,).

    With the runs sorted and C[i] the number drawn up to run i, run i takes the places C[i-1] to
    C[i] of the sorted resample. With k places trimmed at each end, W[i] = clip(C[i], k, n - k) - k
    of those up to C[i] are kept, so the aggregate is Σ x[i] (W[i] - W[i-1]) / (n - 2k); it is
    summed by parts.
    """
    n, k = len(scores), trimmed(metric, len(scores))
    order = np.argsort(scores, kind="stable")
    drawn = counts[order[:-1]]
    for run in range(1, n - 1):  # np.cumsum over the first axis takes ten times as long
        drawn[run] += drawn[run - 1]
    kept = np.clip(drawn, k, n - k, out=drawn) - drawn.dtype.type(k)
    ordered = scores[order]
    return np.asarray(ordered[-1] - (np.diff(ordered) / (n - 2 * k)) @ kept)


def percentile_interval(distribution: Array, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The central part of a bootstrap distribution (n_resamples,): Efron's percentile interval."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(distribution, [tail, 1 - tail])
    return float(low), float(high)


def estimate(scores: Array, metric: Metric, counts: Array, confidence: float = CONFIDENCE) -> Estimate:
    """An aggregate of scores (runs,) with its percentile interval from `resample`'s counts."""
    value = float(aggregate(scores, metric))
    return Estimate(value, *percentile_interval(bootstrap(scores, metric, counts), confidence))


def bca_interval(
    scores: Array, metric: Metric, counts: Array, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """The bias-corrected and accelerated interval (Efron 1987), by scipy; NaN where all runs are
    alike.
    """
    if len(scores) < 2 or np.ptp(scores) == 0:
        return math.nan, math.nan

    def statistic(sample: Array, axis: int = -1) -> Array:
        return aggregate(np.moveaxis(sample, axis, 0), metric)

    drawn = SimpleNamespace(bootstrap_distribution=bootstrap(scores, metric, counts))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a degenerate distribution gives NaN, which is what is wanted
        interval = stats.bootstrap(
            (scores,), statistic, n_resamples=0, bootstrap_result=drawn, method="BCa",
            confidence_level=confidence,
        ).confidence_interval  # fmt: skip
    return float(interval.low), float(interval.high)


def sample_efficiency(
    curves: Array, metric: Metric, counts: Array, confidence: float = CONFIDENCE
) -> tuple[Array, Array]:
    """Aggregate over the runs at every point, with pointwise percentile intervals.

    (runs, points), counts (runs, n_resamples) → (points,), (points, 2). One point at a time, so
    that memory does not grow with their number; points at which the runs' scores are the same are
    computed once.
    """
    distinct, place = np.unique(curves, axis=1, return_inverse=True)
    intervals = np.array(
        [percentile_interval(bootstrap(scores, metric, counts), confidence) for scores in distinct.T]
    )
    return aggregate(curves, metric), intervals[place.ravel()]


# -- treatment against control ---------------------------------------------------------------


def interval_overlap(treatment: tuple[float, float], control: tuple[float, float]) -> float:
    """Share of the control's interval that the treatment's covers, as the paper has it; NaN without
    width.
    """
    width = control[1] - control[0]
    shared = min(treatment[1], control[1]) - max(treatment[0], control[0])
    return max(0.0, shared) / width if width > 0 else math.nan


def difference(
    treatment: Array, control: Array, metric: Metric, drawn: tuple[Array, Array]
) -> Estimate:
    """Treatment minus control with its percentile interval; `drawn` are independent resamples of
    both.
    """
    distributions = [
        bootstrap(scores, metric, counts)
        for scores, counts in zip((treatment, control), drawn, strict=True)
    ]
    value = float(aggregate(treatment, metric) - aggregate(control, metric))
    return Estimate(value, *percentile_interval(distributions[0] - distributions[1]))


def probability_of_improvement(
    treatment: Array, control: Array, drawn: tuple[Array, Array]
) -> Estimate:
    """How likely a run of the treatment beats one of the control, ties counting one half (Agarwal
    et al. 2021).

    The Mann-Whitney statistic over the number of pairs, with a percentile interval.
    """
    wins = (np.sign(treatment[:, None] - control[None]) + 1) / 2
    shares = np.einsum(
        "ib,ij,jb->b", drawn[0].astype(float), wins, drawn[1].astype(float), optimize=True
    )
    return Estimate(float(wins.mean()), *percentile_interval(shares / wins.size))


def permutation_p(
    treatment: Array,
    control: Array,
    metric: Metric,
    rng: np.random.Generator,
    n_resamples: int = N_RESAMPLES,
    paired: bool = False,
) -> float:
    """Two-sided p-value of a difference of aggregates when the labels are exchanged (scipy); with
    `paired` only within pairs of runs.

    Exact where there are no more than `n_resamples` ways to deal out the labels; with three runs
    against three it cannot fall below 0.1, with three pairs below 0.25. NaN where a group is a
    single run.
    """
    if min(len(treatment), len(control)) < 2:
        return math.nan

    def statistic(a: Array, b: Array, axis: int) -> Array:
        a, b = np.moveaxis(a, axis, 0), np.moveaxis(b, axis, 0)
        # Rounded, for ties that differ in the last bit would count as less extreme.
        return np.round(aggregate(a, metric) - aggregate(b, metric), 12)

    test = stats.permutation_test(
        (treatment, control), statistic, vectorized=True, n_resamples=n_resamples, rng=rng,
        batch=10_000, permutation_type="samples" if paired else "independent",
    )  # fmt: skip
    return float(test.pvalue)


def holm(p_values: Sequence[float]) -> Array:
    """p-values of several comparisons, corrected so that the family keeps its level (Holm 1979,
    statsmodels). NaN stays NaN and does not count as a comparison.
    """
    from statsmodels.stats.multitest import multipletests

    corrected = np.array(p_values, float)
    known = ~np.isnan(corrected)
    if known.any():
        corrected[known] = multipletests(corrected[known], method="holm")[1]
    return corrected


# -- over set-ups ----------------------------------------------------------------------------


def rank_agreement(values: Array, resampled: Array | None = None) -> Estimate:
    """Do set-ups put the cells (layouts) into the same order? Mean Spearman correlation over pairs
    of set-ups.

    `values` (setups, cells) and, for the interval, `resampled` (setups, cells, n_resamples).
    Resampling adds noise to the ranks, so the interval leans towards 0. NaN where a set-up has all
    cells alike.
    """
    value = float(_mean_spearman(values[..., None])[0])
    if resampled is None:
        return Estimate(value, math.nan, math.nan)
    drawn = _mean_spearman(resampled)
    drawn = drawn[~np.isnan(drawn)]
    return Estimate(value, *(percentile_interval(drawn) if len(drawn) else (math.nan, math.nan)))


def _mean_spearman(values: Array) -> Array:
    """(setups, cells, n) → (n,)"""
    ranks = stats.rankdata(values, axis=1)
    centred = ranks - ranks.mean(axis=1, keepdims=True)
    norms = np.sqrt((centred**2).sum(axis=1))
    first, second = np.triu_indices(len(values), k=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        pairs = (centred[first] * centred[second]).sum(axis=1) / (norms[first] * norms[second])
    return np.asarray(pairs.mean(axis=0))


class Term(NamedTuple):
    """A fixed effect of the mixed model."""

    name: str
    effect: Estimate
    p_value: float


def mixed_model(
    scores: Array, is_treatment: Array, factors: Mapping[str, Sequence[str]], cells: Sequence[str]
) -> list[Term]:
    """Is the treatment's effect the same over hands, simulators and algorithms? (statsmodels'
    MixedLM)

    score ~ treatment x (each factor of two or more levels) + random intercept per cell (set-up x
    layout); every argument has one entry a run. Effects against the first level of each factor.
    ValueError where the model cannot be fitted.
    """
    import pandas as pd
    from statsmodels.formula.api import mixedlm

    varied = {name: levels for name, levels in factors.items() if len(set(levels)) > 1}
    table = pd.DataFrame({"score": scores, "treatment": np.asarray(is_treatment, int), **varied})
    table["cell"] = list(cells)
    # Interactions of the treatment with each factor, not of the factors with each other.
    terms = " + ".join(f"C({name})" for name in varied)
    formula = "score ~ treatment" + (f" * ({terms})" if varied else "")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a variance of cells at its bound 0 is no fault
        try:
            fit = mixedlm(formula, table, groups=table["cell"]).fit(reml=True)
        except np.linalg.LinAlgError as error:
            raise ValueError(f"the mixed model cannot be fitted: {error}") from error
    bounds = fit.conf_int(1 - CONFIDENCE)
    return [
        Term(name, Estimate(float(value), *map(float, bounds.loc[name])), float(fit.pvalues[name]))
        for name, value in fit.fe_params.items()
    ]


# -- how many seeds --------------------------------------------------------------------------


def power_of_t_test(effect: float, sd: float, n_runs: int, alpha: float) -> float:
    """Power of a two-sided t test between two groups of `n_runs` runs whose means differ by
    `effect`.
    """
    from statsmodels.stats.power import TTestIndPower

    if sd == 0:
        return 1.0 if effect else alpha
    return float(TTestIndPower().power(abs(effect) / sd, n_runs, alpha))


def runs_needed(
    effect: float, sd: float, power: float, alpha: float, most: int = 100_000
) -> int | None:
    """Runs per group for a t test to find `effect` with `power`; None where `most` do not suffice."""
    low, high = 1, 2
    while power_of_t_test(effect, sd, high, alpha) < power:
        low, high = high, 2 * high
        if high > most:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        if power_of_t_test(effect, sd, middle, alpha) < power:
            low = middle
        else:
            high = middle
    return high


def power_from_intervals(
    effect: float, treatment: tuple[float, float], control: tuple[float, float], alpha: float = 0.05
) -> float:
    """Power of a z test to find `effect` again, from the published intervals of both groups' means."""
    to_error = 2 * stats.norm.isf((1 - CONFIDENCE) / 2)
    errors = [(high - low) / to_error for low, high in (treatment, control)]
    shift, critical = abs(effect) / math.hypot(*errors), stats.norm.isf(alpha / 2)
    return float(stats.norm.sf(critical - shift) + stats.norm.sf(critical + shift))


def simulated_power(
    rng: np.random.Generator,
    treatment: Array,
    control: Array,
    effect: float,
    n_runs: int,
    alpha: float,
    metric: Metric = "iqm",
    n_studies: int = 400,
    n_permutations: int = 999,
) -> float:
    """How often the permutation test would find `effect` in studies of `n_runs` runs spread like a
    pilot's.

    Runs are drawn from the pilot's deviations from each group's mean, the treatment's shifted by
    `effect`. Deviations from the mean of n runs are too small by a factor of sqrt(1 - 1/n): they
    are stretched.
    """
    spreads = [
        (scores - scores.mean()) / math.sqrt(max(1 - 1 / len(scores), 0.5))
        for scores in (treatment, control)
    ]
    labels = np.array([rng.permutation(2 * n_runs) for _ in range(n_permutations + 1)])
    labels[0] = np.arange(2 * n_runs)
    found = 0
    for _ in range(n_studies):
        drawn = [rng.choice(spread, n_runs) for spread in spreads]
        pooled = np.concatenate([drawn[0] + effect, drawn[1]])[labels].T
        gaps = np.abs(aggregate(pooled[:n_runs], metric) - aggregate(pooled[n_runs:], metric))
        found += np.mean(gaps >= gaps[0] - 1e-12) <= alpha
    return found / n_studies
