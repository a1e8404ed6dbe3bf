"""How much faster is a trained policy's PPO run than in an earlier version of this library?

A checkout of that version trains for one epoch and is given the networks of a trained run. Then it
and the run itself take turns to go on, an epoch each, with the same number of episodes at a time:

    git worktree add ../first 2287763
    python -m benchmarks versions --checkout ../first --run RUN [RUN ...] --out docs/data/versions.json
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.command import ROOT, count, parser, write
from tactilerl.runs import checkpoint
from tactilerl.runs.config import RunConfig
from tactilerl.runs.run_dir import RunDir

ROUNDS = 3  # of one epoch
NETWORKS = ("actor", "critic")


def tactilerl(checkout: Path, *args: str) -> None:
    """A command of the version in a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
    command = [sys.executable, "-m", "tactilerl", *args]
    subprocess.run(command, check=True, env=environment, cwd=checkout, stdout=subprocess.DEVNULL)


def begin(checkout: Path, config: RunConfig, networks: dict[str, Any], cores: int, out: Path) -> None:
    """A run of the earlier version after its first epoch, with networks of a later one."""
    scene = config.scene
    assert scene is not None
    flags = {
        "algo": "ppo",
        "env": config.run.env,
        "simulator": scene.simulator,
        "layout": scene.layout,
        "hold-verdict": "settled",
        "num-envs": cores,
        "total-timesteps": 1,
        "out": out,
    }
    tactilerl(checkout, "train", *(f"--{name}={value}" for name, value in flags.items()))
    file = out / "checkpoint.pt"
    saved = torch.load(file, weights_only=True)
    saved["ranks"][0] |= networks
    torch.save(saved, file)


def rate(checkout: Path, run: Path, *flags: str) -> tuple[float, float]:
    """Environment steps per second of the next epoch, and its success rate."""
    before = last_row(run)
    goal = f"--total-timesteps={int(before['env_steps']) + 1}"
    tactilerl(checkout, "train", "--resume", str(run), goal, *flags)
    after = last_row(run)
    steps = int(after["env_steps"]) - int(before["env_steps"])
    return steps / (float(after["collect_s"]) + float(after["update_s"])), float(after["success_rate"])


def last_row(run: Path) -> dict[str, str]:
    """Of the progress table."""
    with (run / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))[-1]


def compare(checkout: Path, run: Path, cores: int, folder: Path) -> dict[str, Any]:
    """Medians of the rounds, and the ratio."""
    config, _ = RunDir(run).read_config()
    state = checkpoint.read(RunDir(run), config)["ranks"][0]
    first, now = folder / f"first_{run.name}", folder / run.name
    begin(checkout, config, {name: state[name] for name in NETWORKS}, cores, first)
    shutil.copytree(run, now)
    found: dict[str, list[tuple[float, float]]] = {"first": [], "now": []}
    for _ in range(ROUNDS):
        found["first"].append(rate(checkout, first))
        found["now"].append(rate(ROOT, now, f"--workers={cores}"))
    medians = {name: sorted(rates)[ROUNDS // 2] for name, rates in found.items()}
    return {
        "cores": cores,
        "rounds": found,
        "steps_per_s": {name: median[0] for name, median in medians.items()},
        "ratio": medians["now"][0] / medians["first"][0],
    }


def main() -> None:
    """All runs that are named."""
    flags = parser(__doc__)
    flags.add_argument("--checkout", type=Path, required=True, help="of the earlier version")
    flags.add_argument("--run", type=Path, nargs="+", required=True, help="trained runs of PPO")
    flags.add_argument("--cores", type=count, default=2)
    options = flags.parse_args()
    table = Table("run", "earlier, steps/s", "now, steps/s", "ratio")
    result = {}
    with tempfile.TemporaryDirectory() as name:
        for run in options.run:
            found = compare(options.checkout, run.resolve(), options.cores, Path(name))
            result[run.name] = found
            table.add_row(
                run.name,
                *(f"{x:.1f}" for x in found["steps_per_s"].values()),
                f"{found['ratio']:.2f} ×",
            )
            write(options.out, result)
    Console().print(table)
