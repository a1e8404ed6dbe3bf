"""`tactilerl gate`: what can be won by touch in a scene, before any training?"""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from typing import Annotated, Any

from rich.table import Table

from ..envs import hands, layouts, validation
from ..errors import InputError, input_errors
from ..machine import WorkerCount, free_cores
from ..scripted import gate
from ..terminal import flags
from ..terminal.console import console, progress
from .grasps import require_grasp
from .scene import read_scene

ABOUT = """\
Can touch make a difference in a scene? Compares scripted hands that feel, see, or do neither,
before any training. With several values of --layout, it plays the hand that feels with each.

examples:
  tactilerl gate --scene handover
  tactilerl gate --scene handover --starts 50 --search 5
  tactilerl gate --scene handover_anywhere --layout 1 3 my_layout.toml"""


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
    chosen, args = flags.several(args, "--layout")
    read, scene = read_scene(GateFlags, args, "tactilerl gate", ABOUT)
    with input_errors():
        if scene.touch != "on":
            raise InputError("--touch: leave it out; the gate compares with no touch")
        beside = [dataclasses.replace(scene, layout=layout) for layout in chosen[1:]]
        for each in (scene, *beside):
            validation.validate(each)
            layout, hand = layouts.load(each.layout), hands.get(read.env)
            layouts.require_places(layout, hand)
            layout.place(hand)
        if scene.task != "handover":
            require_grasp(read.env, scene)
    with (
        progress("trying scripted hands", is_shown=not read.json) as tick,
        input_errors(),
    ):
        examine = partial(
            gate.examine, read.env, starts=read.starts, search=read.search, seed=read.seed,
            workers=read.workers or free_cores(), tick=tick,
        )  # fmt: skip
        rows = examine(scene)
        touch = {each.layout: examine(each, senses=["touch"])[0] for each in beside}
    sentence = gate.verdict(rows)
    if read.json:
        result: dict[str, Any] = {
            "reflexes": [dataclasses.asdict(row) for row in rows],
            "verdict": sentence,
        }
        if touch:
            plain = {name: dataclasses.asdict(row) for name, row in touch.items()}
            result["layouts"] = plain
        print(json.dumps(result))
        return 0
    table = Table("scripted hand", "switches when", "success", "95 % interval")
    for row in rows:
        shown = {row.name: row}
        if touch and row.name == "touch":
            every = {scene.layout: row, **touch}
            shown = {f"touch, layout {name}": one for name, one in every.items()}
        for name, one in shown.items():
            low, high = one.interval
            when = gate.SENSES[row.name][1]
            table.add_row(name, when, f"{one.rate:.2f}", f"{low:.2f} – {high:.2f}")
    console.print(table)
    console.print(sentence)
    return 0
