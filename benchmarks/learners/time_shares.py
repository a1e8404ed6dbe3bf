"""Where does the time of a run go? Some rounds of its newest policy collecting and learning.

PPO's rounds are epochs, DDPG+HER's are cycles:

    python -m benchmarks time_shares runs/ppo_mpl_lift-and-hold_layout2_main_s0
"""

from __future__ import annotations

import dataclasses
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from benchmarks.command import count, parser, write
from benchmarks.printing import show
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
    learner.load_state_dict(checkpoint.read(run_dir, saved)["ranks"][0])
    env: Any = workers.env.unwrapped
    watches = Watches(
        physics=(env.simulator, "step"), resets=(env.simulator, "reset"), holds=(env, "_hold"),
        collecting=(learner, "collect"), updates=(learner, "update"),
    )  # fmt: skip
    steps, started = learner.env_steps, time.perf_counter()
    with closing(workers):
        for _ in range(rounds):
            learner.collect()
            learner.update()
    seconds = time.perf_counter() - started
    physics, resets, holds, collecting, updates = watches.seconds.values()
    parts = {
        "hold tests": holds,
        "physics of the actions": physics - holds,  # a hold test is nearly all physics
        "resets": resets,
        "rest of the environment and acting": collecting - physics - resets,
        "updates": updates,
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
    rows = [(name.replace("_per_s", " per second"), f"{share:.3g}") for name, share in result.items()]
    show(f"{options.run}, hold verdict {options.hold_verdict}", ("", "share of the time"), rows)
    write(options.out, result)
