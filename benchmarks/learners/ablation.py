"""Which choices make PPO a steady learner? The recipe without each of them, the paper's values, a peer.

Five Gymnasium control tasks, 30,000 steps, five seeds. What counts is the return of the policy
that a run ends with, without exploration. Every run is written as soon as it ends, and a second
call goes on from there:

    python -m benchmarks ablation --jobs 2 --out docs/data/ablation.json
"""

from __future__ import annotations

import time
import warnings
from contextlib import closing
from dataclasses import asdict, replace
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.command import count, parser, run_missing, write
from benchmarks.peers.solve import Act, play
from tactilerl import envs, statistics
from tactilerl.algos import recipes
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector

STEPS = 30_000
SEEDS = 5
EPISODES = 20  # of the evaluation
TASKS = (
    "Pendulum-v1",
    "Reacher-v5",
    "InvertedDoublePendulum-v5",
    "HalfCheetah-v5",
    "Hopper-v5",
)
PAPER = PPOConfig()
STEADY = recipes.recipe("ppo", "steady")
PEERS = ("stable-baselines3", "stable-baselines3, its defaults")


def without(*names: str) -> PPOConfig:
    """The recipe with the paper's values of some fields."""
    return replace(STEADY, **{name: getattr(PAPER, name) for name in names})


VARIANTS = {
    "paper": PAPER,
    "steady": STEADY,
    "steady, fixed variance": without("exploration"),
    "steady, uniform start": without("orthogonal_init"),
    "steady, raw observations": without("normalise_obs"),
    "steady, no target KL": without("target_kl"),
    "steady, critic steps 1e-3": without("critic_lr"),
    "steady, 6 minibatches": without("minibatch_size"),
    "steady, 80 passes": without("n_passes"),
}


def ours(config: PPOConfig, task: str, seed: int) -> Act:
    """What acts after STEPS."""
    with closing(vector.start(lambda: gym.make(task))) as workers:
        learner = PPO(config, workers, Communicator(), seed, STEPS)
        while learner.env_steps < STEPS:
            learner.collect()
            learner.update()
    return learner.policy().act


def as_theirs(config: PPOConfig) -> dict[str, Any]:
    """Our layers, step size, batch, passes, discounts and clipping, as Stable-Baselines3's PPO calls
    them; the rest stays its own default."""
    names = ("gamma", "gae_lambda", "clip_range", "max_grad_norm")
    return {
        **{name: getattr(config, name) for name in names},
        "learning_rate": config.actor_lr,
        "n_steps": config.steps_per_epoch,
        "batch_size": config.minibatch_size,
        "n_epochs": config.n_passes,
        "policy_kwargs": {"net_arch": list(config.hidden)},
    }


def theirs(settings: dict[str, Any], task: str, seed: int) -> Act:
    """The same of Stable-Baselines3's PPO."""
    model = sb3.PPO("MlpPolicy", gym.make(task), seed=seed, device="cpu", **settings)
    model.learn(STEPS)
    return lambda obs: model.predict(obs, deterministic=True)[0]


def run(name: str, task: str, seed: int) -> dict[str, float]:
    """One run."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    started = time.perf_counter()
    if name in PEERS:
        act = theirs(as_theirs(STEADY) if name == PEERS[0] else {}, task, seed)
    else:
        act = ours(VARIANTS[name], task, seed)
    seconds = time.perf_counter() - started
    returns = [total for total, _ in play(envs.make(task), act, EPISODES)]
    return {"return": float(np.mean(returns)), "seconds": seconds}


def summary(runs: dict[str, dict[str, float]], seeds: range) -> dict[str, Any]:
    """Interquartile mean return of each contender on each task, with its interval and the cost."""
    rng, table = np.random.default_rng(0), {}
    for name in (*VARIANTS, *PEERS):
        for task in TASKS:
            found = [runs[key] for seed in seeds if (key := f"{name} {task} {seed}") in runs]
            if not found:
                continue
            returns = np.array([row["return"] for row in found])
            counts = statistics.resample(rng, len(found))
            estimate = statistics.estimate(returns, "iqm", counts)
            table.setdefault(name, {})[task] = {
                "runs": len(found),
                "return": list(estimate),
                "seconds": float(np.median([row["seconds"] for row in found])),
            }
    return table


def show(table: dict[str, Any]) -> None:
    """Contenders in rows, tasks in columns."""
    shown = Table("", *TASKS, "s", title="return after 30,000 steps: IQM and 95 % interval")
    for name, row in table.items():
        cells = [
            "{:,.1f} ({:,.1f} to {:,.1f})".format(*row[t]["return"]) if t in row else "" for t in TASKS
        ]
        seconds = np.median([cell["seconds"] for cell in row.values()])
        shown.add_row(name, *cells, f"{seconds:.0f}")
    Console(width=200).print(shown)


def markdown(content: dict[str, Any]) -> None:
    """The tasks that all contenders have done, for the docs."""
    table = content["table"]
    tasks = [task for task in TASKS if all(task in row for row in table.values())]
    print("| |", *(f"{task.rpartition('-')[0]} |" for task in tasks), "s |")
    print("|---" * (len(tasks) + 2) + "|")
    for name, row in table.items():
        cells = ("{} ({} to {})".format(*map(_short, row[task]["return"])) for task in tasks)
        seconds = np.median([row[task]["seconds"] for task in tasks])
        print(f"| {name.replace('stable-b', 'Stable-B')} | {' | '.join(cells)} | {seconds:.0f} |")


def _short(value: float) -> str:
    return f"{value:,.{0 if abs(value) >= 100 else 1}f}".replace("-", "−")


def main() -> None:
    """What is missing of all contenders, tasks and seeds; seeds outermost."""
    flags = parser(__doc__)
    flags.add_argument("--jobs", type=count, default=2)
    flags.add_argument("--seeds", type=count, default=SEEDS)
    flags.add_argument("--first-seed", type=int, default=0, help="10000 and more for pilots")
    contenders = [*VARIANTS, *PEERS]
    flags.add_argument("--only", nargs="+", choices=contenders, default=contenders, metavar="NAME")
    flags.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, metavar="TASK")
    options = flags.parse_args()
    configs = {name: asdict(config) for name, config in VARIANTS.items()}
    about = {"steps": STEPS, "configs": configs}
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    places = [(name, task, s) for s in seeds for task in options.tasks for name in options.only]
    runs = run_missing(options.out, about, places, run, options.jobs)
    table = summary(runs, seeds)
    show(table)
    write(options.out, {**about, "table": table, "runs": runs})
