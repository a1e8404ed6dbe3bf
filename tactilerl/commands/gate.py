"""`tactilerl gate`: what can be won by touch in a scene, before any training?"""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

from rich.progress import Progress
from rich.table import Table

from ..envs import typed
from ..errors import InputError, input_errors
from ..probe import gate
from ..runs.config import WorkerCount
from ..runs.cores import free_cores
from ..terminal.console import console
from ..terminal.help import About
from .scene import read_scene, require_scene

ABOUT = About(
    "Can touch make a difference in a scene? Compares reflexes (scripted hands) that feel, see, or do "
    "neither, before any training.",
    first=("layout", "simulator", "task"),
    examples=(
        "tactilerl gate --scene handover",
        "tactilerl gate --scene handover --starts 50 --search 5",
    ),
)


@dataclasses.dataclass(frozen=True)
class GateFlags:
    """Flags of `tactilerl gate`, besides the scene's."""

    env: str = "mpl"
    """The hand."""
    starts: Annotated[int, "[1, inf)"] = 200
    """Number of initial states from which the chosen reflexes are compared."""
    search: Annotated[int, "[1, inf)"] = 20
    """Initial states per candidate reflex during the search; there are 15 candidates per sense."""
    seed: Annotated[int, "[0, 999999]"] = 0
    """Random seed of the initial states."""
    workers: WorkerCount = None
    """Episodes played side by side; default: one per free core."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """`tactilerl gate --scene handover`"""
    read, found = read_scene(GateFlags, args, "tactilerl gate", ABOUT)
    scene = require_scene(found, read.env)
    with input_errors():
        if scene.touch != "on":
            raise InputError("--touch: leave it out; the gate always compares touch with no touch")
        typed.validate(scene)
    with Progress(console=console, transient=True) as progress, input_errors():
        task = progress.add_task("trying reflexes", total=None)
        rows = gate.examine(
            read.env, scene, read.starts, read.search, read.seed,
            read.workers or free_cores(), lambda: progress.advance(task),
        )  # fmt: skip
    sentence = gate.verdict(rows)
    if read.json:
        print(json.dumps({"reflexes": [dataclasses.asdict(r) for r in rows], "verdict": sentence}))
        return 0
    table = Table("reflex", "switches when", "success", "95 % interval")
    for row in rows:
        low, high = row.interval
        _, about = gate.SENSES[row.name]
        table.add_row(row.name, about, f"{row.rate:.2f}", f"{low:.2f} – {high:.2f}")
    console.print(table)
    console.print(sentence)
    return 0
