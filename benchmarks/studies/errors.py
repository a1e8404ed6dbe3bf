"""How often do a study's tests find what is not there, and what is? Simulated pairs of runs.

    nice python -m benchmarks errors --out docs/data/errors.json    # ten minutes

Areas under the curve of treatment and control share what their seed gives them. Under no difference
both are drawn alike; under a difference of 0.1 the treatment's are so much larger.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.special import expit

from benchmarks.command import run_parts
from benchmarks.studies.coverage import bca_interval
from tactilerl import statistics
from tactilerl.study.grid import Looks
from tactilerl.study.verdicts import take

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
    "like PPO in the pilot (r = 0.87)": areas(0.7, 0.27),
    "like DDPG+HER in the pilot (r = 0.68)": areas(0.6, 0.41),
    "runs of a seed differ (r = 0.37)": areas(0.4, 0.52),
    "one run in five fails (r = 0.16)": areas(0.5, 0.3, 0.2),
}


def p_values() -> dict[str, Any]:
    """Share of studies with p <= 0.05, by test, population and pairs; intervals' coverage."""
    rng = np.random.default_rng(2026)
    found: dict[str, Any] = {}
    for name, draw in track(POPULATIONS.items(), "p-values", console=Console(stderr=True)):
        found[name] = {str(n): _of_pairs(rng, draw(rng, n)) for n in N_PAIRS}
    return {"studies": N_STUDIES, "effect": EFFECT, "populations": found, "others": _others(rng)}


def _of_pairs(rng: Rng, pairs: np.ndarray) -> dict[str, float]:
    gaps = pairs[..., 0] - pairs[..., 1]
    n = gaps.shape[1]
    counts = statistics.resample(rng, n, N_RESAMPLES)
    found = {"correlation": float(np.corrcoef(pairs.reshape(-1, 2).T)[0, 1]), "sd": float(gaps.std())}
    for what, effect in (("no difference", 0.0), ("difference", EFFECT)):
        p = np.array([statistics.sign_flip_p(row + effect, rng) for row in gaps])
        found[f"sign flips, {what}"] = float(np.mean(p <= ALPHA))
    torn = pairs + np.array([EFFECT, 0.0])
    p = np.array([statistics.permutation_p(*x.T, rng, 999) for x in torn[:1000]])
    found["not in pairs, difference"] = float(np.mean(p <= ALPHA))
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
    """The other p-values, under no difference: runs without common seeds, six cells with Holm's
    correction, and a probe's bootstrap."""
    draw = next(iter(POPULATIONS.values()))
    found = {}
    for n in N_PAIRS:
        alone = draw(rng, n)[..., 0], draw(rng, n)[..., 0]
        p = [statistics.permutation_p(a, b, rng, 999) for a, b in zip(*alone, strict=True)]
        found[f"permutations, {n} runs each"] = float(np.mean(np.array(p) <= ALPHA))
    cells = [draw(rng, 10) for _ in range(6)]
    cell_p = np.array(
        [[statistics.sign_flip_p(x[:, 0] - x[:, 1], rng) for x in cell] for cell in cells]
    )
    least = np.array([statistics.holm(p).min() for p in cell_p.T])
    found["any of six cells, Holm, 10 pairs"] = float(np.mean(least <= ALPHA))
    counts = statistics.resample(rng, 200, 2000)
    grasps = rng.standard_normal((N_STUDIES, 200))
    p = [statistics.bootstrap_p(statistics.bootstrap(x, "mean", counts)) for x in grasps]
    found["bootstrap of 200 grasps, as the probe's"] = float(np.mean(np.array(p) <= ALPHA))
    return found


def looks() -> dict[str, Any]:
    """What a study with looks finds, how many pairs it takes, and whether its intervals hold."""
    rng = np.random.default_rng(2027)
    found: dict[str, Any] = {}
    cases = [(name, plan) for name in POPULATIONS for plan in PLANS]
    for name, plan in track(cases, "looks", console=Console(stderr=True)):
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


def show_p_values(result: dict[str, Any]) -> None:
    """A table of shares."""
    table = Table("", *(f"n = {n}" for n in N_PAIRS))
    for name, by_n in result["populations"].items():
        table.add_row(name, *[""] * len(by_n), style="bold")
        for kind in next(iter(by_n.values())):
            table.add_row(kind, *(f"{one[kind]:.3f}" for one in by_n.values()))
    Console().print(table)
    for name, value in result["others"].items():
        Console().print(f"{name}: {value:.3f}")


def show_looks(result: dict[str, Any]) -> None:
    """A line per case."""
    first = next(iter(result["cases"].values()))
    table = Table("", *first)
    for name, one in result["cases"].items():
        table.add_row(name, *(f"{value:.3f}" for value in one.values()))
    Console(width=150).print(table)


def p_values_markdown(content: dict[str, Any]) -> None:
    """A line per population, numbers for N_PAIRS."""
    columns = {
        "sign flips, no difference": "p ≤ 0.05 without a difference",
        "sign flips, difference": "found, 0.1, %",
        "not in pairs, difference": "found without pairs, %",
        "covered, percentile": "covered by percentile intervals, %",
        "covered, BCa": "by BCa, %",
        "covered, expanded percentile": "by expanded percentiles, %",
    }
    print("| areas |", *(f"{title} |" for title in columns.values()))
    print("|---" * (len(columns) + 1) + "|")
    for name, by_n in content["p_values"]["populations"].items():
        cells = []
        for kind, title in columns.items():
            values = (one[kind] for one in by_n.values())
            cells.append(" / ".join(f"{100 * x:.0f}" if "%" in title else f"{x:.3f}" for x in values))
        print(f"| {_population(name, content)} | {' | '.join(cells)} |")


def _population(name: str, content: dict[str, Any]) -> str:
    """With the correlation that was measured."""
    r = content["p_values"]["populations"][name][str(N_PAIRS[-1])]["correlation"]
    return f"{name.partition(' (')[0]}, r = {r:.2f}"


def looks_markdown(content: dict[str, Any]) -> None:
    """A line per population and plan."""
    print(
        "| areas | looks at pairs | stopped for a difference where there is none | pairs taken "
        "| 0.1 ruled out | found, 0.1 | pairs taken | found without looks | covered |"
    )
    print("|---" * 9 + "|")
    cases = content["looks"]["cases"]
    for key, null in cases.items():
        where, _, effect = key.rpartition(", difference ")
        if effect != "0":
            continue
        one, (name, _, plan) = cases[f"{where}, difference {EFFECT:g}"], where.rpartition(", looks at ")
        shares = one["found with all pairs, no looks"], min(null["covered"], one["covered"])
        print(
            f"| {_population(name, content)} | {plan.strip('[]')} "
            f"| {null['found']:.3f} | {null['pairs']:.1f} | {null['ruled out']:.0%} "
            f"| {one['found']:.0%} | {one['pairs']:.1f} "
            f"| {' | '.join(f'{share:.0%}' for share in shares)} |".replace("%", " %")
        )


PARTS = {"p_values": (p_values, show_p_values), "looks": (looks, show_looks)}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "numpy", "scipy")
