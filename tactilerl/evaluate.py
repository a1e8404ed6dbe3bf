"""How good is a trained run? Episodes without exploration noise, and how sure one can be."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from . import algos, checkpoint
from .algos.mpi import Communicator
from .algos.policy import Policy
from .algos.rollout import EVALUATE, FAULTS, Episode, PlayEpisode
from .config import RunConfig
from .envs import vector
from .run_dir import RunDir
from .train import make_algorithm

SEED = 10_000_000  # evaluation starts are not those of training
CONFIDENCE = 0.95


class Trained(NamedTuple):
    """What a run has come to."""

    config: RunConfig
    """As it was trained, but on the CPU, in float32 and with the full hold test."""
    policy: Policy
    epoch: int
    env_steps: int


def load_policy(path: Path, env: str = "", trust: bool = False) -> Trained:
    """The policy of a run folder at its last checkpoint; for `env` and `trust` see
    `RunDir.read_config`."""
    run_dir = RunDir(path)
    saved, _ = run_dir.read_config(env, trust)
    run = dataclasses.replace(saved.run, workers=1, device="cpu", matmul="float32")
    scene = saved.scene and dataclasses.replace(saved.scene, hold_verdict="full")
    config = dataclasses.replace(saved, run=run, scene=scene)
    learner, workers, epoch = restore(run_dir, saved, config)
    workers.close()
    return Trained(config, learner.policy(), epoch, learner.env_steps)


def restore(
    run_dir: RunDir, saved: RunConfig, config: RunConfig
) -> tuple[algos.Algorithm, vector.Workers, int]:
    """(learner, its workers, epoch) of the run `saved`, under a configuration that differs only
    where the learner's state does not depend on it."""
    data = checkpoint.read(run_dir, saved)
    learner, workers = make_algorithm(config, Communicator())
    try:
        checkpoint.load_state(learner, data["ranks"][0], run_dir.checkpoint_file)
    except BaseException:
        workers.close()
        raise
    return learner, workers, int(data["epoch"])


def task(policy: Policy, stochastic: bool = False) -> PlayEpisode[Any]:
    """Plays episode 0, 1, 2, ... of an evaluation: the same starts for every policy."""
    return PlayEpisode(policy, (SEED, 0, EVALUATE, 0), explores=stochastic)


def row(episode: Episode[Any]) -> dict[str, float]:
    """Success at the end of an episode (nan where the environment has none), for how many steps
    it had stood by then, return, length and faults; one that diverged has no success."""
    return {
        "success": episode.success,
        "held": episode.held,
        "return": sum(episode.rewards),
        "length": len(episode),
        **episode.faults,
    }


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
