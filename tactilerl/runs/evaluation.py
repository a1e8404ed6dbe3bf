"""Evaluate a trained run: play episodes without exploration noise, record and summarise them."""

from __future__ import annotations

import codecs
import copy
import csv
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from .. import statistics
from ..algos.policy import Policy, Spaces
from ..algos.rollout import EVALUATE, FAULTS, Episode, PlayEpisode
from ..envs.grasp import GraspEnv
from ..envs.plugins import require_array
from ..errors import InputError
from ..files import replacing, require_new

EpisodeCount = Annotated[int, "[1, 100000]"]
N_RESAMPLES = 9_999
SEED = 10_000_000  # evaluation starts are not those of training


class OthersPolicy:
    """Play a policy of another library.

    It is a function of an observation, or an object with `predict`, as those of
    Stable-Baselines3. Actions are as the environment takes them.
    """

    def __init__(self, policy: Any, spaces: Spaces, stochastic: bool) -> None:
        """Ask `predict` for actions without noise, unless `stochastic`, where it can be asked.

        Raises ValueError where `policy` is neither.
        """
        self.choose_for: Callable[..., Any] = getattr(policy, "predict", policy)
        if not callable(self.choose_for):
            raise ValueError(
                f"policy: found {type(policy).__name__}, allowed what load_policy returns, a learner, "
                "a function of an observation, or an object with predict"
            )
        if "deterministic" in inspect.signature(self.choose_for).parameters:
            self.choose_for = partial(self.choose_for, deterministic=not stochastic)
        self.shape = spaces.action.shape or ()

    def explore(self, rng: np.random.Generator) -> None:
        """Bring no noise: its own is not known here."""

    def read(self, obs: Any) -> Any:
        """Return a copy of an observation."""
        return copy.deepcopy(obs)

    def choose(self, view: Any, noise: None = None) -> Any:
        """Return the action for an observation that `read` returned."""
        action = self.choose_for(view)
        return action[0] if isinstance(action, tuple) else action

    def to_env(self, action: Any) -> np.ndarray:
        """Return an action as an array; ValueError where it has another shape, or is not finite."""
        values = require_array(action, self.shape, "policy: its action")
        if not np.isfinite(values).all():
            raise ValueError(
                f"policy: its action: found {values}"[:100] + ", not finite"
            )
        return values


def task(policy: Any, stochastic: bool = False) -> PlayEpisode:
    """Return what plays episode 0, 1, 2, ... of an evaluation: the same starts for every policy."""
    return PlayEpisode(policy, (SEED, 0, EVALUATE, 0), explores=stochastic)


def row(episode: Episode) -> dict[str, Any]:
    """Return an episode's seed, success at its end, steps held, return, length and faults.

    Success is nan where the environment has none; an episode that diverged has no
    success. `held` is the number of steps for which success had stood by the end.
    """
    return {
        "seed": episode.seed,
        "success": episode.success,
        "held": episode.held,
        "return": sum(episode.rewards),
        "length": len(episode),
        **episode.faults,
    }


def mean_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean of `values` (n,)."""
    rng, n = np.random.default_rng(0), len(values)
    drawn = (rng.integers(n, size=(99, n)) for _ in range(N_RESAMPLES // 99))
    means = [values[numbers].mean(axis=1) for numbers in drawn]
    return statistics.percentile_interval(np.concatenate(means))


def summarise(played: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the success rate and mean return with their intervals, the mean length, and faults."""
    returns = np.array([episode["return"] for episode in played])
    successes = np.array([episode["success"] for episode in played])
    result: dict[str, Any] = {
        "episodes": len(played),
        "mean_return": float(returns.mean()),
        "mean_length": float(np.mean([episode["length"] for episode in played])),
        **{fault: int(sum(episode[fault] for episode in played)) for fault in FAULTS},
    }
    result["mean_return_ci"] = list(mean_interval(returns))
    if not np.isnan(successes).any():
        interval = statistics.wilson_interval(int(successes.sum()), len(played))
        held = np.mean([episode["held"] for episode in played])
        result["success_rate"] = float(successes.mean())
        result["success_rate_ci"] = list(interval)
        result["mean_held_steps"] = float(held)
    return result


def sensed(env: Any) -> dict[str, int]:
    """Return the names of an observation's newest entries, with their indices.

    InputError where the environment is not one of a hand, whose sensors have names.
    """
    if not isinstance(env, GraspEnv):
        raise InputError(
            f"env: found {env}, allowed runs of hands: no sensor has a name here"
        )
    named = enumerate(env.observation_names())
    return {name: index for index, name in named if "(t-" not in name}


@contextmanager
def recorder(
    path: Path | None, overwrite: bool, env: Any, policy: Policy
) -> Iterator[Callable[[int, Episode], None]]:
    """Give a function that adds an episode, with its number, to a new CSV file, if there is one.

    A row has what the policy was told, what it did, and what came of it. The first
    three columns and the last have LeRobot's names. Nothing is written where an error
    occurs inside.
    """
    if path is None:
        yield lambda *_: None
        return
    require_new(path, overwrite, ".csv")
    names = sensed(env)
    header = ["episode_index", "frame_index", "timestamp", *names]
    header += [f"action {name}" for name in env.hand.action_names]
    with replacing(path) as file:
        writer = csv.writer(codecs.getwriter("utf-8")(file), lineterminator="\n")
        writer.writerow([*header, "next.reward", "next.done", "next.success"])

        def add(number: int, episode: Episode) -> None:
            for step, reward in enumerate(episode.rewards):
                told = episode.obs[step][[*names.values()]]
                done = policy.to_env(episode.actions[step])
                is_last = step + 1 == len(episode)
                time = round(step * env.config.control_dt, 6)
                success = int(is_last and episode.success)
                row = number, step, time, *told, *done, reward, int(is_last), success
                writer.writerow(row)

        yield add
