"""A study as the paper compares it: converged rates not in pairs, beside the paper's own results.

    python -m benchmarks as_the_paper docs/data/pilot.csv.gz

The paper's numbers stand beside those of its two set-ups, as far as its text gives them
(published.toml).
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from benchmarks.command import parser
from tactilerl import statistics
from tactilerl.statistics import CONFIDENCE, Array, Estimate, Metric
from tactilerl.study import records, tables
from tactilerl.study.analysis import SetupResult, analyse
from tactilerl.study.summary import subject
from tactilerl.study.tables import Table, number, shown


@dataclass(frozen=True)
class Published:
    """One of the paper's two tables."""

    table: int
    steps: int
    """Of a run."""
    estimates: dict[tuple[str, str], dict[Metric, Estimate]]
    """By (cell, run type)."""
    overlaps: dict[str, float]
    """By cell: share of the control's interval that the main runs' covers."""


def published(config: dict[str, Any]) -> Published | None:
    """What the paper has for the set-up of a run's config.json; None where it has nothing."""
    if not config:
        return None
    run, scene = config["run"], config.get("scene") or {}
    text = Path(__file__).with_name("published.toml").read_text(encoding="utf-8")
    for data in tomllib.loads(text).values():
        mine = run["algo"], run["env"], scene.get("simulator")
        if (data["algo"], data["env"], data["simulator"]) == mine:
            estimates: dict[tuple[str, str], dict[Metric, Estimate]] = {}
            for layout, run_type, *values in data["rows"]:
                named = zip(("median", "iqm", "mean"), values[:3], values[3:], strict=True)
                estimates[f"layout {layout}", run_type] = {m: Estimate(v, *i) for m, v, i in named}  # type: ignore[misc]
            overlaps = {f"layout {i}": share for i, share in enumerate(data["overlap"], 1)}
            return Published(data["table"], data["steps"], estimates, overlaps)
    return None


def power(treatment: Estimate, control: Estimate, alpha: float = 0.05) -> float:
    """Power of a z test to find the difference of two published means again, from their intervals."""
    to_error = 2 * scipy.stats.norm.isf((1 - CONFIDENCE) / 2)
    errors = [(one.high - one.low) / to_error for one in (treatment, control)]
    shift = abs(treatment.value - control.value) / math.hypot(*errors)
    critical = scipy.stats.norm.isf(alpha / 2)
    return float(scipy.stats.norm.cdf(shift - critical) + scipy.stats.norm.cdf(-critical - shift))


def interval_overlap(treatment: tuple[float, float], control: tuple[float, float]) -> float:
    """Share of the control's interval that the treatment's covers; NaN without width."""
    width = control[1] - control[0]
    shared = min(treatment[1], control[1]) - max(treatment[0], control[0])
    return max(0.0, shared) / width if width > 0 else math.nan


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
    return Estimate(float(wins.mean()), *statistics.percentile_interval(shares / wins.size))


def converged(one: SetupResult, paper: Published) -> Table:
    """The paper's Tables 1 and 2: converged success rates of every group, beside the paper's."""
    ours, rows = tables.converged(one), []
    for row, place in zip(ours.rows, one.groups, strict=True):
        theirs = paper.estimates.get(place)
        beside = [shown(theirs[metric]) if theirs else "–" for metric in ("mean", "iqm")]
        rows.append(row | dict(zip(("Paper: mean", "Paper: IQM"), beside, strict=True)))
    title = f"{ours.title} (Table {paper.table} of the paper)"
    steps = f"Runs have {one.steps[-1]:,.0f} steps here and {paper.steps:,} in the paper."
    return replace(ours, title=title, rows=rows, note=f"{ours.note} {steps}")


def comparisons(one: SetupResult, paper: Published | None) -> Table:
    """Treatment against control in every cell, by converged rates."""
    rows, (treatment, control) = [], map(one.setup.label, one.setup.arms[:2])
    for cell in one.comparisons:
        both = [one.groups[cell, arm] for arm in one.setup.arms[:2]]
        a, b = (group.scores["converged"] for group in both)
        drawn = both[0].counts, both[1].counts
        bounds = [group.estimate("iqm", "converged")[1:] for group in both]
        row = {"Config.": cell, "Runs": " / ".join(str(len(group)) for group in both)}
        row["Difference of IQMs"] = shown(statistics.difference(a, b, "iqm", drawn), 3)
        row["Overlap of CIs"] = _percent(interval_overlap(*bounds))
        row["P(improvement)"] = shown(probability_of_improvement(a, b, drawn))
        if paper:
            row |= _published_comparison(paper, cell, one.setup.arms[:2])
        rows.append(row)
    note = (
        "Of converged rates. Overlap: share of the control's interval, as in the paper. "
        f"P(improvement): a run of {treatment} beats one of {control}. Paper's power: how likely "
        "another study of its size finds its difference of means at 0.05."
    )
    title = f"{treatment} against {control} as the paper compares them: {subject(one)}"
    return Table(f"{one.setup.name}_paper", title, rows, note)


def _published_comparison(paper: Published, cell: str, arms: list[str]) -> tables.Row:
    values = ["–"] * 3
    if all((cell, arm) in paper.estimates for arm in arms):
        first, second = (paper.estimates[cell, arm] for arm in arms)
        gap, chance = first["iqm"].value - second["iqm"].value, power(first["mean"], second["mean"])
        values = [number(gap), _percent(paper.overlaps[cell]), number(chance)]
    return dict(zip(("Paper: difference", "Paper: overlap", "Paper: power"), values, strict=True))


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{100 * value:.0f} %"


def all_tables(setups: list[SetupResult]) -> list[Table]:
    """Of each set-up with comparisons; the converged rates too where the paper has them."""
    found = []
    for one in setups:
        if one.comparisons:
            paper = published(one.config)
            found += [converged(one, paper)] if paper else []
            found.append(comparisons(one, paper))
    return found


def main() -> None:
    """The tables in Markdown."""
    flags = parser(__doc__)
    flags.add_argument("study", type=Path, help="a study's folder or its collected file")
    for table in all_tables(analyse(*records.load(flags.parse_args().study)).setups):
        print(table.formats()["md"].decode())
