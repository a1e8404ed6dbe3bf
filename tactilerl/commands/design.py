"""`tactilerl design`: which few taxels should a hand have?"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from ..envs import layouts
from ..errors import input_errors
from ..files import pasted
from ..machine import free_cores
from ..placement import files
from ..placement.candidates import DesignFlags
from ..placement.choice import Design, Row, design
from ..terminal import flags
from ..terminal.console import console, progress

ABOUT = """\
Where should a hand's few taxels go? Plays each start of a handover once with a dense skin,
chooses the taxels by which a hand succeeds that closes at the first touch, and judges them on
other starts, without training.

examples:
  tactilerl design --scene handover_anywhere --taxels 4 --out four.toml
  tactilerl design --scene handover --taxels 1..12 --only palm --out my_design
  tactilerl design --scene handover_anywhere --start-closing 0.2 0.3 0.4"""
EXACT = 1e-3  # of a bound: less than a start
NAMED = {
    "chosen": "chosen",
    "random": "random sets, mean",
    "whole skin": "all candidates",
}


@dataclass(frozen=True)
class Flags(DesignFlags):
    """All flags of `tactilerl design`."""

    leave_out: Annotated[tuple[str, ...], tyro.conf.arg(name="not")] = ()
    """Not on these segments or digits, named likewise."""
    out: Path | None = None
    """Where the layout goes: FILE.toml, or a folder for the layouts of all numbers, figures, JSON."""
    overwrite: bool = False
    """Replace files of --out that are there."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """`tactilerl design --scene handover --taxels 1`"""
    read = flags.parse(Flags, args, "tactilerl design", ABOUT)
    with input_errors():
        read.validate()
        if read.out is not None:
            files.require(read.out, read.numbers, read.overwrite)
        with progress("playing starts", read.n_played, not read.json) as tick:
            found = design(read, read.workers or free_cores(), tick)
        written = [] if read.out is None else files.write(found, read.out)
    if read.json:
        print(json.dumps(found.as_dict()))
        return 0
    _print(found)
    layout_files = zip(written, found.chosen, strict=False)  # layouts come first
    hints = {path: _hint(found, path, n) for path, n in layout_files}
    for path in written:
        console.print(f"{path}{hints.get(path, '')}")
    return 0


def _hint(found: Design, path: Path, n: int) -> str:
    """Return what trains the hand with the layout."""
    asked, waits = found.pool.flags, found.waits_at(n)
    flags_given = {
        "--scene": asked.scene[0],
        "--env": asked.env,
        "--simulator": asked.simulator,
        "--layout": str(path),
        "--start-closing": "" if waits is None else f"{waits:g}",
    }
    given = [f"{key} {pasted(value)}" for key, value in flags_given.items() if value]
    return f"    tactilerl train {' '.join(given)}"


def _print(found: Design) -> None:
    """Print the table, and how far it can be trusted."""
    pool = found.pool
    asked, names = pool.flags, ", ".join(scene.name for scene in pool.scenes)
    console.print(f"{names}: taxels for a hand that closes at the first touch")
    console.print(
        f"{len(pool.columns) - pool.n_kept} candidates; chosen from {asked.starts} starts of each "
        f"scene, judged on {asked.test_starts} others"
    )
    if asked.keep:
        kept = f"layout {layouts.short(asked.keep)}"
        console.print(f"chosen and random taxels are added to those of {kept}")
    if pool.early:
        early = ", ".join(pool.early)
        console.print(f"left out, since they fire before anything comes: {early}")
    table = Table("taxels", "which", "success", "95 % interval", "felt")
    if asked.start_closing:
        table.add_column("waits at")
    if found.best is not None:
        table.add_column(f"more than layout {layouts.short(found.best)}")
    for row in found.rows:
        table.add_row(*_cells(row, bool(asked.start_closing)))
    console.print(table)
    if found.hopeless:
        share = f"in {found.hopeless:.2f} of the starts"
        console.print(f"{share} the hand fails, at whichever touch it closes")
    for row in found.rows:
        if row.chosen_from is not None:
            console.print(_bound(row, row.chosen_from))


def _cells(row: Row, waits: bool) -> list[str]:
    """Return a line of the table."""
    name = NAMED.get(row.layout, f"layout {layouts.short(row.layout)}")
    cells = [str(row.taxels), name, f"{row.success:.2f}"]
    interval = row.success_interval
    cells.append("{:.2f} – {:.2f}".format(*interval) if interval else "")
    cells.append(f"{row.felt:.2f}")
    if waits:
        cells.append("" if row.start_closing is None else f"{row.start_closing:g}")
    if row.difference:
        cells.append("{:+.2f} ({:+.2f} to {:+.2f})".format(*row.difference))
    return cells


def _bound(row: Row, reached: float) -> str:
    """Return how good a set of the same size could be."""
    best = f"{row.taxels} chosen: {reached:.3f} of the starts they were chosen from"
    if row.bound is not None and row.bound - reached < EXACT:
        return f"{best}; no set of the same size has more"
    bound = "" if row.bound is None else f"; none has more than {row.bound:.3f}"
    return f"{best}, by greedy search with swaps{bound}"
