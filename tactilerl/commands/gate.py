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
from ..terminal import flags
from ..terminal.console import Progress, console
from .scene import layout_notes, read_scene, require_grasp, sensor_notes, warn

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
    thresholds, args = flags.several(args, "--taxel-threshold", float)
    read, scene = read_scene(
        GateFlags, args, "tactilerl gate", ABOUT, hold_verdict="settled"
    )
    with input_errors():
        if scene.touch != "on":
            raise InputError("--touch: leave it out; the gate compares with no touch")
        variants = [
            dataclasses.replace(scene, layout=layout, taxel_threshold=force)
            for layout in layout_names or [scene.layout]
            for force in thresholds or [scene.taxel_threshold]
        ]
        for variant in variants:
            validation.validate(variant)
            layout_notes(read.env, variant.layout)  # raises what is wrong with it
        require_grasp(read.env, scene)
        warn([note for one in variants for note in sensor_notes(read.env, one)])
    total = gate.n_compared(variants, read.starts, read.search)
    tick = Progress(f"playing scripted hands, {total} episodes", total)
    played = read.starts, read.search, read.seed, read.workers or free_cores(), tick
    with input_errors():
        results = gate.compare(read.env, variants, *played)
    said = gate.sentences(scene, results)
    if read.json:
        rows = [dataclasses.asdict(result) for result in results]
        print(json.dumps({"reflexes": rows, "verdict": " ".join(said)}))
        return 0
    table = Table("scripted hand", "switches when", "success", "95 % interval")
    for result in results:
        (low, high), (_, when) = result.interval, gate.SENSES[result.name]
        name = ", ".join(filter(None, (result.name, gate.which(result, results))))
        table.add_row(name, when, f"{result.rate:.2f}", f"{low:.2f} – {high:.2f}")
    console.print(table)
    for sentence in said:
        console.print(sentence)
    return 0
