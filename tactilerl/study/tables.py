"""The tables of a report, as data; and a table as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import config as configuration
from ..errors import InputError
from .analysis import SCORES, THRESHOLDS, Analysis, Group, SetupResult, pair
from .statistics import Estimate, bca_interval, power_from_intervals

NAMES = {"median": "Median", "iqm": "IQM", "mean": "Mean"}
STILL_RISING = 0.1  # final over converged rate
UNTOLD = ("seed", "out", "workers", "threads", "tensorboard", "device", "algo", "env")


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    name: str
    """Of its files and of its place in report.html."""
    title: str
    columns: list[str]
    rows: list[list[str]]
    note: str = ""

    def formats(self) -> dict[str, str]:
        """The table in each format, by the ending of its file."""
        from tabulate import tabulate

        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.columns, *self.rows])
        made = {
            style: tabulate(self.rows, self.columns, tablefmt=style, disable_numparse=True)
            for style in ("pipe", "latex_booktabs")
        }
        heading = "\n\n".join(part for part in (f"**{self.title}**", self.note) if part)
        return {
            "csv": text.getvalue(),
            "md": f"{heading}\n\n{made['pipe']}\n",
            "tex": made["latex_booktabs"] + "\n",
        }


def number(value: float, digits: int = 2) -> str:
    """A number as tables show it; a dash where there is none."""
    if math.isnan(value):
        return "–"
    return f"{value + 0.0:.{digits}f}" if math.isfinite(value) else "never"


def interval(low: float, high: float, digits: int = 2) -> str:
    """[low, high] as the paper's tables have it."""
    return "–" if math.isnan(low) else f"[{number(low, digits)}, {number(high, digits)}]"


def shown(estimate: Estimate, digits: int = 2) -> str:
    """A value and its interval in one cell."""
    return f"{number(estimate.value, digits)} {interval(*estimate[1:], digits)}"


def p_value(value: float) -> str:
    """To three digits."""
    return "–" if math.isnan(value) else "< 0.001" if value < 0.001 else f"{value:.3f}"


def all_tables(analysis: Analysis) -> list[Table]:
    """Every table of a report, in its order."""
    tables: list[Table] = []
    for one in analysis.setups:
        tables += [converged(one), other_measures(one)]
        if one.comparisons:
            tables.append(comparisons(one))
    if analysis.agreements:
        tables.append(agreement(analysis))
    if not isinstance(analysis.mixed, str):
        tables.append(mixed(analysis))
    return [*tables, cost(analysis), deviations(analysis), versions(analysis), runs(analysis)]


def converged(one: SetupResult) -> Table:
    """The paper's Tables 1 and 2: converged success rates of every group."""
    columns = ["Config.", "Type", "Runs", *NAMES.values()]
    columns += [f"{name} CI, 95 %" for name in NAMES.values()]
    columns += ["Median of runs", "Median of runs CI, 95 %", "IQM BCa CI, 95 %"]
    if one.published:
        columns += ["Paper: IQM", "Paper: IQM CI, 95 %"]
    rows = []
    for (cell, arm), group in one.groups.items():
        mean, iqm, median = (group.estimate(metric) for metric in ("mean", "iqm", "median"))
        bca = bca_interval(group.scores["converged"], "iqm", group.counts)
        row = [cell, arm, str(len(group)), *(number(e.value) for e in (mean, iqm, mean))]
        row += [interval(*e[1:]) for e in (mean, iqm, mean)]
        row += [number(median.value), interval(*median[1:]), interval(*bca)]
        if one.published:
            theirs = one.published.estimates.get((cell, arm), {}).get("iqm")
            row += [number(theirs.value), interval(*theirs[1:])] if theirs else ["–", "–"]
        rows.append(row)
    like = f" (the paper's Table {one.published.table})" if one.published else ""
    return Table(
        f"{one.setup.name}_converged",
        f"Converged success rates, {one.setup.name}{like}",
        columns,
        rows,
        "Median, IQM and mean as the paper has them: its library's median over one task is the mean. "
        "The median of the runs stands beside it. Intervals: percentiles of a stratified bootstrap.",
    )


def other_measures(one: SetupResult) -> Table:
    """What else a learning curve says: IQMs with intervals, and steps to two thresholds."""
    columns = ["Config.", "Type", "Runs", *SCORES.values()]
    columns += [f"steps to {threshold:g} (median; reached by)" for threshold in THRESHOLDS]
    rows = []
    for (cell, arm), group in one.groups.items():
        row = [cell, arm, str(len(group)), *(shown(group.estimate("iqm", score)) for score in SCORES)]
        for threshold in THRESHOLDS:
            steps = group.scores[f"steps to {threshold:g}"]
            reached = int(np.isfinite(steps).sum())
            median = float(np.median(steps))
            middle = f"{median:,.0f}" if math.isfinite(median) else "never"
            row.append(f"{middle}; {reached} of {len(group)}")
        rows.append(row)
    title = f"Other measures of learning, {one.setup.name}"
    note = "IQM with 95 % interval. Steps are those of the first epoch at or above the threshold."
    return Table(f"{one.setup.name}_measures", title, columns, rows, note)


def comparisons(one: SetupResult) -> Table:
    """Treatment against control in every cell."""
    treatment, control = one.setup.arms[:2]
    columns = ["Config.", "Runs", "Difference of IQMs", "Overlap of CIs", "P(improvement)"]
    columns += ["p", "p, Holm", "Within seeds", "p within seeds"]
    if one.published:
        columns += ["Paper: difference", "Paper: overlap", "Paper: power"]
    rows = []
    for cell, found in one.comparisons.items():
        sizes = " / ".join(str(len(group)) for group in pair(one, cell))
        row = [cell, sizes, shown(found.difference, 3), share(found.overlap)]
        row += [shown(found.improvement), p_value(found.p_value), p_value(found.p_holm)]
        row += [shown(found.within, 3), p_value(found.p_within)]
        if one.published:
            row += _published_comparison(one, cell, (treatment, control))
        rows.append(row)
    note = (
        "Of converged rates. Overlap: share of the control's interval, as in the paper. "
        f"P(improvement): a run of {treatment} beats one of {control}. p: permutation test of the "
        "difference of IQMs; Holm over the rows. Within seeds: mean difference between runs of the "
        "same seed; its p: labels exchanged within the pairs. Paper's power: how likely another study "
        "of its size finds its difference of means at 0.05."
    )
    title = f"{treatment} against {control}, {one.setup.name}"
    return Table(f"{one.setup.name}_comparisons", title, columns, rows, note)


def _published_comparison(one: SetupResult, cell: str, arms: tuple[str, str]) -> list[str]:
    assert one.published is not None
    groups = [one.published.estimates.get((cell, arm)) for arm in arms]
    if groups[0] is None or groups[1] is None:
        return ["–"] * 3
    iqms, means = ([group[metric] for group in groups if group] for metric in ("iqm", "mean"))
    power = power_from_intervals(means[0].value - means[1].value, means[0][1:], means[1][1:])
    difference = number(iqms[0].value - iqms[1].value)
    return [difference, share(one.published.overlaps[cell]), number(power)]


def share(value: float) -> str:
    """As a percentage."""
    return "–" if math.isnan(value) else f"{100 * value:.0f} %"


def agreement(analysis: Analysis) -> Table:
    """Rank correlations between set-ups."""
    rows = [[one.by, ", ".join(one.setups), shown(one.correlation)] for one in analysis.agreements]
    note = "Mean Spearman correlation of the cells' IQMs over pairs of set-ups; 1: the same order."
    columns = ["Order by", "Set-ups", "Rank correlation"]
    return Table("agreement", "Do the set-ups agree on the order?", columns, rows, note)


def mixed(analysis: Analysis) -> Table:
    """The mixed model's terms."""
    assert not isinstance(analysis.mixed, str)
    rows = [[one.name, shown(one.effect, 3), p_value(one.p_value)] for one in analysis.mixed]
    note = (
        "Converged rate ~ treatment x (hand, simulator, algorithm), with a random intercept for every "
        "cell of every set-up; effects against the first level of each."
    )
    return Table("mixed_model", "Mixed model over set-ups", ["Term", "Effect", "p"], rows, note)


def cost(analysis: Analysis) -> Table:
    """Core-hours and speed."""
    rows = []
    for one in analysis.setups:
        begun = [r for r in one.records if r.rows]
        seconds = [r.seconds for r in begun]
        ranks = [int((r.config or {}).get("ranks", 1)) for r in begun]
        steps = sum(float(np.nan_to_num(r.column("env_steps"))[-1]) for r in begun)
        hours = sum(s * n for s, n in zip(seconds, ranks, strict=True)) / 3600
        minutes = float(np.median(seconds)) / 60 if seconds else math.nan
        speed = steps / sum(seconds) if sum(seconds) else math.nan
        figures = [number(hours, 3), number(minutes, 1), number(speed, 0)]
        rows.append([one.setup.name, str(len(begun)), *figures])
    columns = ["Set-up", "Runs begun", "Core-hours", "Median minutes per run", "Steps per second"]
    note = "Time in epochs, without starting and saving; core-hours: times the processes of a run."
    return Table("cost", "Cost", columns, rows, note)


def deviations(analysis: Analysis) -> Table:
    """Where a set-up's flags differ from the defaults, which are the paper's."""
    rows = []
    for one in analysis.setups:
        config = next((record.config for record in one.records if record.config), None)
        if config is None:
            continue
        varied = {*one.setup.cell_flags, *([one.setup.compare.flag] if one.setup.compare else [])}
        for flag, mine, default in _differences(config):
            if flag not in varied and flag not in UNTOLD:
                rows.append([one.setup.name, flag, default, mine])
    note = (
        "Flags that are not the defaults of tactilerl train; the defaults are the paper's values, and "
        "where its text leaves something open, what the project's documentation of deviations says."
    )
    columns = ["Set-up", "Flag", "Default", "Here"]
    return Table("deviations", "Deviations from the defaults", columns, rows, note)


def _differences(config: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    try:
        defaults = configuration.defaults(config["run"]["algo"], config["run"]["env"]).as_dict()
    except InputError:
        return  # of another version, with other algorithms
    for part in ("run", "scene", "learner"):
        for flag, mine in (config.get(part) or {}).items():
            default = (defaults[part] or {}).get(flag)
            default = list(default) if isinstance(default, tuple) else default
            if mine != default:
                yield flag, str(mine), str(default)


def versions(analysis: Analysis) -> Table:
    """Software that the runs were made with, and by how many runs."""
    found: Counter[tuple[str, str]] = Counter()
    for record in analysis.records:
        found.update(_made_with(record.config or {}))
    rows = [[name, version, str(n)] for (name, version), n in sorted(found.items())]
    return Table("versions", "Versions", ["Package", "Version", "Runs"], rows)


def _made_with(config: dict[str, Any]) -> set[tuple[str, str]]:
    """(package, version) of all that a run was made with; several of one where it went on with
    others."""
    made = config.get("provenance", [])
    commits = {("commit", str(one["commit"])) for one in made}
    return commits.union(*(one["versions"].items() for one in made))


def runs(analysis: Analysis) -> Table:
    """Every run: its seed, how it ended and what it reached."""
    measure = {one.setup.name: one.setup.measure for one in analysis.setups}
    reached = {
        (one.setup.name, group.cell, group.arm, seed): (score, final)
        for one in analysis.setups
        for group in one.groups.values()
        for seed, score, final in zip(
            group.seeds, group.scores["converged"], group.scores["final"], strict=True
        )
    }
    rows = []
    for record in analysis.records:
        run = record.run
        scores = reached.get((run.setup, run.cell, run.arm, run.seed), (math.nan, math.nan))
        steps = record.column("env_steps")
        diverged = sum(np.nansum(record.column(name)) for name in ("diverged", "test_diverged"))
        row = [run.setup, run.cell, run.arm, str(run.seed), record.state, str(len(record.rows))]
        row += [f"{steps[-1]:.0f}" if len(steps) else "0", *map(number, scores)]
        rows.append([*row, f"{diverged:.0f}", record.reason])
    columns = ["Set-up", "Config.", "Type", "Seed", "State", "Epochs", "Steps", "Converged", "Final"]
    columns += ["Diverged episodes", "Why it failed"]
    note = "Rates: " + "; ".join(f"{name}: {column}" for name, column in measure.items()) + "."
    return Table("runs", "Runs", columns, rows, note)


def _still_rises(group: Group) -> bool:
    """Does the converged rate miss what the runs can do at their end?"""
    return group.estimate("iqm", "final").value - group.estimate("iqm").value > STILL_RISING


def warnings(analysis: Analysis, few: int) -> list[str]:
    """What a reader must know before he believes the numbers."""
    found = []
    states = Counter(record.state for record in analysis.records)
    unfinished = [f"{n} {state}" for state, n in sorted(states.items()) if state != "done"]
    if unfinished:
        found.append(f"Of {len(analysis.records)} runs {', '.join(unfinished)}: they are in no figure.")
    if 0 < analysis.fewest < few:
        found.append(
            f"The smallest group has {analysis.fewest} runs. Intervals of fewer than {few} runs are "
            "too narrow: they contain the truth less often than they say."
        )
    rising = sum(_still_rises(group) for one in analysis.setups for group in one.groups.values())
    if rising:
        found.append(
            f"In {rising} groups the runs end well above the level at which they spent most epochs: "
            "they were too short for converged rates to mean much; look at final rates."
        )
    for one in analysis.setups:
        if not one.groups:
            found.append(f"{one.setup.name}: no finished run with a {one.setup.measure}.")
    if len({frozenset(_made_with(one.config)) for one in analysis.records if one.config}) > 1:
        found.append("The runs were made with different versions or commits: see Versions.")
    diverged = [
        r.run.name
        for r in analysis.records
        if sum(np.nansum(r.column(c)) for c in ("diverged", "test_diverged")) > 0
    ]
    if diverged:
        found.append(f"Episodes diverged in {len(diverged)} runs: see Runs.")
    if isinstance(analysis.mixed, str) and len([o for o in analysis.setups if o.comparisons]) > 1:
        found.append(analysis.mixed[0].upper() + analysis.mixed[1:] + ".")
    return found
