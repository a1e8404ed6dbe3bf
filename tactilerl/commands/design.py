"""`tactilerl design`: which few taxels should a hand have?"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Column, Table

from ..envs import layouts
from ..errors import InputError, input_errors
from ..files import pasted
from ..machine import free_cores
from ..pictures import places
from ..placement import files
from ..placement.candidates import DesignFlags, scenes_of
from ..placement.choice import Design, Row, Use, design, n_played
from ..terminal import flags
from ..terminal.console import console, progress
from .scene import sensor_notes, warn

ABOUT = """\
Where should a hand's few taxels go? Plays each start of a handover once with a dense skin,
chooses the taxels with which a hand that closes at the first touch succeeds most often, and
judges them on other starts, without training.

examples:
  tactilerl design --scene handover_anywhere --taxels 4 --out four.toml
  tactilerl design --scene handover --taxels 1..12 --only palm --out my_design
  tactilerl design --scene handover_anywhere --taxels 8 --survives taxel
  tactilerl design --scene handover --sensor my_fsr.toml --budget 100 --out my_design"""
NAMED = {
    "chosen": "chosen",
    "random": "random, mean",
    "no touch": "no touch",
    "whole skin": "all candidates",
}


@dataclass(frozen=True)
class Flags(DesignFlags):
    """All flags of `tactilerl design`."""

    leave_out: Annotated[tuple[str, ...], tyro.conf.arg(name="not")] = ()
    """Not on these segments or digits, named likewise."""
    out: Path | None = None
    """FILE.toml for one layout and its drawing, or a folder for all of them, a page and JSON."""
    overwrite: bool = False
    """Replace files of --out that are there."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """Run `tactilerl design --scene handover --taxels 1`."""
    read = flags.parse(Flags, args, "tactilerl design", ABOUT)
    with input_errors():
        read.validate()
        if read.out is not None:
            for flag in ("sensor", "taxel_threshold"):
                if (n := len(getattr(read, flag))) > 1:
                    raise InputError(
                        f"--out: found with {n} of --{flag.replace('_', '-')}, allowed with one: each "
                        "has layouts of its own"
                    )
            is_one = read.budget is not None or len(read.numbers) == 1
            files.require(read.out, is_one, read.overwrite)
        env, configs = scenes_of(read)
        warn(
            [
                note
                for scene in configs.values()
                for kind in read.kinds(scene)
                for note in sensor_notes(
                    env,
                    replace(
                        scene, sensor=kind.name or "", taxel_threshold=kind.threshold
                    ),
                )
            ]
        )
        total = n_played(read)
        what = f"playing about {total} episodes"
        with progress(what, total, not read.json, is_long=True) as tick:
            result = design(read, read.workers or free_cores(), tick)
        written = {} if read.out is None else files.write(result, read.out)
    if read.json:
        print(json.dumps(result.as_dict()))
        return 0
    _print(result)
    chosen = [row for row in result.rows if row.layout == "chosen"]
    rows = dict(zip(result.chosen, chosen, strict=False))
    for path, key in written.items():
        hint = "" if key is None else _hint(result, path, rows[key])
        console.print(f"{path}{hint}")
    return 0


def _hint(result: Design, path: Path, row: Row) -> str:
    """Return what trains the hand with the layout."""
    given, waits = result.pool.flags, row.start_closing
    values = {
        "scene": given.scene[0],
        "env": given.env,
        "simulator": given.simulator,
        "layout": str(path),
        "sensor": "".join(given.sensor),
        "start-closing": "" if waits is None else f"{waits:g}",
    }
    words = [f" --{key} {pasted(value)}" for key, value in values.items() if value]
    return f"    tactilerl train{''.join(words)}"


def _print(result: Design) -> None:
    """Print the tables, and how far they can be trusted."""
    pool = result.pool
    flags_given, names = pool.flags, ", ".join(pool.scenes)
    console.print(f"{names}: taxels for a hand that closes at the first touch")
    console.print(
        f"{len(pool.free)} candidates; chosen from {flags_given.starts} starts of "
        f"each scene, judged on {flags_given.test_starts} others"
    )
    if flags_given.keep:
        layout = f"layout {layouts.short(flags_given.keep)}"
        console.print(f"chosen and random taxels are added to those of {layout}")
    if pool.early:
        early = ", ".join(pool.early)
        console.print(f"left out, since they fire before anything comes: {early}")
    for use in result.uses:
        console.print(_table(result, use))
    for sentence in result.sentences():
        console.print(sentence)
    console.print("Chosen sets are the best that a search found.")
    console.print(_places(result))


def _wrapping(*headings: str) -> Table:
    """Return a table that breaks long names and does not cut them."""
    return Table(*(Column(heading, overflow="fold") for heading in headings))


def _table(result: Design, use: Use) -> Table:
    """Return a line for each set with one sensor and threshold, and for no touch."""
    given, rows = result.pool.flags, use.rows(result.rows)
    priced = any(row.price is not None for row in rows)
    table = _wrapping("taxels", *["price"] * priced, "which", "success", "felt")
    table.title = use.at.strip() or None
    if given.survives:
        loss = layouts.short(given.survives)
        table.add_column(f"after the worst loss ({loss})", overflow="fold")
    if given.start_closing:
        table.add_column("waits at")
    if result.best is not None:
        table.add_column(f"more than layout {layouts.short(result.best)}")
    for row in rows:
        table.add_row(*_cells(row, result, priced))
    return table


def _cells(row: Row, result: Design, priced: bool) -> list[str]:
    """Return a line of the table."""
    name = NAMED.get(row.layout, f"layout {layouts.short(row.layout)}")
    success = _rate(row.success, row.success_interval)
    name += ", knee" * row.is_knee
    price = "" if row.price is None else f"{row.price:g}"
    cells = [str(row.taxels), *[price] * priced, name, success, f"{row.felt:.2f}"]
    if result.pool.flags.survives:
        worst = _rate(row.worst, row.worst_interval)
        cells.append(worst if row.lost is None else f"{worst} without {row.lost}")
    if result.pool.flags.start_closing:
        cells.append("" if row.start_closing is None else f"{row.start_closing:g}")
    if row.difference:
        cells.append("{:+.2f} ({:+.2f} to {:+.2f})".format(*row.difference))
    return cells


def _rate(rate: float, interval: tuple[float, float] | None) -> str:
    """Return a rate, with its interval where there is one."""
    if interval is None:
        return f"{rate:.2f}"
    return "{:.2f} ({:.2f}–{:.2f})".format(rate, *interval)


def _places(result: Design) -> Table:
    """Return a table of where the largest chosen set is, in words and in the frames of the links."""
    table = _wrapping("", "taxel", "link", "place, mm", "radius")
    pool = result.pool
    taxels = pool.skin.take(result.chosen[max(result.chosen)])
    words = places.described(taxels, pool.hand)
    for number, (point, where) in enumerate(zip(taxels.points, words, strict=True), 1):
        place = ", ".join(f"{1e3 * value:.1f}" for value in point.position)
        table.add_row(str(number), where, point.link, place, f"{1e3 * point.radius:g}")
    return table
