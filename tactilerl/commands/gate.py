"""`tactilerl gate`: what can be won by touch in a scene, before any training?"""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from itertools import product
from typing import Annotated, Any

from rich.table import Table

from ..envs import hands, layouts, validation
from ..envs.grasp import GraspConfig
from ..errors import InputError, input_errors
from ..machine import WorkerCount, free_cores
from ..scripted import gate
from ..terminal import flags
from ..terminal.console import console, progress
from .grasps import require_grasp
from .scene import read_scene

ABOUT = """\
Can touch make a difference in a scene? Compares scripted hands that feel, see, or do neither,
before any training. With several values of --layout or --taxel-threshold, it plays the hand that
feels with each. Holds are judged by the fast test unless --hold-verdict says otherwise.

examples:
  tactilerl gate --scene handover
  tactilerl gate --scene handover --starts 50 --search 5
  tactilerl gate --scene handover_anywhere --layout 1 3 my_layout.toml
  tactilerl gate --scene handover --taxel-threshold 0 0.1 0.3"""


@dataclasses.dataclass(frozen=True)
class GateFlags:
    """Flags of `tactilerl gate`, besides the scene's."""

    env: str = "mpl"
    """The hand."""
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
    read, scene = read_scene(GateFlags, args, "tactilerl gate", ABOUT)
    if not any(arg.replace("_", "-").startswith("--hold-verdict") for arg in args):
        scene = dataclasses.replace(scene, hold_verdict="settled")
    with input_errors():
        if scene.touch != "on":
            raise InputError("--touch: leave it out; the gate compares with no touch")
        variants = [
            dataclasses.replace(scene, layout=layout, taxel_threshold=threshold)
            for layout, threshold in product(
                layout_names or [scene.layout],
                map(float, thresholds) if thresholds else [scene.taxel_threshold],
            )
        ]
        for each in variants:
            validation.validate(each)
            layout, hand = layouts.load(each.layout), hands.get(read.env)
            layouts.require_places(layout, hand)
            layout.place(hand)
        if scene.task != "handover":
            require_grasp(read.env, scene)
    n_senses = len(gate.useful_senses(scene)) + len(variants) - 1
    total = n_senses * gate.n_played(read.starts, read.search)
    what = f"playing scripted hands, {total} episodes"
    with progress(what, total, is_shown=not read.json) as tick, input_errors():
        examine = partial(
            gate.examine, read.env, starts=read.starts, search=read.search, seed=read.seed,
            workers=read.workers or free_cores(), tick=tick,
        )  # fmt: skip
        rows = examine(variants[0])
        touch = [row for row in rows if row.name == "touch"]
        touch += [examine(each, senses=["touch"])[0] for each in variants[1:]]
    sentences = [gate.verdict(rows)]
    if thresholds:
        blind, n = gate.without_touch(rows).rate, len(thresholds)
        for at in range(0, len(variants), n):
            rates = [row.rate for row in touch[at : at + n]]
            by_threshold = dict(zip(map(float, thresholds), rates, strict=True))
            about = f"Layout {variants[at].layout}: " if len(variants) > n else ""
            sentences.append(about + gate.where_it_stops(by_threshold, blind))
    if read.json:
        felt = zip(variants, touch, strict=True)
        result: dict[str, Any] = {
            "reflexes": [dataclasses.asdict(row) for row in rows],
            "touch": [
                {
                    "layout": each.layout,
                    "taxel_threshold": each.taxel_threshold,
                    **dataclasses.asdict(row),
                }
                for each, row in felt
            ],
            "verdict": " ".join(sentences),
        }
        print(json.dumps(result))
        return 0
    table = Table("scripted hand", "switches when", "success", "95 % interval")
    for row in rows:
        shown = {row.name: row}
        if row.name == "touch":
            names = [_name(each, layout_names, thresholds) for each in variants]
            shown = dict(zip(names, touch, strict=True))
        for name, one in shown.items():
            low, high = one.interval
            when = gate.SENSES[row.name][1]
            table.add_row(name, when, f"{one.rate:.2f}", f"{low:.2f} – {high:.2f}")
    console.print(table)
    for sentence in sentences:
        console.print(sentence)
    return 0


def _name(scene: GraspConfig, layout_names: list[str], thresholds: list[str]) -> str:
    """Return what the row of a hand with touch is called."""
    layout = f", layout {scene.layout}" if len(layout_names) > 1 else ""
    threshold = f", {scene.taxel_threshold:g} N" if len(thresholds) > 1 else ""
    return f"touch{layout}{threshold}"
