"""The tables of a report, as data; and a table as Markdown, CSV and LaTeX."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from .. import statistics
from ..errors import InputError
from ..runs import config as configuration
from ..statistics import Array, Estimate
from .analysis import Analysis, SetupResult
from .grid import SCORES
from .records import UNTOLD, settings
from .summary import ENDINGS, MEANS, made_with, subject
from .verdicts import THRESHOLDS

SETTING = "Setting"
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
    brief: Sequence[str] = ()
    """The columns of a narrow table in LaTeX beside the whole one."""

    @property
    def frame(self) -> pd.DataFrame:
        """Rows under headings; without settings or groups where there is only one."""
        frame = pd.DataFrame(self.rows).fillna("–")
        return frame.drop(
            columns=[n for n in (SETTING, "Group") if {*frame.get(n, ())} == {"all"}]
        )

    def formats(self) -> dict[str, bytes]:
        """The table in each format, by the ending of its file."""
        frame = self.frame
        parts = [f"**{self.title}**", self.note, _text(frame, "pipe")]
        made = {
            "md": "\n\n".join(filter(None, parts)),
            "tex": _text(frame, "latex_booktabs"),
        }
        if self.brief:
            columns = [name for name in self.brief if name in frame]
            made["brief.tex"] = _text(frame[columns], "latex_booktabs")
        made["csv"] = frame.to_csv(index=False, lineterminator="\n")
        return {ending: text.encode() for ending, text in made.items()}


def _text(frame: pd.DataFrame, style: str) -> str:
    return (
        str(frame.to_markdown(index=False, tablefmt=style, disable_numparse=True))
        + "\n"
    )


def number(value: float, digits: int = 2) -> str:
    """A number as tables show it; a dash where there is none."""
    return "–" if math.isnan(value) else f"{value + 0.0:.{digits}f}"


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
    rows, heading = [], MEANS[score].capitalize()
    note = (
        f"Mean of {treatment} minus {control} in runs of the same seed, with a 95 % bootstrap interval "
        f"over pairs. The study is judged by {MEANS[score]}. p is that of a sign-flip test, corrected "
        "for all rows (Holm). The other scores are for comparison."
    )  # fmt: skip
    for cell, found in one.comparisons.items():
        verdict, room = found.verdict, found.headroom
        row = {SETTING: cell, "Pairs": f"{len(verdict.pairs)} of {verdict.n_seeds}"}
        row |= {
            heading: shown(verdict.pairs.difference, 3),
            "p": p_value(verdict.p_holm),
        }
        if stage := verdict.stage:
            row["Look"] = f"{stage.look} of {stage.of}: {ENDINGS[stage.ending]}"
        for name, pairs in found.secondary.items():
            row[MEANS[name].capitalize()] = shown(pairs.difference, 3)
        if room:
            row["Sight gives"] = shown(room.room)
            row["Touch, share of it"] = (
                shown(room.share) if room.is_enough else "cannot tell"
            )
        rows.append(row)
    if "Look" in rows[0]:
        note += (
            " p and interval are those of the look that ended the comparison, corrected for all "
            "looks; the other scores are of all runs."
        )
    if any("Sight gives" in row for row in rows):
        note += (
            f" Sight gives: the object seen exactly, minus not, both with {control}."
        )
    title = f"{treatment} − {control} in pairs: {subject(one)}"
    return Table(
        f"{one.setup.name}_comparisons",
        title,
        rows,
        note,
        (SETTING, "Pairs", heading, "p"),
    )


def median_steps(steps: Array) -> str:
    """Median of the steps to a threshold (runs,), infinite where it was not reached, and how many runs
    reached it."""
    median = f"{np.median(steps):,.0f}".replace("inf", "never")
    return f"{median}; {np.isfinite(steps).sum()} of {len(steps)}"


def measures(one: SetupResult, score: str) -> Table:
    """What else a learning curve says: means with intervals, and steps to two thresholds."""
    rows = []
    for (cell, arm), group in one.groups.items():
        row = {SETTING: cell, "Group": one.setup.label(arm), "Runs": str(len(group))}
        for name in dict.fromkeys([score, *SCORES]):
            row[MEANS[name].capitalize()] = shown(
                statistics.mean(group.scores[name], group.counts)
            )
        for threshold in THRESHOLDS:
            steps = median_steps(group.scores[f"steps to {threshold:g}"])
            row[f"Steps to {threshold:g} (median; reached by)"] = steps
        rows.append(row)
    note = (
        "Mean of the runs with 95 % interval. Mean success: over the run; final: over its last tenth; "
        "converged: the level where a run spends most of its epochs. Steps are those of the first "
        "epoch at or above the threshold."
    )
    return Table(
        f"{one.setup.name}_measures", f"Each group of runs: {subject(one)}", rows, note
    )


def cost(analysis: Analysis) -> Table:
    """Core-hours and speed."""
    rows = []
    for one in analysis.setups:
        begun = [r for r in one.records if r.rows]
        seconds = [r.seconds for r in begun]
        ranks = [int((r.config or {}).get("ranks", 1)) for r in begun]
        steps = sum(int(r.rows[-1]["env_steps"]) for r in begun)
        row = {"Set-up": one.setup.name, "Runs begun": str(len(begun))}
        row["Core-hours"] = number(float(np.dot(seconds, ranks)) / 3600, 3)
        row["Median minutes per run"] = number(
            float(np.median(seconds or [math.nan])) / 60, 1
        )
        row["Steps per second"] = f"{steps / sum(seconds):.0f}" if sum(seconds) else "–"
        rows.append(row)
    note = "Time in epochs, without starting and saving; core-hours: times the processes of a run."
    return Table("cost", "Cost", rows, note)


def deviations(analysis: Analysis) -> Table:
    """Where a set-up's flags differ from the defaults, which are the paper's."""
    rows = []
    for one in analysis.setups:
        for flag, mine, default in _differences(one.config):
            if flag not in (*one.setup.grid, *UNTOLD, "device", "algo", "env"):
                rows.append(
                    {
                        "Set-up": one.setup.name,
                        "Flag": flag,
                        "Default": default,
                        "Here": mine,
                    }
                )
    note = (
        "Flags that are not the defaults of tactilerl train; the defaults are the paper's values, and "
        "where its text leaves something open, what the project's documentation of deviations says."
    )
    return Table("deviations", "Deviations from the defaults", rows, note)


def _differences(config: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """(flag, value, default); nothing for a run of another version, with other algorithms."""
    try:
        usual = configuration.defaults(config["run"]["algo"], config["run"]["env"])
    except (KeyError, InputError):
        return
    defaults = settings(usual.as_dict())
    for flag, mine in settings(config).items():
        default = defaults.get(flag)
        if mine != (list(default) if isinstance(default, tuple) else default):
            yield flag, in_words(mine), in_words(default)


def in_words(value: Any) -> str:
    """A setting as people write it."""
    if isinstance(value, list | tuple):
        return ", ".join(map(in_words, value)) or "none"
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return str(value).replace("..", " to ").replace("_", " ")


def versions(analysis: Analysis) -> Table:
    """Software that could change the runs' results, and by how many runs it was used."""
    found = Counter(
        one for record in analysis.records for one in made_with(record.config or {})
    )
    rows = [
        {"Package": p, "Version": v, "Runs": str(n)}
        for (p, v), n in sorted(found.items())
    ]
    return Table("versions", "Versions", rows)


def runs(analysis: Analysis) -> Table:
    """Every run: its seed, how it ended and what it reached."""
    setups, rows = {one.setup.name: one for one in analysis.setups}, []
    for record in analysis.records:
        run, one, steps = (
            record.run,
            setups[record.run.setup],
            record.column("env_steps"),
        )
        group = one.groups.get((run.cell, run.arm))
        is_in = group is not None and run.seed in group.seeds
        row = {
            "Set-up": run.setup,
            SETTING: run.cell,
            "Group": one.setup.label(run.arm),
        }
        row |= {
            "Seed": str(run.seed),
            "State": record.state,
            "Epochs": str(len(record.rows)),
        }
        row["Steps"] = f"{steps[-1]:.0f}" if len(steps) else "0"
        for name in SCORES:
            reached = (
                group.scores[name][group.seeds.index(run.seed)]
                if group and is_in
                else math.nan
            )
            row[MEANS[name].capitalize()] = number(reached)
        rows.append(
            row
            | {
                "Diverged episodes": str(record.diverged),
                "Why it failed": record.reason,
            }
        )
    said = [f"{name}: {one.setup.measure}" for name, one in setups.items()]
    return Table("runs", "Runs", rows, f"Rates: {'; '.join(said)}.")
