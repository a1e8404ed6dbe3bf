"""How much faster is a trained policy's PPO run than in an earlier version of this library?

A checkout of that version trains for one epoch and is given the networks of a trained run. Then it
and the run itself take turns to go on, an epoch each, with the same number of episodes at a time:

    git worktree add ../first 2287763
    python -m benchmarks versions --checkout ../first --run RUN [RUN ...] --out docs/data/versions.json
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
import torch

from benchmarks.command import ROOT, count, parser, python, write
from benchmarks.printing import show
from tactilerl.runs import checkpoint
from tactilerl.runs.config import RunConfig
from tactilerl.runs.run_dir import RunDir

ROUNDS = 3  # of one epoch
NETWORKS = ("actor", "critic")


def train(checkout: Path, *flags: str) -> None:
    """By the version in a checkout."""
    python("-m", "tactilerl", "train", *flags, checkout=checkout)


def begin(checkout: Path, config: RunConfig, networks: dict[str, Any], cores: int, out: Path) -> None:
    """A run of the earlier version after its first epoch, with networks of a later one."""
    assert config.scene is not None
    flags = {
        "algo": "ppo",
        "env": config.run.env,
        "simulator": config.scene.simulator,
        "layout": config.scene.layout,
        "hold-verdict": "settled",
        "num-envs": cores,
        "total-timesteps": 1,
        "out": out,
    }
    train(checkout, *(f"--{name}={value}" for name, value in flags.items()))
    file = out / "checkpoint.pt"
    saved = torch.load(file, weights_only=True)
    saved["ranks"][0] |= networks
    torch.save(saved, file)


def rate(checkout: Path, run: Path, *flags: str) -> tuple[float, float]:
    """Environment steps per second of the next epoch, and its success rate."""
    before = last_row(run).env_steps
    train(checkout, "--resume", str(run), f"--total-timesteps={int(before) + 1}", *flags)
    after = last_row(run)
    seconds = after.collect_s + after.update_s
    return float((after.env_steps - before) / seconds), float(after.success_rate)


def last_row(run: Path) -> Any:
    """Of the progress table."""
    return pd.read_csv(run / "progress.csv").iloc[-1]


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
    speeds = {name: median(speed for speed, _ in rates) for name, rates in found.items()}
    ratio = speeds["now"] / speeds["first"]
    return {"cores": cores, "rounds": found, "steps_per_s": speeds, "ratio": ratio}


def main() -> None:
    """All runs that are named."""
    flags = parser(__doc__)
    flags.add_argument("--checkout", type=Path, required=True, help="of the earlier version")
    flags.add_argument("--run", type=Path, nargs="+", required=True, help="trained runs of PPO")
    flags.add_argument("--cores", type=count, default=2)
    options = flags.parse_args()
    result = {}
    with tempfile.TemporaryDirectory() as name:
        for run in options.run:
            result[run.name] = compare(options.checkout, run.resolve(), options.cores, Path(name))
            write(options.out, result)
    rows = [
        (name, *(f"{x:.1f}" for x in found["steps_per_s"].values()), f"{found['ratio']:.2f} ×")
        for name, found in result.items()
    ]
    show(None, ("run", "earlier, steps/s", "now, steps/s", "ratio"), rows)
