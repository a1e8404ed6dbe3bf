"""Whole episodes from several environments: what every learner here learns from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from . import Array, DivergenceError, EnvPool, Transition, action_bounds
from .mpi import Communicator

Obs = TypeVar("Obs")
FAULTS = ("diverged", "warnings")  # what `info` may say of a step, and is counted
VOID_LIMIT = 100  # episodes that diverge at their first step before something must be wrong


@dataclass
class Episode(Generic[Obs]):
    """One episode as it was lived; the observations include the last."""

    obs: list[Obs]
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    success: float = math.nan
    """1 or 0 at the end; nan where the environment does not say."""


class Rollouts(Generic[Obs]):
    """Plays episodes in a pool of environments.

    Actions are in units of the policy, where the bounds are ±1. `read` makes the learner's
    view of what an environment returns, always a copy: an environment may reuse its buffer.
    """

    def __init__(self, pool: EnvPool, read: Callable[[Any], Obs], rng: np.random.Generator) -> None:
        self.pool, self.read, self.rng = pool, read, rng
        self.faults = dict.fromkeys(FAULTS, 0)
        """How many in the last call of `play`; a step that diverged is void."""
        self._low, self._high = action_bounds(pool.action_space)
        self.n_actions = int(np.prod(self._low.shape))

    def to_env(self, actions: Array) -> Array:
        """Policy units to the environment's: [-1, 1] to [low, high], clipped."""
        half = (self._high - self._low) / 2
        actions = actions.reshape(-1, *self._low.shape)
        return self._low + half * (np.clip(actions, -1.0, 1.0) + 1.0)

    def play(
        self, policy: Callable[[list[Obs]], Array], *, steps: int = 0, episodes: int = 0
    ) -> list[Episode[Obs]]:
        """Whole episodes: `episodes` of them, or until `steps` have begun.

        `policy` gives actions (n, d) for a list of n observations. An environment whose
        episode ends starts another only while something is missing, so what comes out does
        not depend on how fast the environments are. An episode whose first step diverged is
        played again. Raises DivergenceError when that happens `VOID_LIMIT` times, or when an
        observation or a reward is not finite.
        """
        played: list[Episode[Obs]] = []
        running: dict[int, Episode[Obs]] = {}
        self.faults = dict.fromkeys(FAULTS, 0)
        steps_begun = episodes_begun = n_void = 0
        while True:
            idle = [index for index in range(len(self.pool)) if index not in running]
            if steps_begun >= steps:
                idle = idle[: max(0, episodes - episodes_begun)]
            running |= self._begin(idle)
            episodes_begun += len(idle)
            if not running:
                return played
            indices = list(running)
            actions = policy([running[i].obs[-1] for i in indices])
            steps_begun += len(indices)
            results = self.pool.step(indices, self.to_env(actions))
            for index, action, result in zip(indices, actions, results, strict=True):
                if self._record(running[index], action, result):
                    episode = running.pop(index)
                    if episode.rewards:
                        played.append(episode)
                    else:  # diverged at its first step: play another
                        steps_begun, episodes_begun = steps_begun - 1, episodes_begun - 1
                        n_void += 1
                if n_void == VOID_LIMIT:
                    raise DivergenceError(f"{n_void} episodes diverged at their first step")

    def _begin(self, indices: list[int]) -> dict[int, Episode[Obs]]:
        """New episodes of the environments `indices`."""
        seeds = self.rng.integers(2**31, size=len(indices)).tolist()
        first = map(self.read, self.pool.reset(indices, seeds))
        return {
            i: Episode([finite(obs, "an observation")]) for i, obs in zip(indices, first, strict=True)
        }

    def _record(self, episode: Episode[Obs], action: Array, result: Transition) -> bool:
        """Add one transition; has the episode ended? A diverged step is void, not learned from."""
        for fault in FAULTS:
            self.faults[fault] += int(result.info.get(fault, 0))
        if result.info.get("diverged"):
            return True
        episode.obs.append(finite(self.read(result.obs), "an observation"))
        episode.actions.append(action)
        episode.rewards.append(float(finite(result.reward, "a reward")))
        episode.terminated = result.terminated
        episode.success = float(result.info.get("is_success", math.nan))
        return result.terminated or result.truncated


def summary(
    episodes: list[Episode[Any]], faults: dict[str, int], comm: Communicator
) -> dict[str, float]:
    """Counts and means over the episodes of all ranks; each has some."""
    sums = comm.sum(
        np.array(
            [
                sum(len(e.rewards) for e in episodes),
                len(episodes),
                sum(e.success for e in episodes),
                sum(sum(e.rewards) for e in episodes),
                *faults.values(),
            ],
            dtype=np.float64,
        )
    )
    return {
        "steps": sums[0],
        "episodes": sums[1],
        "success_rate": sums[2] / sums[1],
        "mean_return": sums[3] / sums[1],
        "mean_length": sums[0] / sums[1],
        **dict(zip(faults, sums[4:], strict=True)),
    }


def finite(values: Any, what: str) -> Any:
    """`values`, an array or a tuple of arrays; DivergenceError unless all are finite."""
    parts = values if isinstance(values, tuple) else (values,)
    if not all(np.isfinite(part).all() for part in parts):
        raise DivergenceError(f"{what} of the environment is not finite")
    return values
