"""What runs came to, and how long they took to get there: the tables and curves of docs/results.md.

python -m benchmarks learning ppo_shadow runs/a runs/b runs/c --episodes 100

Steps and minutes are counted until the success rate (of the test episodes where there are some, else
of at least the last 100 training episodes) is 0.9 for the first time. Minutes are those of collecting,
updating and testing. The progress tables and the figures go to docs/data, under the name that is given.
"""

from __future__ import annotations

import argparse
import csv
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.command import count, write
from benchmarks.figures import DOCS, curve
from tactilerl.algos.mpi import Communicator
from tactilerl.runs import evaluation
from tactilerl.runs.policies import read_run
from tactilerl.runs.training import start_workers

ENOUGH = 0.9


def examined(run: Path, episodes: int) -> dict[str, Any]:
    """The figures of one run folder."""
    config, policy, epoch, env_steps = read_run(run)
    with closing(start_workers(config, Communicator(), None)) as workers:
        played = workers.play(evaluation.task(policy), range(episodes))
        rows = [evaluation.row(episode) for episode in played]
    result = evaluation.summarise(rows)
    steps, rates = curve(run / "progress.csv")
    with (run / "progress.csv").open(newline="") as file:
        speeds = np.array([float(row["steps_per_s"]) for row in csv.DictReader(file)])
    seconds = (np.diff(steps, prepend=0.0) / speeds).tolist()
    reached = next((i for i, rate in enumerate(rates) if rate >= ENOUGH), None)
    return {
        "seed": config.run.seed,
        "run_type": config.scene.run_type if config.scene else "",
        "epochs": epoch,
        "env_steps": env_steps,
        "minutes": sum(seconds) / 60,
        "first": float(rates[0]),
        "last": float(rates[-1]),
        "steps_to_enough": None if reached is None else int(steps[reached]),
        "minutes_to_enough": None if reached is None else sum(seconds[: reached + 1]) / 60,
        "success_rate": result["success_rate"],
        "success_rate_ci": result["success_rate_ci"],
    }


def show(name: str, runs: list[dict[str, Any]], episodes: int) -> None:
    """One row a run."""
    table = Table(title=f"{name}: evaluation of {episodes} episodes, full hold")
    for column in ("run", "steps", "minutes", "first, last rate", "0.9 after", "evaluation (95 %)"):
        table.add_column(column)
    for run in runs:
        low, high = run["success_rate_ci"]
        enough = "–"
        if run["steps_to_enough"] is not None:
            enough = f"{run['steps_to_enough']:,} steps, {run['minutes_to_enough']:.1f} min"
        table.add_row(
            f"{run['run_type']}, seed {run['seed']}", f"{run['env_steps']:,}", f"{run['minutes']:.1f}",
            f"{run['first']:.2f}, {run['last']:.2f}", enough,
            f"{run['success_rate']:.2f} ({low:.2f}–{high:.2f})",
        )  # fmt: skip
    Console().print(table)


def markdown(content: dict[str, Any]) -> None:
    """What `main` wrote, for the docs."""
    print(f"| run | steps | minutes | last rate | {content['episodes']} evaluation episodes (95 %) |")
    print("|---|---|---|---|---|")
    for run in content["runs"]:
        low, high = run["success_rate_ci"]
        cells = (
            f"{run['run_type']}, seed {run['seed']}", f"{run['env_steps']:,}", f"{run['minutes']:.1f}",
            f"{run['last']:.2f}", f"{run['success_rate']:.2f} ({low:.2f} – {high:.2f})",
        )  # fmt: skip
        print(f"| {' | '.join(cells)} |")


def main() -> None:
    """Read the flags, print the table, keep what it was made of."""
    flags = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    flags.add_argument("name", help="of the files in docs/data")
    flags.add_argument("runs", nargs="+", type=Path, help="run folders")
    flags.add_argument("--episodes", type=count, default=100, help="of the evaluation")
    options = flags.parse_args()
    found = [examined(run, options.episodes) for run in options.runs]
    show(options.name, found, options.episodes)
    for run, figures in zip(options.runs, found, strict=True):
        kept = DOCS / "data" / f"{options.name}_{figures['run_type']}_s{figures['seed']}.csv"
        shutil.copyfile(run / "progress.csv", kept)
    content = {"episodes": options.episodes, "runs": found}
    write(DOCS / "data" / f"{options.name}.json", content)
