"""Episode replay with hindsight (HER, Andrychowicz et al. 2017), relabelled when sampled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import psutil
import torch

from . import Array
from .rollout import Episode

Reward = Callable[[Array, Array], Array]
Ends = Callable[[Array, Array], Array | None]
Values = TypeVar("Values")


class GoalObs(NamedTuple):
    """Hold what a goal environment returns, as flat float32 copies."""

    observation: Array
    achieved_goal: Array
    desired_goal: Array


class Batch(NamedTuple, Generic[Values]):
    """Hold relabelled transitions, one a row: float32 arrays or tensors."""

    obs: Values
    goal: Values
    """The goal, of this and of the next step alike, (n, goal)."""
    action: Values
    reward: Values
    """Rewards (n,)."""
    next_obs: Values
    terminal: Values
    """1 where this transition ends the episode, with its goal, else 0, (n,)."""


class Replay:
    """Keep episodes in slots of equal size, filled in order; a full buffer overwrites random slots.

    A slot has room for `max_steps` transitions and the last observation. The last `n_boolean`
    entries of an observation are kept as bytes as long as all of them are 0 or 1, everything else
    as float32. Memory is taken when the first episode is stored, and filled as episodes come.
    """

    def __init__(
        self,
        capacity: int,
        max_steps: int,
        sizes: tuple[int, int, int],
        n_boolean: int,
        reward: Reward,
        rng: np.random.Generator,
        ends: Ends | None = None,
    ) -> None:
        """Make room for `capacity` transitions; `sizes` of observation, goal and action.

        Without `ends`, a new goal leaves the episode's end as it was.

        Raises ValueError when not a single episode has room.
        """
        if capacity < max_steps:
            raise ValueError(
                f"buffer_size: found {capacity}, allowed {max_steps} (one episode) or more"
            )
        self.n_slots, self.max_steps = capacity // max_steps, max_steps
        self.sizes, self.n_boolean = sizes, n_boolean
        self._n_float = sizes[0] - n_boolean
        self.reward, self.rng, self.ends = reward, rng, ends
        self.n_episodes = 0
        self._rows = max_steps + 1
        self._columns: dict[str, Array] = {}
        self._lengths = np.zeros(0, np.int64)
        # Slots, in the order in which they were filled.
        self._unsaved: dict[int, None] = {}

    def __len__(self) -> int:
        """Return the number of transitions stored."""
        return int(self._lengths.sum())

    @property
    def nbytes(self) -> int:
        """Memory when full, in bytes."""
        return sum(
            int(np.prod(shape)) * dtype().itemsize
            for shape, dtype in self._shapes().values()
        )

    def require_memory(self, n_buffers: int = 1) -> None:
        """Raise ValueError when there is not as much memory as `n_buffers` like this one take."""
        available = psutil.virtual_memory().available
        if self.nbytes * n_buffers > available:
            raise ValueError(
                f"buffer_size: found {self.n_slots * self.max_steps:,} transitions, which take "
                f"{n_buffers} x {self.nbytes / 1e9:.2f} GB; allowed are the {available / 1e9:.2f} GB "
                "that are free here"
            )

    def require_rewards(self, episode: Episode[GoalObs]) -> None:
        """Raise ValueError when an episode's rewards do not follow from its goals.

        Those of relabelled transitions do.
        """
        lived = np.array(episode.rewards)
        _, achieved, desired = (
            np.stack(part[1:]) for part in zip(*episode.obs, strict=True)
        )
        again = self.reward(achieved, desired)
        if np.shape(again) != lived.shape or not np.allclose(again, lived, 1e-3, 1e-4):
            raise ValueError(
                f"compute_reward: found {_short(again)} for an episode's goals, allowed what its steps "
                f"gave: an array with a reward for each row of goals, here {_short(lived)}"
            )

    def _shapes(self) -> dict[str, tuple[tuple[int, int], type]]:
        """Return shape and type of every column; a row is one step of one slot."""
        _, n_goal, n_action = self.sizes
        rows = self.n_slots * self._rows
        return {
            "obs": ((rows, self._n_float), np.float32),
            "boolean": ((rows, self.n_boolean), np.uint8),
            "achieved": ((rows, n_goal), np.float32),
            "desired": ((rows, n_goal), np.float32),
            "action": ((rows, n_action), np.float32),
            "terminal": ((rows, 1), np.uint8),
        }

    # -- storing -----------------------------------------------------------------------------

    def store(self, episodes: Sequence[Episode[GoalObs]]) -> Array:
        """Keep episodes; each takes the next free slot, or a random one when all are full.

        Returns the slots (n,), each once.
        """
        slots: dict[int, None] = {}
        for episode in episodes:
            is_full = self.n_episodes == self.n_slots
            slot = int(self.rng.integers(self.n_slots)) if is_full else self.n_episodes
            self.put(slot, self._as_columns(episode))
            slots[slot] = None
        return np.array([*slots], np.int64)

    def _as_columns(self, episode: Episode[GoalObs]) -> dict[str, Array]:
        """Return the rows of one episode: one more than it has transitions."""
        obs, achieved, desired = (
            np.stack(part) for part in zip(*episode.obs, strict=True)
        )
        n_steps = len(episode)
        if n_steps > self.max_steps:
            raise ValueError(
                f"max_episode_steps: {self.max_steps}, but found {n_steps} steps"
            )
        return {
            "obs": obs,
            "achieved": achieved,
            "desired": desired,
            "action": np.pad(np.stack(episode.actions), ((0, 1), (0, 0))),
            "terminal": np.pad([[episode.terminated]], ((n_steps - 1, 1), (0, 0))),
        }

    def put(self, slot: int, columns: dict[str, Array]) -> None:
        """Write the rows of an episode, by column, into a slot."""
        if (
            not self._columns
        ):  # zeros are given out page by page, when they are written to
            self._columns = {
                k: np.zeros(shape, dtype)
                for k, (shape, dtype) in self._shapes().items()
            }
            self._lengths = np.zeros(self.n_slots, np.int64)
        first, n_rows = slot * self._rows, len(columns["obs"])
        obs = columns["obs"]
        last = obs[:, self._n_float :]
        columns = {**columns, "obs": obs[:, : self._n_float], "boolean": last}
        if not ((last == 0) | (last == 1)).all():  # as under a wrapper's noise
            self._columns["boolean"] = self._columns["boolean"].astype(np.float32)
        for name, values in columns.items():
            self._columns[name][first : first + n_rows] = values
        self._lengths[slot] = n_rows - 1
        self.n_episodes = max(self.n_episodes, slot + 1)
        self._unsaved[slot] = None

    def episode(self, slot: int) -> dict[str, Array]:
        """Return the rows of the episode in a slot, by column, as `put` takes them."""
        rows = slice(
            slot * self._rows, slot * self._rows + int(self._lengths[slot]) + 1
        )
        columns = {name: values[rows] for name, values in self._columns.items()}
        boolean = columns.pop("boolean")
        columns["obs"] = np.concatenate([columns["obs"], boolean], axis=1)
        return columns

    # -- sampling ----------------------------------------------------------------------------

    def sample(
        self, n: int, replay_p: float, slots: Array | None = None
    ) -> Batch[Array]:
        """Return `n` relabelled transitions, uniform over all that are stored or are in `slots`.

        HER's strategy "future": with probability `replay_p`, a transition at step t gets the goal that
        was achieved at a step uniform in t + 1 ... length (OpenAI baselines, her_sampler.py: t + 1 +
        floor(U (T - t))).
        """
        slot, t = self._pick(np.arange(self.n_episodes) if slots is None else slots, n)
        is_relabelled = self.rng.random(n) < replay_p
        future = (
            t + 1 + (self.rng.random(n) * (self._lengths[slot] - t)).astype(np.int64)
        )
        first = slot * self._rows
        row = first + t
        goal = self._columns["desired"][row]
        goal[is_relabelled] = self._columns["achieved"][(first + future)[is_relabelled]]
        achieved = self._columns["achieved"][row + 1]
        reward = np.asarray(self.reward(achieved, goal), np.float32)
        terminal = self._columns["terminal"][row, 0].astype(bool)
        terminal = self._terminal(achieved, goal, reward, terminal, is_relabelled)
        return Batch(
            obs=self._observations(row),
            goal=goal,
            action=self._columns["action"][row],
            reward=reward,
            next_obs=self._observations(row + 1),
            terminal=terminal.astype(np.float32),
        )

    def _terminal(
        self,
        achieved: Array,
        goal: Array,
        reward: Array,
        was_terminal: Array,
        is_relabelled: Array,
    ) -> Array:
        """Return whether transitions end the episode, for a new goal where it is relabelled.

        The environment says it; else rewards do, where with their own goals all transitions that ended
        had higher ones than all that did not. Otherwise the goal is taken to have no part in it.
        """
        if self.ends is None:
            return was_terminal
        ends = self.ends(achieved[is_relabelled], goal[is_relabelled])
        if ends is None:
            slots = np.arange(self.n_episodes)
            rows = slots * self._rows + self._lengths[slots] - 1
            rows = rows[self._columns["terminal"][rows, 0] == 1]
            at_end = self._columns["achieved"][rows + 1], self._columns["desired"][rows]
            lowest = (
                np.min(self.reward(*at_end), initial=np.inf) if len(rows) else np.inf
            )
            others = reward[~is_relabelled & ~was_terminal]
            if not len(others) or lowest <= others.max():
                return was_terminal
            ends = reward[is_relabelled] >= lowest
        terminal = was_terminal.copy()
        terminal[is_relabelled] = ends
        return terminal

    def _pick(self, slots: Array, n: int) -> tuple[Array, Array]:
        """Return slot and step of `n` transitions, uniform over the transitions in `slots`."""
        if not len(slots):
            raise ValueError("the replay is empty: nothing to sample from")
        ends = np.cumsum(self._lengths[slots])
        pick = self.rng.integers(ends[-1], size=n)
        which = np.searchsorted(ends, pick, side="right")
        slot = slots[which]
        return slot, pick - (ends[which] - self._lengths[slot])

    def _observations(self, rows: Array) -> Array:
        parts = self._columns["obs"][rows], self._columns["boolean"][rows]
        return np.concatenate(parts, axis=1, dtype=np.float32)

    # -- saving ------------------------------------------------------------------------------

    def new_experience(self, everything: bool = False) -> dict[str, Any]:
        """Return the slots written since the last call, or all; tensors, for `add_experience`.

        All of it is a view, good until the next episode is stored: a copy would take the memory
        of the replay once more.
        """
        slots = (
            np.arange(self.n_episodes)
            if everything
            else np.array([*self._unsaved], np.int64)
        )
        self._unsaved = {}
        if not len(slots):
            return {}
        rows: slice | Array = slice(len(slots) * self._rows)
        if not everything:
            rows = (slots[:, None] * self._rows + np.arange(self._rows)).ravel()
        columns = {
            name: torch.from_numpy(values[rows])
            for name, values in self._columns.items()
        }
        lengths = torch.from_numpy(self._lengths[slots])
        return {"slots": torch.from_numpy(slots), "lengths": lengths, **columns}

    def add_experience(self, saved: dict[str, Any]) -> None:
        """Put back what `new_experience` returned, in the same slots."""
        parts = {name: values.numpy() for name, values in saved.items()}
        slots, lengths = parts.pop("slots"), parts.pop("lengths")
        for i, slot in enumerate(slots):
            rows = slice(i * self._rows, i * self._rows + int(lengths[i]) + 1)
            columns = {name: values[rows] for name, values in parts.items()}
            columns["obs"] = np.concatenate(
                [columns["obs"], columns.pop("boolean")], axis=1
            )
            self.put(int(slot), columns)
            del self._unsaved[int(slot)]  # it is saved


def _short(rewards: Array) -> str:
    text = " ".join(str(rewards).split())
    return text if len(text) <= 40 else f"{text[:36]} ..."
