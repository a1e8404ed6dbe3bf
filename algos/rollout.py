"""Whole episodes: what every learner here learns from.

An episode is a pure function of a policy, a key and its number, so episodes can be played
anywhere, in any order, side by side.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np

from . import Array, DivergenceError, UnfitError, Workers
from .mpi import Communicator
from .policy import FLOAT32_MAX, Policy
from .spaces import PRIVILEGED

Obs = TypeVar("Obs")
FAULTS = ("diverged", "warnings")  # what `info` may say of a step, and is counted
LONGEST = 20_000  # steps of an episode that is thought to have an end
MOST_FAILURES = (
    100  # episodes in a row without a step, from which nothing can be learned
)
TRAIN, TEST, EVALUATE, PROBE = (
    1,
    2,
    3,
    4,
)  # what episodes are for: each has random numbers of its own
LEARN = 5  # and so has what learns from them


@dataclass
class Episode(Generic[Obs]):
    """One episode as it was lived; the observations include the last.

    A step that diverged is void: its observation, action and reward are not here.
    """

    obs: list[Obs] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    success: float = math.nan
    """1 or 0 at the end; nan where the environment does not say. 0 where ours diverged."""
    held: int = 0
    """Steps for which success had stood by the end."""
    faults: dict[str, int] = field(default_factory=lambda: dict.fromkeys(FAULTS, 0))
    info: dict[str, Any] = field(default_factory=dict)
    """What the environment said with the last step."""
    privileged: list[Array] = field(default_factory=list)
    """What critics see besides, of every observation; each of no size where there is nothing."""

    def add(self, policy: Policy, obs: Any) -> None:
        """What is kept of the next observation; DivergenceError where it is not finite."""
        self.obs.append(finite(policy.read(obs), "an observation"))
        privileged = obs.get(PRIVILEGED, ()) if isinstance(obs, dict) else ()
        values = np.array(privileged, np.float32).ravel()
        self.privileged.append(finite(values, f"the observation {PRIVILEGED!r}"))

    def __len__(self) -> int:
        """Transitions."""
        return len(self.rewards)


@dataclass(frozen=True)
class PlayEpisode(Generic[Obs]):
    """Plays the episode of a number: its start and its noise follow from `key` and the number, which is
    below 0 for one that only precedes another."""

    policy: Policy
    key: tuple[int, int, int, int]
    """(seed, rank, purpose, batch), which differ wherever episodes should."""
    explores: bool = True

    def __call__(
        self, env: gym.Env[Any, Any], number: int, is_wanted: Callable[[], bool]
    ) -> Episode[Obs]:
        """The episode; cut short when it is not wanted any more. One that cannot begin, because the
        reset raises a FloatingPointError, has no step and counts as diverged.

        Raises DivergenceError when an observation or a reward is not finite, and UnfitError when
        the episode does not end or the environment returns what its spaces do not say.
        """
        policy, rng = self.policy, np.random.default_rng([*self.key, number % 2**64])
        noise = rng if self.explores else None
        episode = Episode[Obs]()
        try:
            first, _ = env.reset(seed=int(rng.integers(2**31)))
        except FloatingPointError as error:
            episode.faults["diverged"], episode.success = 1, 0.0
            episode.info = {"error": str(error)}
            return episode
        episode.add(policy, first)
        is_done = False
        while not is_done and is_wanted():
            action = policy.choose(episode.obs[-1], noise)
            is_done = _step(env, policy, action, episode)
            if not is_done and len(episode) == LONGEST:
                raise UnfitError(
                    f"env: found an episode that goes on after {LONGEST:,} steps, allowed are episodes "
                    "that end: give it a time limit (max_episode_steps)"
                )
        return episode


def _step(
    env: gym.Env[Any, Any], policy: Policy, action: Array, episode: Episode[Any]
) -> bool:
    """Take one step and add it to the episode; has that ended?"""
    obs, reward, terminated, truncated, info = env.step(policy.to_env(action))
    if not isinstance(info, dict):
        raise UnfitError(
            f"env: found {type(info).__name__} for a step's info, allowed a dict"
        )
    episode.info = info
    for fault in FAULTS:
        episode.faults[fault] += int(_number(info.get(fault, 0), f"{fault} in info"))
    success = info.get("is_success", info.get("success"))
    episode.success = (
        math.nan if success is None else _number(success, "is_success in info")
    )
    if episode.success not in (0.0, 1.0) and not math.isnan(episode.success):
        raise UnfitError(
            f"env: found the is_success {episode.success:g}, allowed 0 or 1"
        )
    episode.held = episode.held + 1 if episode.success == 1.0 else 0
    if info.get("diverged"):
        return True
    episode.add(policy, obs)
    episode.actions.append(action)
    episode.rewards.append(finite(_number(reward, "reward"), "a reward"))
    episode.terminated = terminated
    return bool(terminated or truncated)


def _number(value: Any, what: str) -> float:
    """What an environment returns; UnfitError where it is no number."""
    if np.ndim(value) or np.asarray(value).dtype.kind not in "bifu":
        raise UnfitError(f"env: found the {what} {str(value)[:50]}, allowed a number")
    return float(value)


def play_episodes(
    workers: Workers, job: PlayEpisode[Obs], n: int
) -> list[Episode[Obs]]:
    """Episodes 0, 1, 2, ... in order of number until `n` of them have transitions. DivergenceError when
    `MOST_FAILURES` more have none."""
    episodes: list[Episode[Obs]] = []
    while missing := n - sum(len(episode) > 0 for episode in episodes):
        if len(episodes) >= n + MOST_FAILURES:
            require_transitions(episodes[-MOST_FAILURES:])
        episodes += workers.play(job, range(len(episodes), len(episodes) + missing))
    return episodes


def play_steps(
    workers: Workers, job: PlayEpisode[Obs], steps: int, comm: Communicator
) -> list[Episode[Obs]]:
    """Episodes 0, 1, 2, ... in order of number until they have `steps` transitions: the same
    list on every rank, and on any number of ranks.

    An episode that diverged at once counts as a step, so this ends.
    """
    if comm.size == 1:
        return _first(workers.play(job, itertools.count()), steps)
    episodes: list[Episode[Obs]] = []
    while (missing := steps - sum(map(_weight, episodes))) > 0:
        done = len(episodes)
        length = sum(map(_weight, episodes)) / done if done else steps
        last = done + math.ceil(missing / length / comm.size) * comm.size
        mine = list(workers.play(job, range(done + comm.rank, last, comm.size)))
        by_rank = comm.all_gather(mine)
        episodes += [by_rank[i % comm.size][i // comm.size] for i in range(last - done)]
    return _first(episodes, steps)


def _first(episodes: Iterable[Episode[Obs]], steps: int) -> list[Episode[Obs]]:
    """The first of them that have `steps` together."""
    taken: list[Episode[Obs]] = []
    for episode in episodes:
        taken.append(episode)
        steps -= _weight(episode)
        if steps <= 0:
            break
    return taken


def _weight(episode: Episode[Any]) -> int:
    return max(1, len(episode))


def summary(
    episodes: list[Episode[Any]], comm: Communicator | None = None
) -> dict[str, float]:
    """Counts and means over episodes, also those that diverged; with `comm`, over those of all
    ranks. Each has some."""
    own = [
        (len(e), 1, e.success, sum(e.rewards), *(e.faults[fault] for fault in FAULTS))
        for e in episodes
    ]
    sums = np.array([sum(column) for column in zip(*own, strict=True)], np.float64)
    steps, n, successes, returns, *faults = (comm or Communicator()).sum(sums).tolist()
    return {
        "steps": steps,
        "episodes": n,
        "success_rate": successes / n,
        "mean_return": returns / n,
        "mean_length": steps / n,
        **dict(zip(FAULTS, faults, strict=True)),
    }


def discounted(values: Sequence[float], factor: float) -> list[float]:
    """Of each of the values (n,), the sum of it and all that follow, discounted."""
    sums = itertools.accumulate(
        reversed(values), lambda later, v: v + factor * later, initial=0.0
    )
    return [*sums][
        :0:-1
    ]  # in the order of the values, without the 0 that follows the last


def require_transitions(episodes: list[Episode[Any]]) -> list[Episode[Any]]:
    """The episodes from which something can be learned; DivergenceError when there is none."""
    usable = [episode for episode in episodes if len(episode)]
    if not usable:
        reason = episodes[-1].info.get("error")
        raise DivergenceError(
            f"all of {len(episodes)} episodes diverged at their first step or could not begin"
            + (f" (the last: {reason})" if reason else "")
        )
    return usable


def finite(values: Any, what: str) -> Any:
    """`values`, an array or a tuple of arrays; DivergenceError unless all are finite in float32."""
    parts = values if isinstance(values, tuple) else (values,)
    if not all((np.abs(part) <= FLOAT32_MAX).all() for part in parts):
        flat = np.concatenate([np.ravel(part) for part in parts])
        which = (
            f" (entry {np.argmin(np.abs(flat) <= FLOAT32_MAX)})"
            if flat.size > 1
            else ""
        )
        raise DivergenceError(
            f"{what} of the environment is not finite, or beyond float32{which}"
        )
    return values
