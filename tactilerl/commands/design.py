"""`tactilerl design`: which few taxels should a hand have?"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from ..envs import layouts
from ..errors import InputError, input_errors
from ..files import pasted
from ..machine import free_cores
from ..probe import design, design_files
from ..probe.candidates import Design, DesignFlags
from ..terminal import flags
from ..terminal.console import console, progress
from ..terminal.help import About

ABOUT = About(
    "Where should a hand's few taxels go? Plays each start of a scene once with a dense skin, chooses "
    "the taxels by which most starts succeed, and judges them on other starts, without training.",
    first=("scene", "env", "simulator", "taxels", "skin", "radius", "only", "leave_out", "keep",
           "redundancy", "start_closing", "taxel_dead", "taxel_false_on", "starts", "test_starts",
           "seed", "out", "json"),
    examples=(
        "tactilerl design --scene handover_anywhere --taxels 4 --out four.toml",
        "tactilerl design --scene handover --taxels 1..12 --only palm --out my_design",
        "tactilerl design --scene handover_anywhere --start-closing 0.2 0.3 0.4",
    ),
)  # fmt: skip


ABOUT_TASK = {
    "timing": (
        "when to close is the question, so taxels are chosen by the success of a hand that closes at "
        "the first touch",
        "success",
        "starts of each scene, judged on {test_starts} others",
    ),
    "information": (
        "whether a grasp will hold is the question, so taxels are chosen by how much they tell of that",
        "gain in AUC",
        "grasps, each predicted from taxels that were chosen without it",
    ),
}
EXACT = 1e-3  # of a bound: less than a start


@dataclass(frozen=True)
class Flags(DesignFlags):
    """All flags of `tactilerl design`."""

    leave_out: Annotated[tuple[str, ...], tyro.conf.arg(name="not")] = ()
    """Not on these segments or digits, named likewise."""
    out: Path | None = None
    """Where the layout goes: FILE.toml, or a folder for the layouts of all numbers, figures, JSON."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """`tactilerl design --scene handover --taxels 1`"""
    read = flags.parse(Flags, _gathered(args), "tactilerl design", ABOUT)
    with input_errors():
        read.validate()
        design_files.require(read.out, read.numbers)
        workers = read.workers or free_cores()
        with progress("playing starts", is_shown=not read.json) as show:
            found = design.design(read, workers, show)
        written = design_files.write(found, read.out)
    if read.json:
        print(json.dumps(found.result))
        return 0
    _print(found)
    numbers = dict(zip(written, found.chosen, strict=False))  # layouts come first
    for path in written:
        console.print(
            f"{path}{_hint(found, path, numbers[path]) if path in numbers else ''}"
        )
    return 0


def _hint(found: Design, path: Path, n: int) -> str:
    """What trains the hand with the layout."""
    asked, closing = found.result["asking"], found.waits_at(n)
    parts = [f"    tactilerl train --scene {pasted(asked['scene'][0])}"]
    parts += [
        f"--{flag} {pasted(asked[flag])}"
        for flag in ("env", "simulator")
        if asked[flag]
    ]
    parts.append(f"--layout {pasted(path)}")
    return " ".join(
        parts + ([] if closing is None else [f"--start-closing {closing:g}"])
    )


LISTS = ("--scene", "--only", "--not", "--beside", "--weights", "--start-closing")


def _gathered(args: Sequence[str]) -> list[str]:
    """--scene A --scene B is --scene A B; commas are as good as spaces."""
    rest: list[str] = []
    lists: dict[str, list[str]] = {}
    current = rest
    for arg in args:
        name, _, value = arg.partition("=")
        if name in LISTS:
            current = lists.setdefault(name, [])
            arg = value
        elif arg.startswith("--"):
            current = rest
        current += (
            [arg] if current is rest else [part for part in arg.split(",") if part]
        )
    for name, values in lists.items():
        if not values and name != "--beside":  # with nothing
            raise InputError(f"{name}: found nothing, expected one or more values")
    return [
        *rest,
        *(part for name, values in lists.items() for part in (name, *values)),
    ]


def _print(found: Design) -> None:
    """The table, and how far it can be trusted."""
    result = found.result
    question, measure, judged = ABOUT_TASK[result["question"]]
    key = measure.split()[0]
    console.print(f"{', '.join(result['scenes'])}: {question}")
    asked = result["asking"]
    console.print(
        f"{result['candidates']} candidates; chosen from {asked['starts']} {judged.format(**asked)}"
    )
    if asked["keep"]:
        kept = f"layout {layouts.short(asked['keep'])}"
        console.print(f"chosen and random taxels are added to those of {kept}")
    if result["early"]:
        console.print(
            f"left out, since they fire before anything comes: {', '.join(result['early'])}"
        )
    table = Table("taxels", "which", measure, "95 % interval")
    if key == "success":
        table.add_column("felt")
    waits = any("start_closing" in row for row in result["rows"])
    if waits:
        table.add_column("waits at")
    if result["beside"] is not None:
        table.add_column(f"more than layout {layouts.short(result['beside'])}")
    for row in result["rows"]:
        low, high = row.get(f"{key}_interval", ("", ""))
        cells = [str(row["taxels"]), _which(row), f"{row[key]:.2f}"]
        cells.append(f"{low:.2f} – {high:.2f}" if low != "" else "")
        cells += [f"{row['felt']:.2f}"] if "felt" in row else []
        cells += (
            [f"{row['start_closing']:g}" if "start_closing" in row else ""]
            if waits
            else []
        )
        if "difference" in row:
            cells.append("{:+.2f} ({:+.2f} to {:+.2f})".format(*row["difference"][key]))
        table.add_row(*cells)
    console.print(table)
    if result.get("hopeless"):
        console.print(
            f"in {result['hopeless']:.2f} of the starts the hand fails, at whichever touch it closes"
        )
    for row in result["rows"]:
        if "chosen_from" in row:
            console.print(_bound(row))


def _which(row: dict[str, Any]) -> str:
    named = {
        "chosen": "chosen",
        "random": "random sets, mean",
        "whole skin": "all candidates",
    }
    return named.get(row["layout"], f"layout {layouts.short(row['layout'])}")


def _bound(row: dict[str, Any]) -> str:
    """How good a set of the same size could be."""
    told = f"{row['taxels']} chosen: {row['chosen_from']:.3f} of the starts they were chosen from"
    if row["bound"] is None:
        return f"{told}, by greedy search with swaps"
    if row["bound"] - row["chosen_from"] < EXACT:
        return f"{told}; no set of the same size has more"
    return f"{told}, by greedy search with swaps; none has more than {row['bound']:.3f}"
