"""How fast should DDPG+HER's target networks follow in long episodes? Four ways to move them.

    nice python -m benchmarks targets --out docs/data/targets.json

A pilot. The paper moves the target networks once per cycle, and in long episodes a cycle has many
updates. Contenders are the recipe `steady` as it was up to 0.3.0, which keeps 0.9 of them per cycle;
0.44 per cycle, which is the paper's 0.95 per update in the cycles of 16 updates that the recipe was
made for; 0.9 per 16 updates, with moves inside a cycle; and targets that are copied once per cycle.
Tasks: three mazes of Gymnasium-Robotics with a reward of 1 at the goal (episodes of 300 steps, 24,000
to 30,000 steps of training, hidden layers of 64, updates in proportion: 240 per cycle), and reach-goal
of the Shadow Hand (episodes of 20 steps, 16,000 of training, 16 updates per cycle), on which the first
and third are the same. Seeds 10,000 to 10,004. What counts is the mean return of 20 starts without
exploration, over all looks and at the last one.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from tactilerl import envs

from benchmarks import printing
from benchmarks.command import run_contenders
from benchmarks.learners import steady
from benchmarks.learners.steady import STEADY, Task

WAYS: dict[str, dict[str, Any]] = {
    "0.9 per cycle": {"target_update_interval": None},
    "0.44 per cycle": {"target_update_interval": None, "polyak": 0.44},
    "0.9 per 16 updates": {},
    "copied once per cycle": {"target_update_interval": None, "polyak": 0.0},
}
EPISODE = 300  # steps, in a maze
SIZES = {"hidden": (64, 64), "n_batches": 240}


def _maze(name: str, steps: int) -> Task:
    make = partial(envs.make, f"gymnasium_robotics:PointMaze_{name}-v3", max_episode_steps=EPISODE)
    return Task(make, steps, 3000, SIZES)


TASKS = {
    "maze-open": _maze("Open", 24_000),
    "maze-u": _maze("UMaze", 30_000),
    "maze-medium": _maze("Medium", 30_000),
    "shadow": replace(steady.TASKS["shadow"], steps=16_000),
}


def run(name: str, task: str, seed: int) -> dict[str, Any]:
    """One run."""
    curve = steady.ours(replace(STEADY, **WAYS[name]), TASKS[task], seed)
    return {"steps": curve.steps, "returns": curve.returns}


def markdown(content: dict[str, Any]) -> None:
    """What `main` wrote, for the docs: mean returns of a run; those at its end, lowest to highest."""
    rows: list[list[str]] = []
    for way in WAYS:
        rows.append([way])
        for task in TASKS:
            own = f"{way} {task} "
            returns = [run["returns"] for key, run in content["runs"].items() if key.startswith(own)]
            if not returns:
                rows[-1].append("as the first")
                continue
            last = np.array(returns)[:, -1]
            span = f"{last.mean():.0f} ({last.min():.0f} to {last.max():.0f})"
            rows[-1].append(f"{np.mean(returns):.0f}; {span}".replace("-", "−"))
    printing.markdown("| target networks keep | " + " | ".join(TASKS) + " |", rows)


def main() -> None:
    """What is missing of all contenders, tasks and seeds."""
    about = {"steps": {name: task.steps for name, task in TASKS.items()}}
    markdown(run_contenders(__doc__, about, run, [*WAYS], [*TASKS], first_seed=10_000, jobs=1))
