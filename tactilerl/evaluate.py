"""How good is a trained run? Episodes without exploration noise, and how sure one can be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from . import algos, checkpoint
from .algos.mpi import Communicator
from .algos.rollout import FAULTS
from .config import RunConfig
from .envs import vector
from .run_dir import RunDir
from .train import make_algorithm

SEED = 10_000_000  # evaluation starts are not those of training
CONFIDENCE = 0.95


def load_policy(
    path: Path, env: str = "", trust: bool = False
) -> tuple[RunConfig, algos.Algorithm, int]:
    """(configuration, learner, epoch) of a run folder, on the CPU, with the full hold test; for
    `env` and `trust` see `RunDir.read_config`."""
    run_dir = RunDir(path)
    saved, _ = run_dir.read_config(env, trust)
    run = dataclasses.replace(saved.run, num_envs=1, device="cpu")
    scene = saved.scene and dataclasses.replace(saved.scene, hold_verdict="full")
    config = dataclasses.replace(saved, run=run, scene=scene)
    learner, pool, epoch = restore(run_dir, saved, config)
    pool.close()
    return config, learner, epoch


def restore(
    run_dir: RunDir, saved: RunConfig, config: RunConfig
) -> tuple[algos.Algorithm, vector.Envs, int]:
    """(learner, its environments, epoch) of the run `saved`, under a configuration that differs
    only where the learner's state does not depend on it."""
    data = checkpoint.read(run_dir, saved)
    learner, pool = make_algorithm(config, Communicator())
    try:
        checkpoint.load_state(learner, data["ranks"][0], run_dir.checkpoint_file)
    except BaseException:
        pool.close()
        raise
    return learner, pool, int(data["epoch"])


def episodes(
    config: RunConfig, learner: algos.Algorithm, n: int, stochastic: bool = False
) -> Iterator[dict[str, float]]:
    """Play `n` episodes in an environment of their own; see `play`."""
    with closing(config.make_env()) as env:
        yield from play(env, learner, n, stochastic)


def play(
    env: Any, learner: algos.Algorithm, n: int, stochastic: bool = False
) -> Iterator[dict[str, float]]:
    """Success at the end of each episode (nan where the environment has none), for how many
    steps it stood by then, return, length and faults; one that diverged has no success."""
    for index in range(n):
        obs, _ = env.reset(seed=SEED + index)
        total, length, held, done, info = 0.0, 0, 0, False, {}
        faults = dict.fromkeys(FAULTS, 0)
        while not done:
            action = learner.act(obs, deterministic=not stochastic)
            obs, reward, terminated, truncated, info = env.step(action)
            total, length, done = total + float(reward), length + 1, terminated or truncated
            held = held + 1 if info.get("is_success") else 0
            for fault in FAULTS:
                faults[fault] += int(info.get(fault, 0))
        success = float(info.get("is_success", math.nan))
        yield {"success": success, "held": held, "return": total, "length": length, **faults}


def mean_interval(values: np.ndarray, resamples: int = 9_999, seed: int = 0) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean of `values` (n,), not all alike."""
    from scipy import stats  # takes a while

    found = stats.bootstrap(
        (values,), np.mean, n_resamples=resamples, confidence_level=CONFIDENCE,
        method="percentile", rng=seed,
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)


def summarise(played: list[dict[str, float]]) -> dict[str, Any]:
    """Success rate with its Wilson interval, mean return with a bootstrap interval, faults."""
    from scipy import stats  # takes a while

    returns = np.array([episode["return"] for episode in played])
    successes = np.array([episode["success"] for episode in played])
    result: dict[str, Any] = {
        "episodes": len(played),
        "mean_return": float(returns.mean()),
        "mean_length": float(np.mean([episode["length"] for episode in played])),
        **{fault: int(sum(episode[fault] for episode in played)) for fault in FAULTS},
    }
    if len(played) > 1 and np.ptp(returns) > 0:
        result["mean_return_ci"] = list(mean_interval(returns))
    else:
        result["mean_return_ci"] = [result["mean_return"]] * 2
    if not np.isnan(successes).any():
        count = int(successes.sum())
        test = stats.binomtest(count, len(played))
        interval = test.proportion_ci(CONFIDENCE, method="wilson")
        result["success_rate"] = count / len(played)
        result["success_rate_ci"] = [float(interval.low), float(interval.high)]
        result["mean_held_steps"] = float(np.mean([episode["held"] for episode in played]))
    return result
