"""How often do a study's tests find what is not there, and what is? Simulated pairs of runs.

    nice python -m benchmarks error_rates --out docs/data/error_rates.json    # ten minutes

Areas under the curve of treatment and control share what their seed gives them. Under no difference
both are drawn alike; under a difference of 0.1 the treatment's are so much larger.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.stats import permutation_test
from tactilerl import statistics
from tactilerl.study.grid import Looks
from tactilerl.study.verdicts import take

from benchmarks.command import Part, run_parts
from benchmarks.printing import markdown, progress
from benchmarks.studies.coverage import bca_interval

Rng = np.random.Generator
Draw = Callable[[Rng, int], np.ndarray]
"""(studies, pairs, 2) areas under no difference."""
N_STUDIES = 4000
N_PAIRS = (6, 8, 10)
EFFECT, ALPHA = 0.1, 0.05
PLANS = ([6, 8, 10], [6, 9, 12, 16])
N_RESAMPLES = 10_000


def areas(shared: float, own: float, fails: float = 0.0) -> Draw:
    """Logistic-normal areas with a part that a seed's runs share; some of the runs hardly learn."""

    def draw(rng: Rng, n: int) -> np.ndarray:
        shape = (N_STUDIES, n)
        z = shared * rng.standard_normal((*shape, 1)) + own * rng.standard_normal((*shape, 2))
        return np.where(rng.random((*shape, 2)) < fails, 0.1, 1.0) * expit(z)

    return draw


POPULATIONS = {
    "runs of a seed much alike (r = 0.87)": areas(0.7, 0.27),
    "runs of a seed alike (r = 0.68)": areas(0.6, 0.41),
    "runs of a seed differ (r = 0.37)": areas(0.4, 0.52),
    "one run in five fails (r = 0.16)": areas(0.5, 0.3, 0.2),
}


def p_values() -> dict[str, Any]:
    """Share of studies with p <= 0.05, by test, population and pairs; intervals' coverage."""
    rng = np.random.default_rng(2026)
    found: dict[str, Any] = {}
    for name, draw in progress(POPULATIONS.items(), "p-values"):
        found[name] = {str(n): _of_pairs(rng, draw(rng, n)) for n in N_PAIRS}
    return {"studies": N_STUDIES, "effect": EFFECT, "populations": found, "others": _others(rng)}


def _share(p: Iterable[float]) -> float:
    """Of the studies that find a difference."""
    return float(np.mean(np.fromiter(p, float) <= ALPHA))


def _permutation_p(a: np.ndarray, b: np.ndarray, rng: Rng) -> float:
    """Two-sided, of a difference of means that are not in pairs."""

    def gap(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        return np.round(x.mean(axis) - y.mean(axis), 12)  # ties that differ in the last bit are ties

    test = permutation_test((a, b), gap, vectorized=True, n_resamples=999, rng=rng)
    return float(test.pvalue)


def _of_pairs(rng: Rng, pairs: np.ndarray) -> dict[str, float]:
    gaps = pairs[..., 0] - pairs[..., 1]
    counts = statistics.resample(rng, gaps.shape[1], N_RESAMPLES)
    found = {"correlation": float(np.corrcoef(pairs.reshape(-1, 2).T)[0, 1]), "sd": float(gaps.std())}
    for what, effect in (("no difference", 0.0), ("difference", EFFECT)):
        found[f"sign flips, {what}"] = _share(statistics.sign_flip_p(row + effect, rng) for row in gaps)
    torn = pairs[:1000] + np.array([EFFECT, 0.0])
    found["not in pairs, difference"] = _share(_permutation_p(*x.T, rng) for x in torn)
    intervals = {
        "percentile": [statistics.estimate(row, "mean", counts)[1:] for row in gaps],
        "BCa": [bca_interval(row, "mean", counts) for row in gaps[:1000]],
        "expanded percentile": [statistics.mean(row, counts)[1:] for row in gaps],
    }
    for kind, bounds in intervals.items():
        low, high = np.array(bounds).T
        found[f"covered, {kind}"] = float(np.mean((low <= 0) & (high >= 0)))
    return found


def _others(rng: Rng) -> dict[str, float]:
    """The other p-values, under no difference: six cells with Holm's correction, and a probe's
    bootstrap."""
    draw, found = next(iter(POPULATIONS.values())), {}
    cells = [draw(rng, 10) for _ in range(6)]
    by_cell = [[statistics.sign_flip_p(x[:, 0] - x[:, 1], rng) for x in cell] for cell in cells]
    least = (statistics.holm(p).min() for p in np.array(by_cell).T)
    found["any of six cells, Holm, 10 pairs"] = _share(least)
    counts = statistics.resample(rng, 200, 2000)
    grasps = rng.standard_normal((N_STUDIES, 200))
    p = (statistics.bootstrap_p(statistics.bootstrap(x, "mean", counts)) for x in grasps)
    found["bootstrap of 200 grasps, as the probe's"] = _share(p)
    return found


def looks() -> dict[str, Any]:
    """What a study with looks finds, how many pairs it takes, and whether its intervals hold."""
    rng = np.random.default_rng(2027)
    found: dict[str, Any] = {}
    for name, plan in progress(list(itertools.product(POPULATIONS, PLANS)), "looks"):
        pairs = POPULATIONS[name](rng, plan[-1])
        gaps = (pairs[..., 0] - pairs[..., 1])[: N_STUDIES // 2]
        for effect in (0.0, EFFECT):
            key = f"{name}, looks at {plan}, difference {effect:g}"
            found[key] = _with_looks(rng, Looks(plan), gaps + effect, effect)
    return {"studies": N_STUDIES // 2, "cases": found}


def _with_looks(rng: Rng, plan: Looks, gaps: np.ndarray, effect: float) -> dict[str, float]:
    last = [take(plan, row, plan.pairs)[-1] for row in gaps]
    fixed = [statistics.sign_flip_p(row, rng) <= plan.alpha for row in gaps]
    inside = [one.difference.low <= effect <= one.difference.high for one in last]
    return {
        "found": float(np.mean([one.ending == "difference" for one in last])),
        "ruled out": float(np.mean([one.ending == "no difference" for one in last])),
        "pairs": float(np.mean([one.n for one in last])),
        "covered": float(np.mean(inside)),
        "found with all pairs, no looks": float(np.mean(fixed)),
    }


SHOWN = {
    "sign flips, no difference": "p ≤ 0.05 without a difference",
    "sign flips, difference": "found, 0.1, %",
    "not in pairs, difference": "found without pairs, %",
    "covered, percentile": "covered by percentile intervals, %",
    "covered, BCa": "by BCa, %",
    "covered, expanded percentile": "by expanded percentiles, %",
}


def show_p_values(result: dict[str, Any]) -> None:
    """A line per population, numbers for N_PAIRS, as Markdown; then the others."""
    rows = []
    for name, by_n in result["populations"].items():
        cells = [_areas(name, result)]
        for kind, title in SHOWN.items():
            values = (one[kind] for one in by_n.values())
            cells.append(" / ".join(f"{100 * x:.0f}" if "%" in title else f"{x:.3f}" for x in values))
        rows.append(cells)
    markdown(f"| areas | {' | '.join(SHOWN.values())} |", rows)
    for name, value in result["others"].items():
        print(f"{name}: {value:.3f}")


def _areas(name: str, measured: dict[str, Any] | None) -> str:
    """A population with the correlation that was measured of it, where `p_values` were."""
    r = (
        f", r = {measured['populations'][name][str(N_PAIRS[-1])]['correlation']:.2f}"
        if measured
        else ""
    )
    return name.partition(" (")[0] + r


def show_looks(result: dict[str, Any], measured: dict[str, Any] | None = None) -> None:
    """A line per population and plan, as Markdown."""
    cases, rows = result["cases"], []
    for name, plan in itertools.product(POPULATIONS, PLANS):
        null, one = (cases[f"{name}, looks at {plan}, difference {x:g}"] for x in (0.0, EFFECT))
        covered = min(null["covered"], one["covered"])
        shares = (null["ruled out"], one["found"], one["found with all pairs, no looks"], covered)
        ruled_out, found, at_once, inside = (f"{100 * share:.0f} %" for share in shares)
        taken, until_found = f"{null['pairs']:.1f}", f"{one['pairs']:.1f}"
        where = _areas(name, measured), str(plan).strip("[]"), f"{null['found']:.3f}"
        rows.append((*where, taken, ruled_out, found, until_found, at_once, inside))
    markdown(
        "| areas | looks at pairs | stopped for a difference where there is none | pairs taken "
        "| 0.1 ruled out | found, 0.1 | pairs taken | found without looks | covered |",
        rows,
    )


PARTS: dict[str, Part] = {"p_values": (p_values, show_p_values), "looks": (looks, show_looks)}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "numpy", "scipy")
