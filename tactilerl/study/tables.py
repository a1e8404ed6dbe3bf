"""The tables of a report, as texts in rows."""

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
from ..statistics import Array, Estimate
from .analysis import Analysis, SetupResult
from .grid import SCORES
from .pairs import SILENT, THRESHOLDS
from .records import flags_of
from .summary import MEANS, made_with, subject

SETTING = "Setting"
Row = dict[str, str]
"""A cell by the heading of its column."""


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    name: str
    """The name of its file and of its place in report.html."""
    title: str
    rows: list[Row]
    note: str = ""

    @property
    def columns(self) -> list[str]:
        """The headings, without settings or groups where there is only one."""
        known = dict.fromkeys(name for row in self.rows for name in row)
        return [
            name
            for name in known
            if name not in (SETTING, "Group")
            or any(row.get(name) != "all" for row in self.rows)
        ]

    def csv(self) -> bytes:
        """Return the table as a CSV file, with a dash where a row has nothing."""
        file = io.StringIO()
        options: dict[str, Any] = {"restval": "–", "extrasaction": "ignore"}
        writer = csv.DictWriter(file, self.columns, lineterminator="\n", **options)
        writer.writeheader()
        writer.writerows(self.rows)
        return file.getvalue().encode()


def number(value: float, digits: int = 2) -> str:
    """Return a number as tables show it; a dash where there is none."""
    return "–" if math.isnan(value) else f"{value + 0.0:.{digits}f}"


def shown(estimate: Estimate, digits: int = 2) -> str:
    """Return a value and its interval in one cell, as the paper's tables have it."""
    value, low, high = (number(x, digits) for x in estimate)
    return f"{value} –" if math.isnan(estimate.low) else f"{value} [{low}, {high}]"


def p_value(value: float) -> str:
    """Return a p-value to three digits."""
    return "< 0.001" if value < 0.001 else number(value, 3)


def comparisons(result: SetupResult, score: str) -> Table:
    """Return treatment against control in every setting, in pairs of runs of the same seed."""
    treatment, control = map(result.setup.label, result.setup.groups[:2])
    rows = []
    for setting, verdict in result.verdicts.items():
        pairs = verdict.pairs
        row = {SETTING: setting, "Pairs": f"{len(pairs)} of {verdict.n_seeds}"}
        row[MEANS[score].capitalize()] = shown(pairs.difference, 3)
        row["p"] = p_value(verdict.p_holm)
        rows.append(row)
    note = (
        f"Mean of {treatment} minus {control} in runs of the same seed, with a 95 % bootstrap interval "
        f"over pairs. The study is judged by {MEANS[score]}. p is that of a sign-flip test, corrected "
        "for all rows (Holm)."
    )
    title = f"{treatment} − {control} in pairs: {subject(result)}"
    return Table(f"{result.setup.name}_comparisons", title, rows, note)


def median_steps(steps: Array) -> str:
    """Return the median of the steps to a threshold (runs,), and how many runs reached it.

    Steps are infinite where it was not reached.
    """
    median = f"{np.median(steps):,.0f}".replace("inf", "never")
    return f"{median}; {np.isfinite(steps).sum()} of {len(steps)}"


def measures(result: SetupResult, score: str) -> Table:
    """Return the scores of each group: means with intervals, and steps to two thresholds."""
    rows = []
    for (setting, name), group in result.groups.items():
        label = result.setup.label(name)
        row = {SETTING: setting, "Group": label, "Runs": str(len(group))}
        for one in dict.fromkeys([score, *SCORES]):
            mean = statistics.mean(group.scores[one], group.counts)
            row[MEANS[one].capitalize()] = shown(mean)
        for threshold in THRESHOLDS:
            steps = median_steps(group.scores[f"steps to {threshold:g}"])
            row[f"Steps to {threshold:g} (median; reached by)"] = steps
        rows.append(row)
    note = (
        "Mean of the runs with 95 % interval. Mean success: over the run; final: over its last tenth; "
        "converged: the level where a run spends most of its epochs. Steps are those of the first "
        "epoch at or above the threshold."
    )
    title = f"Each group of runs: {subject(result)}"
    return Table(f"{result.setup.name}_measures", title, rows, note)


def cost(analysis: Analysis) -> Table:
    """Return core-hours and speed."""
    rows = []
    for one in analysis.setups:
        begun = [record for record in one.records if record.rows]
        seconds = np.array([record.seconds for record in begun])
        ranks = np.array([int(record.config.get("ranks", 1)) for record in begun])
        steps = sum(int(record.rows[-1]["env_steps"]) for record in begun)
        minutes = float(np.median(seconds)) / 60 if begun else math.nan
        speed = f"{steps / seconds.sum():.0f}" if seconds.sum() else "–"
        rows.append({
            "Set-up": one.setup.name,
            "Runs begun": str(len(begun)),
            "Core-hours": number(float(seconds @ ranks) / 3600, 3),
            "Median minutes per run": number(minutes, 1),
            "Steps per second": speed,
        })  # fmt: skip
    note = "Time in epochs, without starting and saving; core-hours: times the processes of a run."
    return Table("cost", "Cost", rows, note)


def deviations(analysis: Analysis) -> Table:
    """Return where a set-up's flags differ from the defaults, which are the paper's."""
    rows = []
    for one in analysis.setups:
        for flag, value, default in _differences(one.config):
            if flag not in (*one.setup.grid, *SILENT, "device", "algo", "env"):
                row = {"Set-up": one.setup.name, "Flag": flag, "Default": default}
                rows.append(row | {"Here": value})
    note = (
        "Flags that are not the defaults of tactilerl train; the defaults are the paper's values, and "
        "where its text leaves something open, what the project's documentation of deviations says."
    )
    return Table("deviations", "Deviations from the defaults", rows, note)


def _differences(config: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield (flag, value, default); nothing for a run of another version, with other algorithms."""
    try:
        usual = configuration.defaults(config["run"]["algo"], config["run"]["env"])
    except (KeyError, InputError):
        return
    defaults = flags_of(usual.as_dict())
    for flag, value in flags_of(config).items():
        default = defaults.get(flag)
        if value != (list(default) if isinstance(default, tuple) else default):
            yield flag, str(value), str(default)


def versions(analysis: Analysis) -> Table:
    """Return the software that could change the runs' results, and how many runs used it."""
    used = Counter(
        one for record in analysis.records for one in made_with(record.config)
    )
    rows = [
        {"Package": package, "Version": version, "Runs": str(n)}
        for (package, version), n in sorted(used.items())
    ]
    return Table("versions", "Versions", rows)


def runs(analysis: Analysis) -> Table:
    """Return every run: its seed, how it ended and what it reached."""
    rows = []
    for one in analysis.setups:
        for record in one.records:
            run, group = record.run, one.groups.get(record.run.place[1:])
            row = {
                "Set-up": run.setup,
                SETTING: run.setting,
                "Group": one.setup.label(run.group),
                "Seed": str(run.seed),
                "State": record.state,
                "Epochs": str(len(record.rows)),
                "Steps": record.rows[-1]["env_steps"] if record.rows else "0",
            }
            for name in SCORES:
                score = math.nan
                if group and record.is_finished:
                    score = group.scores[name][group.seeds.index(run.seed)]
                row[MEANS[name].capitalize()] = number(score)
            row["Diverged episodes"] = str(record.diverged)
            row["Why it failed"] = record.reason
            rows.append(row)
    rates = [f"{one.setup.name}: {one.setup.measure}" for one in analysis.setups]
    return Table("runs", "Runs", rows, f"Rates: {'; '.join(rates)}.")
