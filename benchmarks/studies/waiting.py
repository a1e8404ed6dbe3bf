"""How far closed do trained hands wait for an object?

    python -m benchmarks waiting studies/design --out docs/data/waiting.json

Takes the folder of a study of a handover with its checkpoints. Starts are those of no run.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tactilerl
from tactilerl.errors import input_errors
from tactilerl.study.grid import Run
from tactilerl.study.records import StudyFiles

from benchmarks.command import on_one_thread, parser, write
from benchmarks.printing import markdown
from benchmarks.studies.design_study import title

FIRST, STARTS = 3_000_000, 10


def waits(folder: Path, run: Run) -> float:
    """Mean over starts of how far the hand was told to close when the object sets off, 1 being all the
    way."""
    choices = {flag: run.flags[flag] for flag in ("scene", "layout", "touch") if flag in run.flags}
    env = tactilerl.make(**choices)
    base, policy = env.unwrapped, tactilerl.load_policy(folder)
    if base.task.giver is None:
        raise ValueError(f"{run.name}: found the task {base.config.task}, allowed handover")
    start, found = base.config.start_closing, []
    for number in range(FIRST, FIRST + STARTS):
        obs, _ = env.reset(seed=number)
        for _ in range(base.task.sets_off - 1):
            obs, *_ = env.step(policy.act(obs))
        further = base.hand.action_map.commands(base.state.targets)[-1]
        found.append(start + (1.0 - start) * float(further))
    env.close()
    return float(np.mean(found))


def main() -> None:
    """By layout, of the runs that are done."""
    flags = parser(__doc__)
    flags.add_argument("study", type=Path, help="a study's folder")
    options = flags.parse_args()
    on_one_thread()
    files, found = StudyFiles(options.study), dict[str, list[float]]()
    for run in files.study().runs():
        name = title(str(run.flags.get("layout"))) if "touch" not in run.flags else "no touch"
        if files.record(run).is_finished:
            with input_errors():
                found.setdefault(name, []).append(waits(files.run_dir(run).path, run))
    markdown(
        "| layout | runs | closed by |", ((n, len(x), f"{np.mean(x):.2f}") for n, x in found.items())
    )
    write(options.out, found)
