"""How fast should DDPG+HER's target networks follow in long episodes? Four ways to move them.

    nice python -m benchmarks targets --out docs/data/targets.json

A pilot. The target networks move once per cycle, and in long episodes a cycle has many updates.
Contenders are the recipe `steady`, which keeps 0.9 per cycle; 0.44, which is the paper's 0.95 per
update in the cycles of 16 updates that the recipe was made for; 0.9 per 16 updates, with moves inside
the cycle; and targets that are copied once per cycle. Tasks: three mazes of Gymnasium-Robotics with a
reward of 1 at the goal (episodes of 300 steps, 24,000 to 30,000 steps of training, hidden layers of 64,
updates in proportion: 240 per cycle), and reach-goal of the Shadow Hand (episodes of 20 steps, 16,000
of training, 16 updates per cycle), on which the first and third are the same. Seeds 10,000 to 10,004.
What counts is the mean return of 20 starts without exploration, over all looks and at the last one.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import printing
from benchmarks.command import run_contenders
from benchmarks.learners import steady
from benchmarks.learners.steady import STEADY, Task
from benchmarks.peers.contenders import learn
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER

STEADY_PER_16 = "0.9 per 16 updates"
POLYAK = {
    "0.9 per cycle (steady)": 0.9,
    "0.44 per cycle": 0.44,
    STEADY_PER_16: 0.9,
    "copied once per cycle": 0.0,
}
EPISODE, N_BATCHES = 300, 240  # of a maze: steps, and updates per cycle


def _maze(name: str, steps: int) -> Task:
    make = partial(envs.make, f"gymnasium_robotics:PointMaze_{name}-v3", max_episode_steps=EPISODE)
    return Task(make, steps, 3000, {"hidden": (64, 64)})


TASKS = {
    "maze-open": _maze("Open", 24_000),
    "maze-u": _maze("UMaze", 30_000),
    "maze-medium": _maze("Medium", 30_000),
    "shadow": replace(steady.TASKS["shadow"], steps=16_000),
}


def run(name: str, task: str, seed: int) -> dict[str, Any]:
    """One run."""
    n = STEADY.n_batches if task == "shadow" else N_BATCHES
    between = STEADY.n_batches if name == STEADY_PER_16 else n  # two moves of the targets
    config = replace(STEADY, polyak=POLYAK[name], n_batches=between, **TASKS[task].sizes)
    curve, made = steady.Curve(TASKS[task]), TASKS[task].make
    for learner in learn(DDPGHER, config, made, seed, TASKS[task].steps, n // between):
        curve.look(learner.env_steps, learner.policy().act)
    return {"steps": curve.steps, "returns": curve.returns}


def markdown(content: dict[str, Any]) -> None:
    """What `main` wrote, for the docs: mean returns of each contender in each task."""
    rows = []
    for name in POLYAK:
        row = [name]
        for task in TASKS:
            runs = [
                one["returns"]
                for key, one in content["runs"].items()
                if key.startswith(f"{name} {task} ")
            ]
            row.append(
                f"{np.mean(runs):.1f}, {np.mean(runs, axis=0)[-1]:.1f}"
                if runs
                else "the same as steady"
            )
        rows.append(row)
    printing.markdown("| target networks keep | " + " | ".join(TASKS) + " |", rows)


def main() -> None:
    """What is missing of all contenders, tasks and seeds."""
    about = {"steps": {name: task.steps for name, task in TASKS.items()}}
    runs, *_ = run_contenders(__doc__, about, run, [*POLYAK], [*TASKS], first_seed=10_000, jobs=1)
    markdown({"runs": runs})
