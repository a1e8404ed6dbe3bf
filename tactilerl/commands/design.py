"""`tactilerl design`: which few taxels should a hand have?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.table import Column, Table

from ..envs import layouts
from ..errors import input_errors
from ..files import as_json, replacing, require_new
from ..machine import free_cores
from ..pictures import hand_map
from ..placement.candidates import DesignFlags, Pool
from ..placement.choice import Design, design, n_played
from ..placement.page import page
from ..terminal import flags
from ..terminal.console import Progress, console
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

    out: Path | None = None
    """FILE.toml for the largest layout, or a folder for all of them, a page and
    JSON."""
    overwrite: bool = False
    """Replace files of --out that are there."""


def main(args: list[str]) -> int:
    """Run `tactilerl design --scene handover --taxels 1`."""
    read = flags.parse(Flags, args, "tactilerl design", ABOUT)
    with input_errors():
        if read.out is not None:
            require_new(read.out, read.overwrite, ".toml", "")
        pool = Pool.of(read)
        scenes = pool.scenes.values()
        warn([note for scene in scenes for note in sensor_notes(pool.env, scene)])
        total = n_played(pool)
        tick = Progress(f"playing about {total} episodes", total)
        result = design(pool, read.workers or free_cores(), tick)
        written = [] if read.out is None else write(result, read.out)
    show(result)
    for path in written:
        console.print(str(path))
    return 0


def write(result: Design, out: Path) -> list[Path]:
    """Write the largest layout to a file, or to a folder all, a page and JSON; return the files."""
    contents = {out: result.layout(max(result.chosen)).toml().encode()}
    if out.suffix != ".toml":
        out.mkdir(parents=True, exist_ok=True)
        contents = {
            out / f"design_{key:g}.toml": result.layout(key).toml().encode()
            for key in result.chosen
        }
        contents[out / "design.html"] = page(result)
        contents[out / "design.json"] = as_json(result.as_dict())
    for path, content in contents.items():
        with replacing(path) as file:
            file.write(content)
    return list(contents)


def show(result: Design) -> None:
    """Print the tables of a design, and how far they can be trusted."""
    pool, given = result.pool, result.pool.flags
    names = ", ".join(pool.scenes)
    console.print(f"{names}: taxels for a hand that closes at the first touch")
    console.print(
        f"{pool.free.sum()} candidates; chosen from {given.starts} starts of "
        f"each scene, judged on {given.test_starts} others"
    )
    if given.keep:
        layout = f"layout {layouts.short(given.keep)}"
        console.print(f"chosen and random taxels are added to those of {layout}")
    if pool.early:
        early = ", ".join(pool.early)
        console.print(f"left out, since they fire before anything comes: {early}")
    console.print(_table(result))
    for sentence in result.sentences():
        console.print(sentence)
    console.print("Chosen sets are the best that a search found.")
    console.print(_places(result))


def _wrapping(*headings: str) -> Table:
    """Return a table that breaks long names and does not cut them."""
    return Table(*(Column(heading, overflow="fold") for heading in headings))


def _table(result: Design) -> Table:
    """Return a line for each set, and for no touch."""
    given, prices = result.pool.flags, result.pool.prices
    columns = ["taxels", *["price"] * bool(prices), "which", "success", "felt"]
    if given.survives:
        columns.append(f"after the worst loss ({layouts.short(given.survives)})")
    table = _wrapping(*columns, "waits at")
    for row in result.rows:
        name = NAMED.get(row.layout, f"layout {layouts.short(row.layout)}")
        cells = [str(row.taxels)]
        if prices:
            cells.append("" if row.price is None else f"{row.price:g}")
        cells += [name + ", knee" * row.is_knee]
        cells += [_rate(row.success, row.success_interval), f"{row.felt:.2f}"]
        if given.survives:
            without = "" if row.lost is None else f" without {row.lost}"
            cells.append(_rate(row.worst, row.worst_interval) + without)
        if row.start_closing is not None:
            cells.append(f"{row.start_closing:g}")
        table.add_row(*cells)
    return table


def _rate(rate: float, interval: tuple[float, float] | None) -> str:
    """Return a rate, with its interval where there is one."""
    if interval is None:
        return f"{rate:.2f}"
    return "{:.2f} ({:.2f}–{:.2f})".format(rate, *interval)


def _places(result: Design) -> Table:
    """Return a table of where the largest chosen set is, in words and in the frames of the links."""
    table = _wrapping("", "taxel", "link", "place, mm", "radius")
    taxels = result.pool.skin.take(result.best)
    words = hand_map.described(taxels, result.pool.hand)
    for number, (point, where) in enumerate(zip(taxels.points, words, strict=True), 1):
        place = ", ".join(f"{1e3 * value:.1f}" for value in point.position)
        table.add_row(str(number), where, point.link, place, f"{1e3 * point.radius:g}")
    return table
