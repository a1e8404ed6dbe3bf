"""How often do 95 % intervals of a few runs contain the truth? Simulated, for runs like ours.

python -m benchmarks coverage --out docs/data/coverage.json

And how long a learning curve's intervals take, against rliable (--only speed, 1 minute).
"""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.stats
from tactilerl import statistics
from tactilerl.statistics import Array

from benchmarks.command import Part, run_parts
from benchmarks.printing import markdown, progress

Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
N_RUNS = (3, 5, 10, 20)
N_STUDIES = 2000
N_RESAMPLES = 10_000
N_TRUTH = 2_000_000  # runs that stand for all there could be


def beta(mean: float, sd: float) -> Draw:
    """Success rates with this mean and standard deviation."""
    size = mean * (1 - mean) / sd**2 - 1
    return lambda rng, shape: rng.beta(mean * size, (1 - mean) * size, shape)


def mixture(share: float, first: Draw, second: Draw) -> Draw:
    """This share of the runs from the first, the others from the second."""
    return lambda rng, shape: np.where(rng.random(shape) < share, first(rng, shape), second(rng, shape))


POPULATIONS: dict[str, Draw] = {
    "narrow (the paper's PyBullet: 0.62 ± 0.065)": beta(0.62, 0.065),
    "wide and skewed (the paper's MuJoCo: 0.82 ± 0.145)": beta(0.82, 0.145),
    "bimodal (8 of 10 runs near 0.95, 2 near 0.03)": mixture(0.8, beta(0.95, 0.04), beta(0.03, 0.03)),
    "evenly bimodal (half near 0.95, half near 0.03)": mixture(0.5, beta(0.95, 0.04), beta(0.03, 0.03)),
}


def truth(draw: Draw, metric: statistics.Metric) -> float:
    """The aggregate over very many runs."""
    return float(statistics.aggregate(draw(np.random.default_rng(0), (N_TRUTH,)), metric))


def covered(intervals: np.ndarray, value: float) -> dict[str, float]:
    """Share of intervals (studies, 2) with `value` in them, and their mean width."""
    low, high = intervals.T
    inside = (low <= value) & (value <= high)
    return {"coverage": float(np.mean(inside)), "width": float(np.nanmean(high - low))}


def bca_interval(scores: Array, metric: statistics.Metric, counts: Array) -> tuple[float, float]:
    """The bias-corrected and accelerated interval (Efron 1987), by scipy; NaN if all runs are alike."""
    if len(scores) < 2 or np.ptp(scores) == 0:
        return math.nan, math.nan

    def statistic(sample: Array, axis: int = -1) -> Array:
        return statistics.aggregate(np.moveaxis(sample, axis, 0), metric)

    drawn = SimpleNamespace(bootstrap_distribution=statistics.bootstrap(scores, metric, counts))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a degenerate distribution gives NaN, which is what is wanted
        interval = scipy.stats.bootstrap(
            (scores,), statistic, n_resamples=0, bootstrap_result=drawn, method="BCa",
            confidence_level=statistics.CONFIDENCE,
        ).confidence_interval  # fmt: skip
    return float(interval.low), float(interval.high)


def difference(
    treatment: Array, control: Array, metric: statistics.Metric, drawn: tuple[Array, Array]
) -> statistics.Estimate:
    """Treatment minus control with its percentile interval; `drawn` are resamples of each."""
    gaps = statistics.bootstrap(treatment, metric, drawn[0]) - statistics.bootstrap(
        control, metric, drawn[1]
    )
    value = statistics.aggregate(treatment, metric) - statistics.aggregate(control, metric)
    return statistics.Estimate(float(value), *statistics.percentile_interval(gaps))


def measure(draw: Draw, n_runs: int, rng: np.random.Generator) -> dict[str, Any]:
    """Coverage of every interval for studies of `n_runs` runs from one population."""
    scores = draw(rng, (n_runs, N_STUDIES))
    counts = statistics.resample(rng, n_runs, N_RESAMPLES)
    result: dict[str, Any] = {}
    for metric in statistics.METRICS:
        _, intervals = statistics.sample_efficiency(scores, metric, counts)
        result[metric] = covered(intervals, truth(draw, metric))
    bca = np.array([bca_interval(study, "iqm", counts) for study in scores.T])
    result["iqm, BCa"] = covered(bca, truth(draw, "iqm"))
    control = draw(rng, (n_runs, N_STUDIES))
    drawn = counts, statistics.resample(rng, n_runs, N_RESAMPLES)
    gaps = [difference(a, b, "iqm", drawn)[1:] for a, b in zip(scores.T, control.T, strict=True)]
    result["difference of IQMs"] = covered(np.array(gaps), 0.0)
    return result


def coverage() -> dict[str, Any]:
    """All populations and numbers of runs."""
    rng = np.random.default_rng(2026)
    cases = list(itertools.product(POPULATIONS, N_RUNS))
    result: dict[str, Any] = {name: {} for name in POPULATIONS}
    for name, n in progress(cases, "simulating"):
        result[name][str(n)] = measure(POPULATIONS[name], n, rng)
    return {"studies": N_STUDIES, "resamples": N_RESAMPLES, "populations": result}


KINDS = {
    "median": "median of runs",
    "iqm": "IQM",
    "mean": "mean",
    "iqm, BCa": "IQM, BCa",
    "difference of IQMs": "difference of two IQMs",
}


def show(result: dict[str, Any]) -> None:
    """As Markdown."""
    rows = [
        (
            name * (kind == "median"),
            title,
            *(f"{100 * r[kind]['coverage']:.0f} %" for r in by_n.values()),
        )
        for name, by_n in result["populations"].items()
        for kind, title in KINDS.items()
    ]
    markdown(f"| runs like | interval | {' | '.join(f'n = {n}' for n in N_RUNS)} |", rows)


def speed(n_points: int = 500, n_runs: int = 10, n_few: int = 20) -> dict[str, float]:
    """Processor seconds of one curve with 50,000 resamples; rliable's from a few, scaled up."""
    from rliable import library, metrics

    curves = np.random.default_rng(0).random((n_runs, n_points))
    started = time.process_time()
    counts = statistics.resample(np.random.default_rng(1), n_runs)
    statistics.sample_efficiency(curves, "iqm", counts)
    ours, started = time.process_time() - started, time.process_time()
    library.get_interval_estimates(
        {"curve": curves[:, None]},
        lambda scores: np.array([metrics.aggregate_iqm(scores[..., i]) for i in range(n_points)]),
        reps=n_few,
    )
    theirs = (time.process_time() - started) * statistics.N_RESAMPLES / n_few
    return {"ours_s": ours, "rliable_s": theirs}


def show_speed(result: dict[str, float]) -> None:
    """One line."""
    print(f"500 points: {result['ours_s']:.1f} s, rliable about {result['rliable_s']:,.0f} s")


PARTS: dict[str, Part] = {"coverage": (coverage, show), "speed": (speed, show_speed)}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "numpy", "scipy", "rliable")
