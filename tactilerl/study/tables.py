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

from .. import statistics
from ..errors import InputError
from ..runs import config as configuration
from ..statistics import Estimate, power_from_intervals
from .analysis import THRESHOLDS, Analysis, SetupResult, pair
from .primary import SCORES
from .summary import ENDINGS, made_with, subject

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
        if one.comparisons:
            tables.append(comparisons(one, analysis.study.primary.score))
        tables += [measures(one, analysis.study.primary.score), converged(one)]
        if one.comparisons:
            tables.append(as_the_paper(one))
    if analysis.agreements:
        tables.append(agreement(analysis))
    if not isinstance(analysis.mixed, str):
        tables.append(mixed(analysis))
    return [*tables, cost(analysis), deviations(analysis), versions(analysis), runs(analysis)]


def comparisons(one: SetupResult, score: str) -> Table:
    """Treatment against control in every cell, in pairs of runs of the same seed."""
    treatment, control = (one.setup.label(arm) for arm in one.setup.arms[:2])
    others = [name for name in SCORES if name != score]
    columns = ["Config.", "Pairs", SCORES[score].capitalize(), "p", "p, Holm"]
    has_looks = any(found.verdict.stage for found in one.comparisons.values())
    has_room = any(found.headroom for found in one.comparisons.values())
    columns += ["Look"] * has_looks
    for name in others:
        columns += [SCORES[name].capitalize(), f"p, {name}"]
    columns += ["Sight gives", "Touch, share of it"] * has_room
    rows = []
    for cell, found in one.comparisons.items():
        verdict = found.verdict
        row = [cell, f"{len(verdict.pairs)} of {verdict.n_seeds}", shown(verdict.pairs.difference, 3)]
        row += [p_value(verdict.pairs.p_value), p_value(verdict.p_holm)]
        if verdict.stage:
            row.append(f"{verdict.stage.look} of {verdict.stage.of}: {ENDINGS[verdict.stage.ending]}")
        for name in others:
            row += [shown(found.secondary[name].difference, 3), p_value(found.secondary[name].p_value)]
        if has_room:
            room = found.headroom
            row += [shown(room.room) if room else "–"]
            row += [shown(room.share) if room and room.is_enough else "cannot tell" if room else "–"]
        rows.append(row)
    note = (
        f"Mean of {treatment} minus {control} in runs of the same seed, with a 95 % bootstrap interval "
        "over pairs. p: sign-flip test; Holm over the rows. The first score is the one that the study "
        "is judged by; the others are for comparison and not corrected."
    )
    if has_looks:
        note += (
            " p and interval are those of the look that ended the comparison, corrected for all "
            "looks; the other scores are of all runs."
        )
    title = f"{treatment} − {control} in pairs: {subject(one)}"
    return Table(f"{one.setup.name}_comparisons", title, columns, rows, note)


def measures(one: SetupResult, score: str) -> Table:
    """What else a learning curve says: means with intervals, and steps to two thresholds."""
    names = [name for name in dict.fromkeys([score, *SCORES]) if name != "converged" or score == name]
    columns = ["Config.", "Type", "Runs", *(SCORES[name].capitalize() for name in names)]
    columns += [f"Steps to {threshold:g} (median; reached by)" for threshold in THRESHOLDS]
    rows = []
    for (cell, arm), group in one.groups.items():
        means = [statistics.mean(group.scores[name], group.counts) for name in names]
        row = [cell, one.setup.label(arm), str(len(group)), *map(shown, means)]
        for threshold in THRESHOLDS:
            steps = group.scores[f"steps to {threshold:g}"]
            reached = int(np.isfinite(steps).sum())
            median = float(np.median(steps))
            middle = f"{median:,.0f}" if math.isfinite(median) else "never"
            row.append(f"{middle}; {reached} of {len(group)}")
        rows.append(row)
    title = f"Each arm: {subject(one)}"
    note = (
        "Mean of the runs with 95 % interval. Area: mean success over the run; final: over its last "
        "tenth. Steps are those of the first epoch at or above the threshold."
    )
    return Table(f"{one.setup.name}_measures", title, columns, rows, note)


def converged(one: SetupResult) -> Table:
    """The paper's Tables 1 and 2: converged success rates of every group."""
    columns = ["Config.", "Type", "Runs", "Mean", "IQM", "Median of runs"]
    if one.published:
        columns += ["Paper: mean", "Paper: IQM"]
    rows = []
    for (cell, arm), group in one.groups.items():
        row = [cell, one.setup.label(arm), str(len(group))]
        row += [shown(group.estimate(metric, "converged")) for metric in ("mean", "iqm", "median")]
        if one.published:
            theirs = one.published.estimates.get((cell, arm), {})
            row += [shown(theirs[metric]) if theirs else "–" for metric in ("mean", "iqm")]
        rows.append(row)
    title = f"Converged success rates, the paper's measure: {subject(one)}"
    note = (
        "The level at which a run spends most of its epochs, with 95 % percentile bootstrap intervals. "
        "The paper's median is the mean: its library's median is over tasks, of which there is one."
    )
    if one.published:
        title += f" (Table {one.published.table} of the paper)"
        note += (
            f" Runs have {one.steps[-1]:,.0f} steps here and {one.published.steps:,} in the paper."
            if len(one.steps)
            else ""
        )
    return Table(f"{one.setup.name}_converged", title, columns, rows, note)


def as_the_paper(one: SetupResult) -> Table:
    """Treatment against control as the paper compares them: converged rates, not in pairs."""
    treatment, control = one.setup.arms[:2]
    columns = ["Config.", "Runs", "Difference of IQMs", "Overlap of CIs", "P(improvement)"]
    if one.published:
        columns += ["Paper: difference", "Paper: overlap", "Paper: power"]
    rows = []
    for cell, found in one.comparisons.items():
        sizes = " / ".join(str(len(group)) for group in pair(one, cell))
        row = [cell, sizes, shown(found.iqm_difference, 3), percent(found.overlap)]
        row += [shown(found.improvement)]
        if one.published:
            row += _published_comparison(one, cell, (treatment, control))
        rows.append(row)
    treatment, control = (one.setup.label(arm) for arm in (treatment, control))
    note = (
        "Of converged rates. Overlap: share of the control's interval, as in the paper. "
        f"P(improvement): a run of {treatment} beats one of {control}. Paper's power: how likely "
        "another study of its size finds its difference of means at 0.05."
    )
    title = f"{treatment} against {control} as the paper compares them: {subject(one)}"
    return Table(f"{one.setup.name}_paper", title, columns, rows, note)


def _published_comparison(one: SetupResult, cell: str, arms: tuple[str, str]) -> list[str]:
    assert one.published is not None
    groups = [one.published.estimates.get((cell, arm)) for arm in arms]
    if groups[0] is None or groups[1] is None:
        return ["–"] * 3
    iqms, means = ([group[metric] for group in groups if group] for metric in ("iqm", "mean"))
    power = power_from_intervals(means[0].value - means[1].value, means[0][1:], means[1][1:])
    difference = number(iqms[0].value - iqms[1].value)
    return [difference, percent(one.published.overlaps[cell]), number(power)]


def percent(value: float) -> str:
    """As a percentage."""
    return "–" if math.isnan(value) else f"{100 * value:.0f} %"


def agreement(analysis: Analysis) -> Table:
    """Rank correlations between set-ups."""
    rows = [[one.by, ", ".join(one.setups), shown(one.correlation)] for one in analysis.agreements]
    note = "Mean Spearman correlation of the cells' means over pairs of set-ups; 1: the same order."
    columns = ["Order by", "Set-ups", "Rank correlation"]
    return Table("agreement", "Do the set-ups agree on the order?", columns, rows, note)


def mixed(analysis: Analysis) -> Table:
    """The mixed model's terms."""
    assert not isinstance(analysis.mixed, str)
    score = SCORES[analysis.study.primary.score].capitalize()
    rows = [[one.name, shown(one.effect, 3), p_value(one.p_value)] for one in analysis.mixed]
    note = (
        f"{score} ~ treatment x (hand, simulator, algorithm), with a random intercept for every "
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
        found.update(made_with(record.config or {}))
    rows = [[name, version, str(n)] for (name, version), n in sorted(found.items())]
    return Table("versions", "Versions", ["Package", "Version", "Runs"], rows)


def runs(analysis: Analysis) -> Table:
    """Every run: its seed, how it ended and what it reached."""
    setups = {one.setup.name: one for one in analysis.setups}
    reached = {
        (one.setup.name, *place, seed): [group.scores[name][index] for name in SCORES]
        for one in analysis.setups
        for place, group in one.groups.items()
        for index, seed in enumerate(group.seeds)
    }
    rows = []
    for record in analysis.records:
        run = record.run
        scores = reached.get((run.setup, run.cell, run.arm, run.seed), [math.nan] * len(SCORES))
        steps = record.column("env_steps")
        diverged = sum(np.nansum(record.column(name)) for name in ("diverged", "test_diverged"))
        arm = setups[run.setup].setup.label(run.arm)
        row = [run.setup, run.cell, arm, str(run.seed), record.state, str(len(record.rows))]
        row += [f"{steps[-1]:.0f}" if len(steps) else "0", *map(number, scores)]
        rows.append([*row, f"{diverged:.0f}", record.reason])
    columns = ["Set-up", "Config.", "Type", "Seed", "State", "Epochs", "Steps"]
    columns += [*(name.capitalize() for name in SCORES), "Diverged episodes", "Why it failed"]
    said = [f"{name}: {one.setup.measure}" for name, one in setups.items()]
    return Table("runs", "Runs", columns, rows, f"Rates: {'; '.join(said)}.")
