"""The tables of a report, as data; and a table as Markdown, CSV and LaTeX."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from .. import statistics
from ..errors import InputError
from ..runs import config as configuration
from ..statistics import Array, Estimate
from .analysis import Analysis, Group, SetupResult
from .grid import SCORES
from .summary import ENDINGS, made_with, subject
from .verdicts import THRESHOLDS

UNTOLD = ("seed", "out", "workers", "threads", "tensorboard", "device", "algo", "env")
HEADINGS = {name: score.capitalize() for name, score in SCORES.items()}
Row = dict[str, str]
"""A cell by the heading of its column."""


@dataclass(frozen=True)
class Table:
    """A table of texts; a dash where a row has nothing in a column that others have."""

    name: str
    """Of its files and of its place in report.html."""
    title: str
    rows: list[Row]
    note: str = ""

    @property
    def frame(self) -> pd.DataFrame:
        """Rows under headings."""
        return pd.DataFrame(self.rows).fillna("–")

    def formats(self) -> dict[str, bytes]:
        """The table in each format, by the ending of its file."""
        styles = (("md", "pipe"), ("tex", "latex_booktabs"))
        made = {
            ending: self.frame.to_markdown(index=False, tablefmt=style, disable_numparse=True) + "\n"
            for ending, style in styles
        }
        made["csv"] = self.frame.to_csv(index=False, lineterminator="\n")
        made["md"] = "\n\n".join(filter(None, [f"**{self.title}**", self.note, made["md"]]))
        return {ending: text.encode() for ending, text in made.items()}


def number(value: float, digits: int = 2) -> str:
    """A number as tables show it; a dash where there is none."""
    if math.isnan(value):
        return "–"
    return f"{value + 0.0:.{digits}f}" if math.isfinite(value) else "never"


def shown(estimate: Estimate, digits: int = 2) -> str:
    """A value and its interval in one cell, as the paper's tables have it."""
    value, low, high = (number(x, digits) for x in estimate)
    return f"{value} –" if math.isnan(estimate.low) else f"{value} [{low}, {high}]"


def p_value(value: float) -> str:
    """To three digits."""
    return "< 0.001" if value < 0.001 else number(value, 3)


def comparisons(one: SetupResult, score: str) -> Table:
    """Treatment against control in every cell, in pairs of runs of the same seed."""
    treatment, control = map(one.setup.label, one.setup.arms[:2])
    rows, note = [], (
        f"Mean of {treatment} minus {control} in runs of the same seed, with a 95 % bootstrap interval "
        "over pairs. p: sign-flip test; Holm over the rows. The first score is the one that the study "
        "is judged by; the others are for comparison and not corrected."
    )  # fmt: skip
    for cell, found in one.comparisons.items():
        verdict, room = found.verdict, found.headroom
        row = {"Config.": cell, "Pairs": f"{len(verdict.pairs)} of {verdict.n_seeds}"}
        row[HEADINGS[score]] = shown(verdict.pairs.difference, 3)
        row |= {"p": p_value(verdict.pairs.p_value), "p, Holm": p_value(verdict.p_holm)}
        if stage := verdict.stage:
            row["Look"] = f"{stage.look} of {stage.of}: {ENDINGS[stage.ending]}"
        for name, pairs in found.secondary.items():
            row |= {HEADINGS[name]: shown(pairs.difference, 3), f"p, {name}": p_value(pairs.p_value)}
        if room:
            row["Sight gives"] = shown(room.room)
            row["Touch, share of it"] = shown(room.share) if room.is_enough else "cannot tell"
        rows.append(row)
    if "Look" in rows[0]:
        note += (
            " p and interval are those of the look that ended the comparison, corrected for all "
            "looks; the other scores are of all runs."
        )
    title = f"{treatment} − {control} in pairs: {subject(one)}"
    return Table(f"{one.setup.name}_comparisons", title, rows, note)


def groups(one: SetupResult) -> Iterator[tuple[Row, Group]]:
    """How a row of each group begins, and the group."""
    for (cell, arm), group in one.groups.items():
        yield {"Config.": cell, "Type": one.setup.label(arm), "Runs": str(len(group))}, group


def median_steps(steps: Array) -> str:
    """Median of the steps to a threshold (runs,), infinite where it was not reached, and how many runs
    reached it."""
    median = f"{np.median(steps):,.0f}".replace("inf", "never")
    return f"{median}; {np.isfinite(steps).sum()} of {len(steps)}"


def measures(one: SetupResult, score: str) -> Table:
    """What else a learning curve says: means with intervals, and steps to two thresholds."""
    rows = []
    for row, group in groups(one):
        for name in dict.fromkeys([score, *SCORES]):
            row[HEADINGS[name]] = shown(statistics.mean(group.scores[name], group.counts))
        for threshold in THRESHOLDS:
            steps = median_steps(group.scores[f"steps to {threshold:g}"])
            row[f"Steps to {threshold:g} (median; reached by)"] = steps
        rows.append(row)
    note = (
        "Mean of the runs with 95 % interval. Area: mean success over the run; final: over its last "
        "tenth; converged: the level where a run spends most of its epochs. Steps are those of the "
        "first epoch at or above the threshold."
    )
    return Table(f"{one.setup.name}_measures", f"Each arm: {subject(one)}", rows, note)


def cost(analysis: Analysis) -> Table:
    """Core-hours and speed."""
    rows = []
    for one in analysis.setups:
        begun = [r for r in one.records if r.rows]
        seconds = [r.seconds for r in begun]
        ranks = [int((r.config or {}).get("ranks", 1)) for r in begun]
        steps = sum(float(np.nan_to_num(r.column("env_steps"))[-1]) for r in begun)
        row = {"Set-up": one.setup.name, "Runs begun": str(len(begun))}
        row["Core-hours"] = number(float(np.dot(seconds, ranks)) / 3600, 3)
        row["Median minutes per run"] = number(float(np.median(seconds or [math.nan])) / 60, 1)
        row["Steps per second"] = f"{steps / sum(seconds):.0f}" if sum(seconds) else "–"
        rows.append(row)
    note = "Time in epochs, without starting and saving; core-hours: times the processes of a run."
    return Table("cost", "Cost", rows, note)


def deviations(analysis: Analysis) -> Table:
    """Where a set-up's flags differ from the defaults, which are the paper's."""
    rows = []
    for one in analysis.setups:
        for flag, mine, default in _differences(one.config):
            if flag not in (*one.setup.grid, *UNTOLD):
                rows.append({"Set-up": one.setup.name, "Flag": flag, "Default": default, "Here": mine})
    note = (
        "Flags that are not the defaults of tactilerl train; the defaults are the paper's values, and "
        "where its text leaves something open, what the project's documentation of deviations says."
    )
    return Table("deviations", "Deviations from the defaults", rows, note)


def _differences(config: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """(flag, value, default); nothing for a run of another version, with other algorithms."""
    try:
        defaults = configuration.defaults(config["run"]["algo"], config["run"]["env"]).as_dict()
    except (KeyError, InputError):
        return
    for part in ("run", "scene", "learner"):
        for flag, mine in (config.get(part) or {}).items():
            default = (defaults[part] or {}).get(flag)
            default = list(default) if isinstance(default, tuple) else default
            if mine != default:
                yield flag, str(mine), str(default)


def versions(analysis: Analysis) -> Table:
    """Software that the runs were made with, and by how many runs."""
    found = Counter(one for record in analysis.records for one in made_with(record.config or {}))
    rows = [{"Package": p, "Version": v, "Runs": str(n)} for (p, v), n in sorted(found.items())]
    return Table("versions", "Versions", rows)


def runs(analysis: Analysis) -> Table:
    """Every run: its seed, how it ended and what it reached."""
    setups = {one.setup.name: one for one in analysis.setups}
    rows = []
    for record in analysis.records:
        run, one, steps = record.run, setups[record.run.setup], record.column("env_steps")
        group = one.groups.get((run.cell, run.arm))
        at = group.seeds.index(run.seed) if group and run.seed in group.seeds else None
        diverged = sum(np.nansum(record.column(name)) for name in ("diverged", "test_diverged"))
        row = {"Set-up": run.setup, "Config.": run.cell, "Type": one.setup.label(run.arm)}
        row |= {"Seed": str(run.seed), "State": record.state, "Epochs": str(len(record.rows))}
        row["Steps"] = f"{steps[-1]:.0f}" if len(steps) else "0"
        for name in SCORES:
            row[name.capitalize()] = number(
                group.scores[name][at] if group and at is not None else math.nan
            )
        rows.append(row | {"Diverged episodes": f"{diverged:.0f}", "Why it failed": record.reason})
    said = [f"{name}: {one.setup.measure}" for name, one in setups.items()]
    return Table("runs", "Runs", rows, f"Rates: {'; '.join(said)}.")
