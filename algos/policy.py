"""What acts: a network, what it is shown and how it explores. Nothing else of a learner."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from . import Array, action_bounds, flat_observation
from .networks import MLP
from .normalizer import Scaling

Noise = Callable[..., Array]
"""(actions (..., d) in [-1, 1], rng=) -> noisy ones, which may lie beyond."""


class Inputs(Protocol):
    """What a network is shown of an observation."""

    def read(self, obs: Any) -> Any:
        """What is kept of one observation to learn from; a copy: environments reuse buffers."""

    def stack(self, views: Sequence[Any]) -> Tensor:
        """What the network sees (n, size) of n such."""


class FlatInputs:
    """The observation as it is, flat; a goal environment's with its desired goal."""

    def read(self, obs: Any) -> Array:
        return flat_observation(obs)

    def stack(self, views: Sequence[Array]) -> Tensor:
        return torch.from_numpy(np.stack(views))


class GoalObs(NamedTuple):
    """What a goal environment returns, flat float32 copies."""

    observation: Array
    achieved_goal: Array
    desired_goal: Array


def goal_observation(obs: Any) -> GoalObs:
    """A goal environment's Dict as a `GoalObs`."""
    return GoalObs(*(np.array(obs[key], np.float32).ravel() for key in GoalObs._fields))


@dataclass(frozen=True)
class GoalInputs:
    """What both networks see: observation and goal, cut and normalised."""

    obs_scaling: Scaling
    goal_scaling: Scaling
    limit: float

    def read(self, obs: Any) -> GoalObs:
        return goal_observation(obs)

    def stack(self, views: Sequence[GoalObs]) -> Tensor:
        parts = (torch.from_numpy(np.stack(part)) for part in zip(*views, strict=True))
        observations, _, goals = parts
        return self(observations, goals)

    def __call__(self, obs: Tensor, goals: Tensor) -> Tensor:
        """Of observations (n, obs) and goals (n, goal): (n, obs + goal)."""
        parts = (self.obs_scaling, obs), (self.goal_scaling, goals)
        return torch.cat([scale(part.clamp(-self.limit, self.limit)) for scale, part in parts], dim=1)


class Policy:
    """Acts on observations; small, picklable, and the same wherever it is.

    It has no random state of its own: who asks for exploration brings a generator.
    """

    def __init__(self, network: MLP, inputs: Inputs, noise: Noise, action_space: gym.Space[Any]):
        self.network, self.inputs, self.noise = network, inputs, noise
        self._low, self._high = action_bounds(action_space)

    def act(self, obs: Any, rng: np.random.Generator | None = None) -> Array:
        """Action for one observation, in the environment's own range; exploring with `rng`."""
        return self.to_env(self.choose(self.inputs.read(obs), rng))

    @torch.inference_mode()
    def choose(self, view: Any, rng: np.random.Generator | None = None) -> Array:
        """Action (d,) for what was kept of one observation, in units where the bounds are ±1."""
        action: Array = self.network(self.inputs.stack([view]))[0].numpy()
        return action if rng is None else self.noise(action, rng=rng)

    def to_env(self, action: Array) -> Array:
        """From units where the bounds are ±1 to the environment's own, clipped."""
        half = (self._high - self._low) / 2
        return self._low + half * (np.clip(action.reshape(self._low.shape), -1.0, 1.0) + 1.0)


def on_cpu(network: MLP) -> MLP:
    """The network itself where it is on the CPU already, else a copy: acting is one observation
    at a time, and should give the same digits in every worker."""
    is_there = next(network.parameters()).device.type == "cpu"
    return network if is_there else copy.deepcopy(network)
