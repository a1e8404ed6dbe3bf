"""Run `tactilerl gate`, which says what can be won by touch in a scene, before any training."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

from rich.table import Table

from ..envs import tasks, validation
from ..envs.grasp import GraspConfig
from ..errors import InputError, input_errors
from ..machine import WorkerCount, free_cores
from ..scripted import gate
from ..terminal import flags
from ..terminal.console import console, progress
from .grasps import require_grasp
from .scene import layout_notes, read_scene

ABOUT = """\
Can touch make a difference in a scene? Compares scripted hands that feel, see, or do neither,
before any training. With several values of --layout or --taxel-threshold, it plays the hand that
feels with each. Holds are judged by the fast test unless --hold-verdict says otherwise.

examples:
  tactilerl gate --scene handover
  tactilerl gate --scene handover --starts 50 --search 5
  tactilerl gate --scene handover_anywhere --layout 1 3 my_layout.toml
  tactilerl gate --scene handover --taxel-threshold 0 0.1 0.3"""


Row = tuple[GraspConfig, gate.HandResult]


@dataclasses.dataclass(frozen=True)
class GateFlags:
    """Options of gate itself."""

    env: str = "mpl"
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file."""
    starts: Annotated[int, "[1, inf)"] = 200
    """Number of initial states from which the chosen scripted hands are compared."""
    search: Annotated[int, "[1, inf)"] = 20
    """Initial states per candidate during the search; there are 15 candidates per sense."""
    seed: Annotated[int, "[0, 999999]"] = 0
    """Random seed of the initial states."""
    workers: WorkerCount = None
    """Episodes played side by side; default: one per free core."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """Run `tactilerl gate --scene handover`."""
    layout_names, args = flags.several(args, "--layout")
    thresholds, args = flags.several(args, "--taxel-threshold")
    read, scene = read_scene(
        GateFlags, args, "tactilerl gate", ABOUT, hold_verdict="settled"
    )
    with input_errors():
        if scene.touch != "on":
            raise InputError("--touch: leave it out; the gate compares with no touch")
        forces: list[float | None] = [scene.taxel_threshold]
        if thresholds:
            forces = [*map(_newtons, thresholds)]
        variants = [
            dataclasses.replace(scene, layout=layout, taxel_threshold=force)
            for layout in layout_names or [scene.layout]
            for force in forces
        ]
        for variant in variants:
            validation.validate(variant)
            layout_notes(read.env, variant.layout)  # raises what is wrong with it
        if tasks.TASKS[scene.task].giver is None:
            require_grasp(read.env, scene)
    n_senses = len(gate.useful_senses(scene)) + len(variants) - 1
    total = n_senses * gate.n_played(read.starts, read.search)
    what = f"playing scripted hands, {total} episodes"
    with progress(what, total, is_shown=not read.json) as tick, input_errors():
        rows: list[Row] = []
        for variant in variants:
            senses = ["touch"] if rows else list(gate.SENSES)
            results = gate.examine(
                read.env, variant, read.starts, read.search, read.seed,
                read.workers or free_cores(), tick, senses,
            )  # fmt: skip
            rows += [(variant, result) for result in results]
    results = [result for variant, result in rows if variant is variants[0]]
    with_touch = [row for row in rows if row[1].name == "touch"]
    others = [result for result in results if result.name != "touch"]
    label = partial(_label, layout_names, thresholds)
    verdicts = [gate.verdict([*others, result]) for _, result in with_touch]
    sentences = verdicts[:1]
    if len({*verdicts}) > 1:
        sentences = [
            f"{label(variant)}: {verdict}"
            for (variant, _), verdict in zip(with_touch, verdicts, strict=True)
        ]
    if thresholds:
        blind = gate.without_touch(results).rate
        for layout in layout_names or [scene.layout]:
            rates = {
                variant.taxel_threshold or 0.0: (result.rate, blind)
                for variant, result in with_touch
                if variant.layout == layout
            }
            about = f"Layout {layout}: " if len(layout_names) > 1 else ""
            sentences.append(about + gate.where_touch_stops(rates))
    if read.json:
        content: dict[str, Any] = {
            "reflexes": [dataclasses.asdict(result) for result in results],
            "touch": [
                {
                    "layout": variant.layout,
                    "taxel_threshold": variant.taxel_threshold,
                    **dataclasses.asdict(result),
                }
                for variant, result in with_touch
            ],
            "verdict": " ".join(sentences),
        }
        print(json.dumps(content))
        return 0
    console.print(_table(rows, label))
    for sentence in sentences:
        console.print(sentence)
    return 0


def _newtons(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"taxel_threshold: found {text!r}, allowed numbers") from None


def _label(layout_names: list[str], thresholds: list[str], variant: GraspConfig) -> str:
    """Return what tells a variant from the others: its layout and threshold, or nothing."""
    parts = [f"layout {variant.layout}"] if len(layout_names) > 1 else []
    if len(thresholds) > 1:
        parts.append(f"{variant.taxel_threshold:g} N")
    return ", ".join(parts)


def _table(rows: list[Row], label: Callable[[GraspConfig], str]) -> Table:
    """Return a line for each scripted hand, in the order of their senses."""
    table = Table("scripted hand", "switches when", "success", "95 % interval")
    rows.sort(key=lambda row: list(gate.SENSES).index(row[1].name))
    for variant, result in rows:
        name, (low, high) = result.name, result.interval
        if name == "touch":
            name = ", ".join(filter(None, [name, label(variant)]))
        when = gate.SENSES[result.name][1]
        table.add_row(name, when, f"{result.rate:.2f}", f"{low:.2f} – {high:.2f}")
    return table
