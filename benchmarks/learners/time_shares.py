"""Where does the time of a run go? Some rounds of its newest policy collecting and learning.

PPO's rounds are epochs, DDPG+HER's are cycles:

    python -m benchmarks time_shares runs/ppo_mpl_lift-and-hold_layout2_main_s0
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.command import count, parser, write
from benchmarks.timing import Watches
from tactilerl.algos.mpi import Communicator
from tactilerl.runs import checkpoint
from tactilerl.runs.run_dir import RunDir
from tactilerl.runs.training import make_algorithm


def shares(run: Path, verdict: str, rounds: int) -> dict[str, float]:
    """Share of the time by what was done, and steps per second, with one environment."""
    run_dir = RunDir(run)
    saved, _ = run_dir.read_config()
    config = dataclasses.replace(
        saved,
        run=dataclasses.replace(saved.run, workers=1),
        scene=saved.scene and dataclasses.replace(saved.scene, hold_verdict=verdict),
    )
    learner, workers = make_algorithm(config, Communicator())
    state = checkpoint.read(run_dir, saved)["ranks"][0]
    learner.load_state_dict(state)
    watches, steps = Watches(), learner.env_steps
    simulator: Any = workers.env.unwrapped.simulator  # type: ignore[attr-defined]
    watches.watch("physics", simulator, "step")
    watches.watch("resets", simulator, "reset")
    watches.watch("hold tests", workers.env.unwrapped, "_hold")
    watches.watch("collecting", learner, "collect")
    watches.watch("updates", learner, "update")
    started = time.perf_counter()
    for _ in range(rounds):
        learner.collect()
        learner.update()
    seconds = time.perf_counter() - started
    workers.close()
    s = watches.seconds
    physics = s["physics"] - s["hold tests"]  # a hold test is nearly all physics
    parts = {
        "hold tests": s["hold tests"],
        "physics of the actions": physics,
        "resets": s["resets"],
        "rest of the environment and acting": s["collecting"] - s["hold tests"] - physics - s["resets"],
        "updates": s["updates"],
    }
    result = {name: part / seconds for name, part in parts.items()}
    return result | {"steps_per_s": (learner.env_steps - steps) / seconds}


def main() -> None:
    """Print the shares, or write them."""
    flags = parser(__doc__)
    flags.add_argument("run", type=Path)
    flags.add_argument("--hold-verdict", choices=("full", "settled"), default="full")
    flags.add_argument("--rounds", type=count, default=1)
    options = flags.parse_args()
    result = shares(options.run, options.hold_verdict, options.rounds)
    table = Table("", "share of the time", title=f"{options.run}, hold verdict {options.hold_verdict}")
    for name, share in result.items():
        table.add_row(name.replace("_per_s", " per second"), f"{share:.3g}")
    Console().print(table)
    write(options.out, result)
