"""Which choices make PPO a steady learner? The recipe without each of them, the paper's values, a peer.

Five Gymnasium control tasks, 30,000 steps, five seeds. What counts is the return of the policy
that a run ends with, without exploration. Every run is written as soon as it ends, and a second
call goes on from there:

    python -m benchmarks ablation --jobs 2 --out docs/data/ablation.json
"""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
from tactilerl import envs, statistics
from tactilerl.algos import recipes
from tactilerl.algos.ppo import PPO, PPOConfig

from benchmarks.command import run_contenders
from benchmarks.peers.contenders import Act, learn, play
from benchmarks.printing import markdown

STEPS = 30_000
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
    *_, learner = learn(PPO, config, partial(gym.make, task), seed, STEPS)
    return learner.policy().act


def as_theirs(config: PPOConfig) -> dict[str, Any]:
    """Our layers, learning rate, batch, passes, discounts and clipping, as Stable-Baselines3 calls
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
    started = time.perf_counter()
    if name in PEERS:
        act = theirs(as_theirs(STEADY) if name == PEERS[0] else {}, task, seed)
    else:
        act = ours(VARIANTS[name], task, seed)
    seconds = time.perf_counter() - started
    returns = [total for total, _ in play(envs.make(task), act, EPISODES)]
    return {"return": float(np.mean(returns)), "seconds": seconds}


def show(content: dict[str, Any]) -> None:
    """Interquartile mean returns with intervals, as Markdown: contenders in rows, tasks in columns."""
    rng, found, rows = np.random.default_rng(0), dict[str, dict[int, float]](), []
    for key, row in content["runs"].items():
        place, _, seed = key.rpartition(" ")
        found.setdefault(place, {})[int(seed)] = row["return"]
    tasks = [task for task in TASKS if any(place.endswith(f" {task}") for place in found)]
    for name in (*VARIANTS, *PEERS):
        cells = [_cell(rng, found.get(f"{name} {task}", {})) for task in tasks]
        if any(cells):
            rows.append((name.replace("stable-b", "Stable-B"), *cells))
    markdown(f"| | {' | '.join(task.rpartition('-')[0] for task in tasks)} |", rows)


def _cell(rng: np.random.Generator, by_seed: dict[int, float]) -> str:
    if not by_seed:
        return ""
    returns = np.array([by_seed[seed] for seed in sorted(by_seed)])
    found = statistics.estimate(returns, "iqm", statistics.resample(rng, len(returns)))
    shown = (f"{x:,.{0 if abs(x) >= 100 else 1}f}".replace("-", "−") for x in found)
    return "{} ({} to {})".format(*shown)


def main() -> None:
    """What is missing of all contenders, tasks and seeds."""
    configs = {name: asdict(config) for name, config in VARIANTS.items()}
    about, names = {"steps": STEPS, "configs": configs}, [*VARIANTS, *PEERS]
    show(run_contenders(__doc__, about, run, names, TASKS, first_seed=0, jobs=2))
