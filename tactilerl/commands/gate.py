"""Run `tactilerl gate`, which says what can be won by touch in a scene, before any training."""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

from rich.table import Table

from ..envs import validation
from ..errors import InputError, input_errors
from ..machine import WorkerCount, free_cores
from ..scripted import gate
from ..terminal.console import Progress, console
from .scene import layout_notes, read_scene, require_grasp, sensor_notes, warn

ABOUT = """\
Can touch make a difference in a scene? Compares scripted hands that feel, see, or do neither,
before any training. Holds are judged by the fast test unless --hold-verdict says otherwise.

examples:
  tactilerl gate --scene handover
  tactilerl gate --scene handover --starts 50 --search 5
  tactilerl gate --scene handover --layout my_layout.toml --taxel-threshold 0.3"""


@dataclasses.dataclass(frozen=True)
class GateFlags:
    """Options of gate itself."""

    env: str = "mpl"
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file."""
    starts: Annotated[int, "[1, inf)"] = 200
    """Number of initial states from which the chosen scripted hands are compared."""
    search: Annotated[int, "[1, inf)"] = 20
    """Initial states per candidate during the search; there are 15 candidates per
    sense."""
    seed: Annotated[int, "[0, 999999]"] = 0
    """Random seed of the initial states."""
    workers: WorkerCount = None
    """Episodes played side by side; default: one per free core."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """Run `tactilerl gate --scene handover`."""
    read, scene = read_scene(
        GateFlags, args, "tactilerl gate", ABOUT, hold_verdict="settled"
    )
    with input_errors():
        if scene.touch != "on":
            raise InputError("--touch: leave it out; the gate compares with no touch")
        validation.validate(scene)
        layout_notes(read.env, scene.layout)  # raises what is wrong with it
        require_grasp(read.env, scene)
        warn(sensor_notes(read.env, scene))
        n_senses = len(gate.useful_senses(scene))
        total = n_senses * gate.n_played(read.starts, read.search)
        tick = Progress(f"playing scripted hands, {total} episodes", total)
        searched = gate.numbers(read.seed, read.search, gate.SEARCH)
        compared = gate.numbers(read.seed, read.starts)
        workers = read.workers or free_cores()
        results = gate.examine(read.env, scene, searched, compared, workers, tick)
    said = gate.sentences(scene, results)
    if read.json:
        rows = [dataclasses.asdict(result) for result in results]
        print(json.dumps({"reflexes": rows, "verdict": " ".join(said)}))
        return 0
    table = Table("scripted hand", "switches when", "success", "95 % interval")
    for result in results:
        (low, high), (_, when) = result.interval, gate.SENSES[result.name]
        table.add_row(
            result.name, when, f"{result.rate:.2f}", f"{low:.2f} – {high:.2f}"
        )
    console.print(table)
    for sentence in said:
        console.print(sentence)
    return 0
