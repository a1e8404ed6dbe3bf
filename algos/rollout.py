"""Play whole episodes, which every learner here learns from.

An episode is a pure function of a policy, a key and its number, so episodes can be
played anywhere, in any order, side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from . import Array, Communicator, DivergenceError, EndlessError
from .policy import Policy, finite

FAULTS = ("diverged", "warnings")  # what `info` may say of a step, and is counted
REWARD = "the reward of the environment"
# Steps after which an episode is taken to have no end.
MAX_LENGTH = 20_000
# Episodes in a row without a step, from which nothing can be learned.
MAX_FAILURES = 100
# What episodes are for: each purpose has random numbers of its own, and so has
# learning.
TRAIN, TEST, EVALUATE, PROBE, LEARN = 1, 2, 3, 4, 5
Key = tuple[int, int, int, int]


@dataclass
class Episode:
    """Hold one episode as it was lived; the observations, as a policy reads them, include the last.

    A step that diverged is void: its observation, action and reward are not here.
    """

    obs: list[Any] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    success: float = math.nan
    """Success at the end, 1 or 0; nan where the environment does not say, 0 where it
    could not begin."""
    held: int = 0
    """Steps for which success had stood by the end."""
    faults: dict[str, int] = field(default_factory=lambda: dict.fromkeys(FAULTS, 0))
    info: dict[str, Any] = field(default_factory=dict)
    """The environment's info of the last step."""
    seed: int = 0
    """The seed of its reset."""

    def __len__(self) -> int:
        """Return the number of transitions."""
        return len(self.rewards)


@dataclass(frozen=True)
class PlayEpisode:
    """Play the episode of a number: its start and its noise follow from `key` and the number."""

    policy: Policy
    key: Key
    """(seed, rank, purpose, cycle), which differ wherever episodes should."""
    explores: bool = True

    def __call__(
        self, env: gym.Env[Any, Any], number: int, is_wanted: Callable[[], bool]
    ) -> Episode:
        """Return the episode, cut short when it is not wanted any more; then nobody learns from it.

        One that cannot begin, because the reset raises a FloatingPointError, has no
        step and counts as diverged.

        Raises DivergenceError, which ends the run, when an observation or a reward is
        not finite. A step that `info` calls diverged only ends the episode. Raises
        EndlessError when it does not end.
        """
        policy, rng = self.policy, np.random.default_rng([*self.key, number])
        noise = policy.explore(rng) if self.explores else None
        episode = Episode(seed=int(rng.integers(2**31)))
        try:
            obs, _ = env.reset(seed=episode.seed)
        except FloatingPointError as error:
            episode.faults["diverged"], episode.success = 1, 0.0
            episode.info = {"error": str(error)}
            return episode
        episode.obs.append(policy.read(obs))
        is_done = False
        while not is_done and is_wanted():
            action = policy.choose(episode.obs[-1], noise)
            is_done = _step(env, policy, action, episode)
            if not is_done and len(episode) == MAX_LENGTH:
                raise EndlessError(
                    f"env: found an episode that goes on after {MAX_LENGTH:,} steps, allowed are "
                    "episodes that end: give it a time limit (max_episode_steps)"
                )
        return episode


def _step(
    env: gym.Env[Any, Any], policy: Policy, action: Array, episode: Episode
) -> bool:
    """Take one step and add it to the episode; return whether that has ended."""
    obs, reward, terminated, truncated, info = env.step(policy.to_env(action))
    episode.info = info
    for fault in FAULTS:
        episode.faults[fault] += int(info.get(fault, 0))
    episode.success = float(info.get("is_success", info.get("success", math.nan)))
    episode.held = episode.held + 1 if episode.success == 1.0 else 0
    if info.get("diverged"):
        return True
    episode.obs.append(policy.read(obs))
    episode.actions.append(action)
    episode.rewards.append(finite(float(reward), REWARD))
    episode.terminated = bool(terminated)
    return episode.terminated or bool(truncated)


def summary(
    episodes: list[Episode], comm: Communicator | None = None
) -> dict[str, float]:
    """Return counts and means over episodes, those that diverged included.

    The success rate is that of the episodes whose environment says whether they
    succeeded, and of those that could not begin; NaN where there are none. With `comm`,
    all is over the episodes of all ranks, each of which has some.
    """
    known = [e.success for e in episodes if not math.isnan(e.success)]
    counts = [sum(map(len, episodes)), len(episodes), len(known), sum(known)]
    counts += [sum(sum(e.rewards) for e in episodes)]
    counts += [sum(e.faults[fault] for e in episodes) for fault in FAULTS]
    sums = (comm or Communicator()).sum(np.array(counts, np.float64))
    steps, n, n_known, successes, returns, *faults = sums.tolist()
    return {
        "steps": steps,
        "episodes": n,
        "success_rate": successes / n_known if n_known else math.nan,
        "mean_return": returns / n,
        "mean_length": steps / n,
        **dict(zip(FAULTS, faults, strict=True)),
    }


def discounted(values: Sequence[float], factor: float) -> list[float]:
    """Return, for each of the values (n,), the discounted sum of it and all that follow."""
    sums, total = [0.0] * len(values), 0.0
    for i in reversed(range(len(values))):
        total = values[i] + factor * total
        sums[i] = total
    return sums


def largest_return(rewards: Sequence[float], gamma: float) -> float:
    """Return the largest discounted return, without its sign, from any step to the episode's end."""
    return max([0.0, *map(abs, discounted(rewards, gamma))])


def usable(episodes: list[Episode]) -> list[Episode]:
    """Return the episodes that have transitions.

    DivergenceError when the last `MAX_FAILURES` have none.
    """
    last = episodes[-MAX_FAILURES:]
    if len(last) == MAX_FAILURES and not any(map(len, last)):
        reason = last[-1].info.get("error", "the physics failed")
        raise DivergenceError(
            f"{MAX_FAILURES} episodes in a row diverged at their first step or could not begin "
            f"(the last: {reason})"
        )
    return [episode for episode in episodes if len(episode)]
