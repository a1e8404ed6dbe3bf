"""Episode replay with hindsight (HER, Andrychowicz et al. 2017), relabelled when sampled."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import Array
from .rollout import Episode

Reward = Callable[[Array, Array], Array]
Terminated = Callable[[Array, Array], Array | None]
COLUMNS = ("obs", "desired", "achieved", "action", "terminal")


class Batch(NamedTuple):
    """Hold relabelled transitions, one a row: float32 arrays or tensors."""

    obs: Any
    goal: Any
    """The goal, of this and of the next step alike, (n, goal)."""
    action: Any
    reward: Any
    """Rewards (n,)."""
    next_obs: Any
    terminal: Any
    """1 where this transition ends the episode, with its goal, else 0, (n,).

    Learners that bootstrap all the same ignore it."""


class Relabelled(NamedTuple):
    """Say which transitions were drawn, one a row, and what HER makes of them."""

    slot: Any
    step: Any
    goal: Any
    reward: Any
    terminal: Any


def minibatches(drawn: Any, size: int, axis: int = 0) -> Iterator[Any]:
    """Yield named tuples of tensors like `drawn`, with `size` transitions each along an axis."""
    parts = (part.split(size, dim=axis) for part in drawn)
    return map(type(drawn)._make, zip(*parts, strict=True))


class Replay:
    """Keep episodes in slots of equal size, filled in order; a full buffer overwrites random slots.

    A slot has room for `max_steps` transitions and the last observation.
    """

    rng: np.random.Generator
    """The learner gives a new one for each cycle."""

    def __init__(
        self,
        capacity: int,
        max_steps: int,
        sizes: tuple[int, int, int],
        reward: Reward,
        compute_terminated: Terminated | None = None,
    ) -> None:
        """Make room for `capacity` transitions; `sizes` of observation, goal and action.

        Without `compute_terminated`, a new goal leaves the episode's end as it was;
        where it returns None, rewards say whether a new goal ends it (`_terminal`).

        Raises ValueError when not a single episode has room.
        """
        if capacity < max_steps:
            raise ValueError(
                f"buffer_size: found {capacity}, allowed {max_steps} (one episode) or more"
            )
        self.n_slots, self.max_steps = capacity // max_steps, max_steps
        n_obs, n_goal, n_actions = sizes
        widths = n_obs, n_goal, n_goal, n_actions, 1
        self._part_ends = np.cumsum([n_obs, n_goal])  # of an observation
        self.reward, self.compute_terminated = reward, compute_terminated
        self.n_episodes = 0
        # Zeros take memory page by page, when they are written to.
        shape = self.n_slots, max_steps + 1
        self._columns = {
            name: np.zeros((*shape, width), np.float32)
            for name, width in zip(COLUMNS, widths, strict=True)
        }
        self._lengths = np.zeros(self.n_slots, np.int64)  # of the episode in each slot
        self._unsaved = list[int]()  # slots

    def __len__(self) -> int:
        """Return the number of transitions stored."""
        return int(self._lengths.sum())

    @property
    def nbytes(self) -> int:
        """Memory when full, in bytes."""
        return sum(column.nbytes for column in self._columns.values())

    def require_rewards(self, episode: Episode) -> None:
        """Raise ValueError when an episode's rewards do not follow from its goals.

        The rewards of all transitions that are drawn are computed so; none is stored.
        """
        given = np.array(episode.rewards)
        _, desired, achieved = self._parts(episode)
        again = self.reward(achieved[1:], desired[1:])
        if np.shape(again) != given.shape or not np.allclose(again, given, 1e-3, 1e-4):
            raise ValueError(
                f"compute_reward: found {_short(again)} for an episode's goals, allowed what its steps "
                f"gave: an array with a reward for each row of goals, here {_short(given)}"
            )

    # -- storing -----------------------------------------------------------------------------

    def store(self, episodes: Sequence[Episode]) -> Array:
        """Keep episodes; each takes the next free slot, or a random one when all are full.

        Returns the slots (n,), each once.
        """
        slots = list[int]()
        for episode in episodes:
            is_full = self.n_episodes == self.n_slots
            slot = int(self.rng.integers(self.n_slots)) if is_full else self.n_episodes
            self._put(slot, episode)
            slots.append(slot)
        return np.array([*dict.fromkeys(slots)], np.int64)

    def _parts(self, episode: Episode) -> list[Array]:
        """Return observations, desired and achieved goals (length + 1, ...) of an episode."""
        return np.split(np.stack(episode.obs), self._part_ends, axis=1)

    def _put(self, slot: int, episode: Episode) -> None:
        """Write an episode into a slot."""
        n, columns = len(episode), self._columns
        for name, part in zip(COLUMNS, self._parts(episode), strict=False):
            columns[name][slot, : n + 1] = part
        columns["action"][slot, :n] = episode.actions
        columns["terminal"][slot] = 0.0
        columns["terminal"][slot, n - 1] = episode.terminated
        self._lengths[slot] = n
        self.n_episodes = max(self.n_episodes, slot + 1)
        self._unsaved.append(slot)

    def episodes(self, slots: Array) -> Array:
        """Return observations and actions, side by side (k, max_steps + 1, n), in slots (k,), whole."""
        parts = [self._columns[name][slots] for name in ("obs", "action")]
        return np.concatenate(parts, axis=-1)

    # -- sampling ----------------------------------------------------------------------------

    def sample(self, n: int, replay_p: float, slots: Array | None = None) -> Batch:
        """Return `n` transitions, relabelled as `relabel` does it."""
        slot, t, goal, reward, terminal = self.relabel(n, replay_p, slots)
        obs, action = self._columns["obs"], self._columns["action"]
        return Batch(
            obs[slot, t], goal, action[slot, t], reward, obs[slot, t + 1], terminal
        )

    def relabel(
        self, n: int, replay_p: float, slots: Array | None = None
    ) -> Relabelled:
        """Draw `n` transitions, uniform over all or over those in `slots`, and give some new goals.

        HER's strategy "future": with probability `replay_p`, a transition at step t
        gets the goal that was achieved at a step uniform in t + 1 ... length (OpenAI
        baselines, her_sampler.py: t + 1 + floor(U (T - t))).
        """
        slot, t = self._pick(np.arange(self.n_episodes) if slots is None else slots, n)
        is_new = self.rng.random(n) < replay_p
        ahead = (self.rng.random(n) * (self._lengths[slot] - t)).astype(np.int64)
        achieved, goal = self._columns["achieved"], self._columns["desired"][slot, t]
        goal[is_new] = achieved[slot[is_new], (t + 1 + ahead)[is_new]]  # in a copy
        following = achieved[slot, t + 1]
        reward = np.asarray(self.reward(following, goal), np.float32)
        was_terminal = self._columns["terminal"][slot, t, 0] == 1
        terminal = self._terminal(following, goal, reward, was_terminal, is_new)
        return Relabelled(slot, t, goal, reward, terminal.astype(np.float32))

    def _terminal(
        self,
        achieved: Array,
        goal: Array,
        reward: Array,
        was_terminal: Array,
        is_relabelled: Array,
    ) -> Array:
        """Return whether transitions end the episode, for a new goal where it is relabelled.

        The environment says it; else rewards do, where with their own goals every
        transition that ended an episode had a higher one than every other. Otherwise it
        is as with the own goal.
        """
        if self.compute_terminated is None:  # the learner bootstraps and does not ask
            return was_terminal
        terminal = self.compute_terminated(achieved, goal)
        if terminal is None:  # the environment does not say
            lowest = self._lowest_ending_reward()
            others = reward[~is_relabelled & ~was_terminal]  # of this draw only
            if not len(others) or lowest <= others.max():
                return was_terminal
            terminal = reward >= lowest
        return np.where(is_relabelled, terminal, was_terminal)

    def _lowest_ending_reward(self) -> float:
        """Return the lowest reward of all transitions that ended an episode; inf without any."""
        columns, slots = self._columns, np.arange(self.n_episodes)
        last = self._lengths[slots] - 1
        has_ended = columns["terminal"][slots, last, 0] == 1
        slots, last = slots[has_ended], last[has_ended]
        goals = columns["achieved"][slots, last + 1], columns["desired"][slots, last]
        return float(np.min(self.reward(*goals))) if len(slots) else np.inf

    def _pick(self, slots: Array, n: int) -> tuple[Array, Array]:
        """Return slot and step of `n` transitions, uniform over the transitions in `slots`."""
        total = np.cumsum(self._lengths[slots])
        pick = self.rng.integers(total[-1], size=n)
        which = np.searchsorted(total, pick, side="right")
        slot = slots[which]
        return slot, pick - (total[which] - self._lengths[slot])

    # -- saving ------------------------------------------------------------------------------

    def new_experience(self, everything: bool = False) -> dict[str, Tensor]:
        """Return the slots written since the last call, or all; tensors, for `add_experience`.

        With `everything` it may be a view, good until the next episode is stored.
        """
        written = range(self.n_episodes) if everything else dict.fromkeys(self._unsaved)
        slots, self._unsaved = np.array([*written], np.int64), []
        if not len(slots):
            return {}
        rows: Any = slice(len(slots)) if everything else slots
        parts: dict[str, Array] = {k: v[rows] for k, v in self._columns.items()}
        parts |= {"slots": slots, "lengths": self._lengths[slots]}
        return {name: torch.from_numpy(values) for name, values in parts.items()}

    def add_experience(self, saved: dict[str, Tensor]) -> None:
        """Put back what `new_experience` returned, in the same slots."""
        parts = {name: values.numpy() for name, values in saved.items()}
        slots = parts.pop("slots")
        self._lengths[slots] = parts.pop("lengths")
        for name, values in parts.items():
            self._columns[name][slots] = values
        self.n_episodes = max(self.n_episodes, *(slots + 1))


def _short(rewards: Array) -> str:
    text = " ".join(str(rewards).split())
    return text if len(text) <= 40 else f"{text[:36]} ..."
