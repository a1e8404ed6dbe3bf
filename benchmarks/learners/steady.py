"""Does DDPG+HER keep what it learned? The recipe `steady`, the paper's values, and what lies between.

    nice python -m benchmarks steady --out docs/data/steady.json

Fixed before the first run that is reported. Tasks: points to a goal (10,000 steps); reach-goal of the
Shadow Hand and of the MPL hand, both in MuJoCo with layout 2 (36,000 steps); and two tasks of panda-gym
(pip install panda-gym), an arm to a goal by motions of its hand or of its joints (5,000 steps). The toy
and the arm have two hidden layers of 64, and the arm's episodes of 50 steps 40 updates for every two.
Seeds 20 to 29 for the recipe on the Shadow Hand, 20 to 24 for everything else, seeds outermost. Pilots
have seeds of 10,000 and more (--first-seed); lower ones were used up by recipes that were dropped
(docs/data/steady_dropped.json). Every 1,000 or 2,000 steps the policy plays the same 20 starts without
exploration. What counts on the Shadow Hand is the final rate, the mean success over the last tenth of
a run: no seed of the recipe should end below 0.9. On every task the mean return of the last look should
be no lower than Stable-Baselines3's. Besides them the area under the curve. Every run is written as
soon as it ends, and a second call goes on from there.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from tactilerl import envs, statistics
from tactilerl.algos import recipes
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.envs import vector

from benchmarks import printing
from benchmarks.command import run_contenders
from benchmarks.peers.contenders import Act, Looks, learn, play, sb3_ddpg

EPISODES = 20  # of a look
ENOUGH = 0.9
PEER = "stable-baselines3"
PAPER, STEADY = (recipes.recipe("ddpg_her", name) for name in ("paper", "steady"))


@dataclass(frozen=True)
class Task:
    """What is learned, for how long, and how often it is looked at."""

    make: Callable[[], Any]
    steps: int
    every: int
    sizes: dict[str, Any] = field(default_factory=dict)
    """What all contenders have here instead of their own."""


REACH = {"task": "reach-goal", "layout": "2"}
SMALL = {"hidden": (64, 64)}
ARM = {**SMALL, "n_batches": 40}
TASKS = {
    "point-reach": Task(partial(envs.make, "point-reach"), 10_000, 1000, SMALL),
    "shadow": Task(partial(envs.make, "shadow", **REACH), 36_000, 2000),
    "mpl": Task(partial(envs.make, "mpl", simulator="mujoco", **REACH), 36_000, 2000),
    "panda-reach": Task(partial(envs.make, "panda_gym:PandaReach-v3"), 5000, 1000, ARM),
    "panda-joints": Task(partial(envs.make, "panda_gym:PandaReachJoints-v3"), 5000, 1000, ARM),
}
CHOICES = [name for name in asdict(PAPER) if getattr(PAPER, name) != getattr(STEADY, name)]
VARIANTS: dict[str, DDPGHERConfig] = {
    "paper": PAPER,
    "steady": STEADY,
    **{
        f"steady, the paper's {name}": replace(STEADY, **{name: getattr(PAPER, name)})
        for name in CHOICES
    },
}


@dataclass
class Curve:
    """Looks at a policy while it learns."""

    task: Task
    steps: list[int] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    """Mean over the episodes of each look."""
    is_solved = False  # it goes on to the end

    def look(self, steps: int, act: Act) -> bool:
        """Called between updates; plays every `task.every` steps."""
        if steps // self.task.every > (self.steps[-1] if self.steps else 0) // self.task.every:
            with closing(self.task.make()) as env:
                returns, successes = zip(*play(env, act, EPISODES), strict=True)
            self.steps.append(steps)
            self.rates.append(float(np.mean(successes)))
            self.returns.append(float(np.mean(returns)))
        return False


def ours(config: DDPGHERConfig, task: Task, seed: int) -> Curve:
    """Our learner, to the end."""
    curve = Curve(task)
    for learner in learn(DDPGHER, replace(config, **task.sizes), task.make, seed, task.steps):
        curve.look(learner.env_steps, learner.policy().act)
    return curve


def theirs(config: DDPGHERConfig, task: Task, seed: int) -> Curve:
    """Stable-Baselines3's DDPG with its HER buffer, with our sizes."""
    looks = Looks(partial(Curve, task))
    with closing(vector.start(task.make)) as workers:
        config, max_steps = replace(config, **task.sizes), workers.max_episode_steps
        sb3_ddpg(workers.env, seed, config, max_steps).learn(task.steps, callback=looks)
    curve: Curve = looks.run
    return curve


def run(name: str, task: str, seed: int) -> dict[str, Any]:
    """One run."""
    started = time.process_time()
    learn = partial(theirs, STEADY) if name == PEER else partial(ours, VARIANTS[name])
    curve = learn(TASKS[task], seed)
    return {
        "steps": curve.steps,
        "rates": curve.rates,
        "return": curve.returns[-1],
        "cpu_seconds": time.process_time() - started,
    }


def row(task: str, name: str, runs: list[dict[str, Any]]) -> tuple[Any, ...]:
    """Of a contender's runs of a task."""
    rates = np.array([run["rates"] for run in runs])
    finals = np.sort(statistics.final_rate(rates))
    areas = statistics.area_under_curve(np.array(runs[0]["steps"], float), rates)
    total = f"{np.mean([run['return'] for run in runs]):.1f}".replace("-", "−")
    shown = ", ".join(f"{x:.2f}" for x in finals)
    return task, name, len(runs), shown, (finals < ENOUGH).sum(), f"{areas.mean():.2f}", total


def markdown(content: dict[str, Any]) -> None:
    """What `main` wrote, for the docs: a row for each task and contender."""
    rows = []
    for task, name in itertools.product(TASKS, (*VARIANTS, PEER)):
        own = f"{name} {task} "
        if runs := [run for key, run in content["runs"].items() if key.startswith(own)]:
            rows.append(row(task, name, runs))
    head = "| task | contender | runs | final rates, sorted | below 0.9 | area | return at the end |"
    printing.markdown(head, rows)


def main() -> None:
    """What is missing of all contenders, tasks and seeds."""
    about = {
        "steps": {name: task.steps for name, task in TASKS.items()},
        "configs": {name: asdict(config) for name, config in VARIANTS.items()},
    }
    names = [*VARIANTS, PEER]
    markdown(run_contenders(__doc__, about, run, names, [*TASKS], first_seed=20, jobs=1))
