"""Report a study: sentences and tables, and report.html with the same as files beside it.

The same records give the same bytes: no file holds a date or a path.
"""

from __future__ import annotations

import csv
import io
import math
from base64 import b64encode
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import jinja2

from ..files import replacing
from ..statistics import Estimate, fewest_pairs
from . import figures
from .analysis import ALPHA, Analysis, Pairs, SetupResult
from .grid import Setup

TEMPLATE = "report.html.j2"
FEW_RUNS = 10  # of a group: docs/statistics.md
MEANS = {
    "area": "mean success",
    "last": "success in the last fifth",
    "converged": "converged success",
    "test": "tested success",
}
"""Scores as sentences have them."""


class Table(NamedTuple):
    """A table of texts."""

    name: str
    """The name of its file and of its place in report.html."""
    title: str
    rows: list[dict[str, str]]
    """Cells by the headings of their columns, which are those of the first row."""
    note: str = ""

    def csv(self) -> bytes:
        """Return the table as a CSV file."""
        file = io.StringIO()
        writer = csv.DictWriter(file, [*self.rows[0]], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        return file.getvalue().encode()


class Picture(NamedTuple):
    """A figure of a report."""

    name: str
    title: str
    svg: bytes

    @property
    def url(self) -> str:
        """The figure itself, as a page has it inside."""
        return f"data:image/svg+xml;base64,{b64encode(self.svg).decode()}"


Section = tuple[str, str, list[Table | Picture]]
"""The place of a section in the page, its heading, and what is below it."""


def number(value: float, digits: int = 2) -> str:
    """Return a number as tables show it; a dash where there is none."""
    return "–" if math.isnan(value) else f"{value:.{digits}f}"


def shown(estimate: Estimate, digits: int = 2) -> str:
    """Return a value and its interval in one cell, as the paper's tables have it."""
    value, low, high = (number(x, digits) for x in estimate)
    return f"{value} [{low}, {high}]"


def p_value(value: float) -> str:
    """Return a p-value to three digits."""
    return "< 0.001" if value < 0.001 else number(value, 3)


# -- sentences -------------------------------------------------------------------------------


def provenance(analysis: Analysis) -> str:
    """Return how many runs are done, and how long they took."""
    done = [record for record in analysis.records if record.state == "done"]
    hours = sum(one.seconds * one.config.get("ranks", 1) for one in done) / 3600
    return (
        f"{len(done)} of {len(analysis.records)} runs are done, {hours:.2f} core-hours."
    )


def answer(setup: Setup, setting: str, pairs: Pairs, score: str) -> str:
    """Return the comparison of a setting in a sentence, with its interval."""
    treatment, control = map(setup.label, setup.groups[:2])
    fewest = fewest_pairs(ALPHA / len(setup.settings))
    if pairs.p_holm <= ALPHA:
        verb = "raised" if pairs.difference.value > 0 else "lowered"
        result = f"{treatment} {verb} {MEANS[score]}"
    elif len(pairs) < fewest:
        result = f"too few runs to find a difference, which takes {fewest} pairs"
    else:
        result = f"no significant difference in {MEANS[score]}"
    n_pairs = f"{len(pairs)} of {len(setup.seeds)} pairs"
    if len(pairs) < 2:  # which have no interval
        return f"{setup.name}, {setting}: {result} ({n_pairs})."
    value, low, high = (f"{x:+.2f}".replace("-", "−") for x in pairs.difference)
    p = "p < 0.001" if pairs.p_holm < 0.001 else f"p = {pairs.p_holm:.3f}"
    return (
        f"{setup.name}, {setting}: {result} ({treatment} − {control}: {value}, 95 % interval {low} to "
        f"{high}, {p}, {n_pairs})."
    )


def answers(analysis: Analysis) -> list[str]:
    """Return every comparison's answer."""
    return [
        answer(result.setup, setting, pairs, analysis.study.score)
        for result in analysis.setups
        for setting, pairs in result.pairs.items()
    ]


def warnings(analysis: Analysis) -> list[str]:
    """Return what a reader must know before believing the numbers."""
    notes = []
    states = Counter(record.state for record in analysis.records)
    missing = [f"{n} {state}" for state, n in sorted(states.items()) if state != "done"]
    if missing:
        n_runs = len(analysis.records)
        notes.append(f"Of {n_runs} runs, {', '.join(missing)}: these are in no figure.")
    groups = [group for one in analysis.setups for group in one.groups.values()]
    fewest = min((len(group.reached) for group in groups), default=FEW_RUNS)
    if fewest < FEW_RUNS:
        notes.append(
            f"The smallest group has {fewest} runs. With fewer than {FEW_RUNS}, intervals contain the "
            "truth less often than they say where some runs fail."
        )
    for one in analysis.setups:
        name = one.setup.name
        if not one.groups:
            notes.append(f"{name}: no finished run with a {one.setup.measure}.")
        origins = [o for run in one.records for o in run.config.get("provenance", ())]
        made_with = [(one.get("commit"), one.get("versions")) for one in origins]
        if any(each != made_with[0] for each in made_with):
            notes.append(
                f"{name}: versions or commits differ between runs, and could change results."
            )
    return notes


# -- tables ----------------------------------------------------------------------------------


def comparisons(result: SetupResult, score: str) -> Table:
    """Return treatment against control in every setting, in pairs of runs of the same seed."""
    treatment, control = map(result.setup.label, result.setup.groups[:2])
    rows = [
        {
            "Setting": setting,
            "Pairs": f"{len(pairs)} of {len(result.setup.seeds)}",
            MEANS[score].capitalize(): shown(pairs.difference, 3),
            "p": p_value(pairs.p_holm),
        }
        for setting, pairs in result.pairs.items()
    ]
    note = (
        f"Mean of {treatment} minus {control} in runs of the same seed, with a 95 % bootstrap interval "
        f"over pairs. The study is judged by {MEANS[score]}. p is that of a sign-flip test, corrected "
        "for all rows (Holm)."
    )
    title = f"{treatment} − {control} in pairs: {result.subject}"
    return Table(f"{result.setup.name}_comparisons", title, rows, note)


def measures(result: SetupResult) -> Table:
    """Return the mean scores of each group, with intervals."""
    rows = []
    for (setting, name), group in result.groups.items():
        row = {"Setting": setting, "Group": result.setup.label(name)}
        row["Runs"] = str(len(group.reached))
        for score, mean in group.means.items():
            row[MEANS[score].capitalize()] = shown(mean)
        rows.append(row)
    note = (
        "Mean of the runs with 95 % interval. Mean success: over the run; "
        "converged: the level where a run spends most of its epochs; tested: at its end, without "
        "exploration noise, from the same starts; a dash where a run was not."
    )
    title = f"Each group of runs: {result.subject}"
    return Table(f"{result.setup.name}_measures", title, rows, note)


def runs(analysis: Analysis) -> Table:
    """Return every run: its name, how it ended and what it reached."""
    rows = []
    for one in analysis.setups:
        for record in one.records:
            run, group = record.run, one.groups.get(record.run.place[1:])
            steps = record.rows[-1]["env_steps"] if record.rows else 0
            row = {"Run": run.name, "State": record.state, "Steps": f"{steps:.0f}"}
            reached = group.reached.get(run.seed, {}) if group else {}
            for score, mean in MEANS.items():
                row[mean.capitalize()] = number(reached.get(score, math.nan))
            rows.append({**row, "Why it failed": record.reason})
    return Table("runs", "Every run", rows)


# -- the page --------------------------------------------------------------------------------


def sections(analysis: Analysis) -> list[Section]:
    """Return the sections of a report, in its order."""
    report: list[Section] = []
    for one in analysis.setups:
        name, parts = one.setup.name, list[Table | Picture]()
        if one.groups:
            if one.pairs:
                parts.append(comparisons(one, analysis.study.score))
            image = figures.curves(one)
            parts.append(Picture(f"{name}_curves", figures.title(one), image))
            parts.append(measures(one))
            report.append((f"setup-{name}", f"{name}: {one.subject}", parts))
    return [*report, ("runs", "Runs", [runs(analysis)])]


def write(analysis: Analysis, folder: Path) -> Path:
    """Write everything into `folder`, over files that are there; return report.html's path."""
    report, files = sections(analysis), dict[str, bytes]()
    for *_, parts in report:
        for part in parts:
            if isinstance(part, Table):
                files[f"tables/{part.name}.csv"] = part.csv()
            else:
                files[f"figures/{part.name}.svg"] = part.svg
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tactilerl.study", "."), autoescape=True
    )
    html = environment.get_template(TEMPLATE).render(
        study=analysis.study,
        provenance=provenance(analysis),
        answers=answers(analysis),
        warnings=warnings(analysis),
        sections=report,
    )
    files["report.html"] = html.encode()
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with replacing(folder / name) as file:
            file.write(data)
    return folder / "report.html"
