"""What runs came to, and how long they took to get there: the tables and curves of docs/results.md.

python -m benchmarks learning ppo_shadow runs/a runs/b runs/c --episodes 100

Steps and minutes are counted until the success rate (of the test episodes where there are some, else
of at least the last 100 training episodes) is 0.9 for the first time. Minutes are those of collecting,
updating and testing. The progress tables and the figures go to docs/data, under the name that is given.
"""

from __future__ import annotations

import argparse
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks import printing
from benchmarks.command import DATA, count, write
from benchmarks.figures import curve
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
    speeds = pd.read_csv(run / "progress.csv").steps_per_s.to_numpy()
    seconds = np.diff(steps, prepend=0.0) / speeds
    reached = next((i for i, rate in enumerate(rates) if rate >= ENOUGH), None)
    return {
        "seed": config.run.seed,
        "run_type": config.scene.run_type if config.scene else "",
        "epochs": epoch,
        "env_steps": env_steps,
        "minutes": float(seconds.sum()) / 60,
        "first": float(rates[0]),
        "last": float(rates[-1]),
        "steps_to_enough": None if reached is None else int(steps[reached]),
        "minutes_to_enough": None if reached is None else float(seconds[: reached + 1].sum()) / 60,
        "success_rate": result["success_rate"],
        "success_rate_ci": result["success_rate_ci"],
    }


def cells(run: dict[str, Any], *more: str, to: str) -> tuple[str, ...]:
    """Of a run: what it is, its steps and minutes, then `more`, then its evaluation."""
    evaluated = printing.interval(run["success_rate"], *run["success_rate_ci"], to=to)
    name = f"{run['run_type']}, seed {run['seed']}"
    return name, f"{run['env_steps']:,}", f"{run['minutes']:.1f}", *more, evaluated


def show(name: str, runs: list[dict[str, Any]], episodes: int) -> None:
    """One row a run."""
    rows = []
    for run in runs:
        enough = "–"
        if run["steps_to_enough"] is not None:
            enough = f"{run['steps_to_enough']:,} steps, {run['minutes_to_enough']:.1f} min"
        rows.append(cells(run, f"{run['first']:.2f}, {run['last']:.2f}", enough, to="–"))
    columns = ("run", "steps", "minutes", "first, last rate", "0.9 after", "evaluation (95 %)")
    printing.show(f"{name}: evaluation of {episodes} episodes, full hold", columns, rows)


def markdown(content: dict[str, Any]) -> None:
    """What `main` wrote, for the docs."""
    head = f"| run | steps | minutes | last rate | {content['episodes']} evaluation episodes (95 %) |"
    rows = [cells(run, f"{run['last']:.2f}", to=" – ") for run in content["runs"]]
    printing.markdown(head, rows)


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
        kept = DATA / f"{options.name}_{figures['run_type']}_s{figures['seed']}.csv"
        shutil.copyfile(run / "progress.csv", kept)
    content = {"episodes": options.episodes, "runs": found}
    write(DATA / f"{options.name}.json", content)
