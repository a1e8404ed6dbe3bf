"""A study as the paper compares it: converged rates not in pairs, beside the paper's own results.

    python -m benchmarks as_the_paper docs/data/paper.tar.gz --figures out

The paper's numbers stand beside those of its two set-ups, as far as its text gives them
(published.toml).
"""

from __future__ import annotations

import argparse
import math
import tomllib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from matplotlib.axes import Axes
from tactilerl import statistics
from tactilerl.statistics import CONFIDENCE, METRICS, Array, Estimate, Metric
from tactilerl.study import figures, records, tables
from tactilerl.study.analysis import Group, SetupResult, analyse
from tactilerl.study.figures import Picture
from tactilerl.study.summary import subject
from tactilerl.study.tables import Table, number, shown
from tactilerl.style import FAINT, INK

from benchmarks.studies.coverage import difference

ALPHA = 0.05  # of the tests whose power is estimated
HEADINGS: dict[str, Metric] = {"Mean": "mean", "IQM": "iqm", "Median of runs": "median"}
LABELS = {"median": "median of runs", "iqm": "IQM", "mean": "mean"}


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


def power(treatment: Estimate, control: Estimate) -> float:
    """Power of a z test to find the difference of two published means again, from their intervals."""
    to_error = 2 * scipy.stats.norm.isf((1 - CONFIDENCE) / 2)
    errors = [(one.high - one.low) / to_error for one in (treatment, control)]
    shift = abs(treatment.value - control.value) / math.hypot(*errors)
    critical = scipy.stats.norm.isf(ALPHA / 2)
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


def _estimate(group: Group, metric: Metric) -> Estimate:
    return statistics.estimate(group.scores["converged"], metric, group.counts)


def converged(one: SetupResult, paper: Published | None) -> Table:
    """The paper's Tables 1 and 2: converged success rates of every group, beside the paper's."""
    rows = []
    for place, group in one.groups.items():
        cell, arm = place
        row = {"Config.": cell, "Type": one.setup.label(arm), "Runs": str(len(group))}
        for heading, metric in HEADINGS.items():
            row[heading] = shown(_estimate(group, metric))
        if paper:
            theirs = paper.estimates.get(place)
            row["Paper: mean"] = shown(theirs["mean"]) if theirs else "–"
            row["Paper: IQM"] = shown(theirs["iqm"]) if theirs else "–"
        rows.append(row)
    title = f"Converged success rates, the paper's measure: {subject(one)}"
    note = (
        "The level at which a run spends most of its epochs, with 95 % percentile bootstrap intervals, "
        "which are too narrow with fewer than ten runs. "
        "The paper's median is the mean: its library's median is over tasks, of which there is one."
    )
    if paper:
        title += f" (Table {paper.table} of the paper)"
        note += f" Runs have {one.steps[-1]:,.0f} steps here and {paper.steps:,} in the paper."
    return Table(f"{one.setup.name}_converged", title, rows, note)


def picture(one: SetupResult, paper: Published | None) -> Picture:
    """The paper's Figures 4 and 6: median, IQM and mean of converged rates, a panel per arm."""
    arms = [name for name in one.setup.arms if any(name == each for _, each in one.groups)]
    panels = [
        (figures.label_of(one.setup.label(name)), partial(_converged_of, one, paper, name))
        for name in arms
    ]
    title = "Converged success rates, the paper's measure, with 95 % intervals"
    size = 5.2, 1.3 + 0.62 * len(one.cells)
    return Picture(f"{one.setup.name}_converged", title, figures.setting(one), panels, size)


def _converged_of(one: SetupResult, paper: Published | None, name: str, axes: Axes) -> None:
    colour, cells = figures.arm_colours(one)[name], one.cells
    for row, cell in enumerate(cells):
        group = one.groups.get((cell, name))
        if group is None:
            continue
        is_first = not axes.get_legend_handles_labels()[1]
        place = np.full(len(group), row - 0.36)
        label = "a run" * is_first
        axes.plot(group.scores["converged"], place, ".", color=FAINT, ms=4, label=label)
        for at, metric in enumerate(reversed(METRICS)):
            estimate = _estimate(group, metric)
            label = LABELS[metric] * is_first
            figures.bar(axes, row - 0.15 + 0.15 * at, estimate, colour, "Dos"[at], label)
        theirs = paper and paper.estimates.get((cell, name))
        if theirs:
            figures.bar(axes, row + 0.33, theirs["iqm"], INK, "x", "IQM in the paper" * is_first)
    axes.set(ylim=(len(cells) - 0.4, -0.6), xlim=(-0.02, 1.02), xlabel="converged success rate")
    axes.set_yticks(range(len(cells)), map(figures.label_of, cells))
    axes.grid(axis="y", visible=False)


def comparisons(one: SetupResult, paper: Published | None) -> Table:
    """Treatment against control in every cell, by converged rates."""
    rows, (treatment, control) = [], map(one.setup.label, one.setup.arms[:2])
    for cell in one.comparisons:
        both = [one.groups[cell, arm] for arm in one.setup.arms[:2]]
        a, b = (group.scores["converged"] for group in both)
        drawn = both[0].counts, both[1].counts
        bounds = [_estimate(group, "iqm")[1:] for group in both]
        row = {"Config.": cell, "Runs": " / ".join(str(len(group)) for group in both)}
        row["Difference of IQMs"] = shown(difference(a, b, "iqm", drawn), 3)
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


def parts(setups: list[SetupResult]) -> list[Table | Picture]:
    """Tables and figures of every set-up that has runs."""
    found: list[Table | Picture] = []
    for one in setups:
        paper = published(one.config)
        if one.groups:
            found += [converged(one, paper), picture(one, paper)]
        if one.comparisons:
            found.append(comparisons(one, paper))
    return found


def main() -> None:
    """The tables in Markdown; the figures where asked for."""
    flags = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    flags.add_argument("study", type=Path, help="a study's folder or its collected file")
    flags.add_argument("--figures", type=Path, help="write the figures into this folder")
    options = flags.parse_args()
    for part in parts(analyse(*records.load(options.study)).setups):
        if isinstance(part, Table):
            print(part.formats()["md"].decode())
        elif options.figures:
            options.figures.mkdir(parents=True, exist_ok=True)
            for ending, content in part.formats().items():
                (options.figures / f"{part.name}.{ending}").write_bytes(content)
