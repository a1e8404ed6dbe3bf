"""What acts: a network, what it is shown and how it explores. Nothing else of a learner."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from . import Array, UnfitError
from .mpi import Communicator
from .networks import MLP
from .normalizer import Normalizer, Scaling
from .spaces import (
    Spaces,
    action_bounds,
    action_size,
    flat_observation,
    flat_size,
    goal_size,
    may_be_boolean,
)

LARGEST = float(np.finfo(np.float32).max)
Noise = Callable[[Array, Tensor, np.random.Generator], Array]
"""(actions (n, d) in [-1, 1], what the network saw (n, size), rng) -> noisy ones, perhaps beyond."""


def explore(
    actions: Array, seen: Tensor, rng: np.random.Generator, noise_eps: float, random_eps: float
) -> Array:
    """Noisy copies of actions (n, d) in [-1, 1]; whole rows are random with `random_eps`."""
    noisy = actions + np.float32(noise_eps) * rng.standard_normal(actions.shape, dtype=np.float32)
    noisy = np.clip(noisy, -1.0, 1.0)
    is_random = rng.random(actions.shape[:-1])[..., None] < random_eps
    return np.where(is_random, rng.uniform(-1.0, 1.0, actions.shape).astype(np.float32), noisy)


@dataclass(frozen=True)
class FlatInputs:
    """A network is shown the observation, flat; a goal environment's with its desired goal. As it is,
    or scaled."""

    scaling: Scaling | None = None

    def read(self, obs: Any) -> Array:
        """What is kept of one observation to learn from; a copy: environments reuse buffers."""
        return flat_observation(obs)

    def stack(self, views: Sequence[Array]) -> Tensor:
        """What the network sees (n, size) of n such."""
        flat = torch.from_numpy(np.stack(views))
        return flat if self.scaling is None else self.scaling(flat)


def flat_stats(space: gym.Space[Any], clip: float, comm: Communicator | None = None) -> Normalizer:
    """Moments of flat observations, without those of entries that may be Boolean; nothing seen yet."""
    as_is = may_be_boolean(space)
    return Normalizer(len(as_is), comm or Communicator(), clip, as_is)


class GoalObs(NamedTuple):
    """What a goal environment returns, flat float32 copies."""

    observation: Array
    achieved_goal: Array
    desired_goal: Array


@dataclass(frozen=True)
class GoalInputs:
    """What both networks see: observation and goal, cut and normalised."""

    obs_scaling: Scaling
    goal_scaling: Scaling
    limit: float

    def read(self, obs: Any) -> GoalObs:
        return GoalObs(*(np.array(obs[key], np.float32).ravel() for key in GoalObs._fields))

    def stack(self, views: Sequence[GoalObs]) -> Tensor:
        obs, _, goals = (torch.from_numpy(np.stack(part)) for part in zip(*views, strict=True))
        return self(obs, goals)

    def __call__(self, obs: Tensor, goals: Tensor) -> Tensor:
        """Of observations (n, obs) and goals (n, goal): (n, obs + goal)."""
        parts = (self.obs_scaling, obs), (self.goal_scaling, goals)
        return torch.cat([scale(part.clamp(-self.limit, self.limit)) for scale, part in parts], dim=1)


Inputs = FlatInputs | GoalInputs


class GoalStats(NamedTuple):
    """Moments of what a goal environment's observations are made of."""

    obs: Normalizer
    goal: Normalizer

    @classmethod
    def of(cls, spaces: Spaces, clip: float, comm: Communicator) -> GoalStats:
        """Before anything was seen; normalised values will be cut at ±`clip`."""
        n_goal, n_seen = goal_size(spaces.observation), flat_size(spaces.observation)
        return cls(*(Normalizer(n, comm, clip) for n in (n_seen - n_goal, n_goal)))

    def inputs(self, limit: float) -> GoalInputs:
        """What networks see as of now."""
        return GoalInputs(self.obs.scaling(), self.goal.scaling(), limit)


class Elsewhere:
    """A name that other libraries have: using it says what ours is."""

    def __init__(self, ours: str) -> None:
        self.ours = ours

    def __set_name__(self, _: type, name: str) -> None:
        self.name = name

    def __get__(self, _: object, owner: type) -> NoReturn:
        raise AttributeError(f"{owner.__name__} has no {self.name}; {self.ours}")


class Policy:
    """Acts on observations; small, picklable, and the same wherever it is.

    It has no random state of its own: who asks for exploration brings a generator.
    """

    predict = Elsewhere("act(obs) returns the actions")

    def __init__(self, network: MLP, inputs: Inputs, noise: Noise, spaces: Spaces):
        self.network, self.inputs, self.noise = network, inputs, noise
        self.shapes = spaces.shapes
        self._low, self._high = action_bounds(spaces.action)

    def act(
        self, obs: Any, deterministic: bool = True, rng: np.random.Generator | None = None
    ) -> Array:
        """The action for one observation, in the environment's own range and units.

        Of a batch, which has one more axis in front (each part of a Dict has it), a batch of
        actions: up to rounding those for each observation alone. With `deterministic=False` the
        policy explores, with random numbers from `rng`. ValueError when the observation has
        another shape than those it was trained on or is not finite, or `rng` is missing.
        """
        if not (deterministic or isinstance(rng, np.random.Generator)):
            raise ValueError(
                f"rng: found {str(rng).lower()}, needed to explore: numpy.random.default_rng(seed)"
            )
        noise = None if deterministic else rng
        n = self._batch_size(obs)
        for key in self.shapes:
            values = np.asarray(obs[key] if key else obs)
            if values.dtype.kind not in "bifu" or not (np.abs(values) < LARGEST).all():
                found = f"not finite, not real or beyond float32 ({values.dtype})"
                raise ValueError(f"obs: {found}, allowed finite numbers")
        if n == 0:
            return self.to_env(np.empty((0, self._low.size), np.float32))
        views = map(self.inputs.read, [obs] if n is None else _rows(obs, n))
        actions = self._actions([*views], noise)
        return self.to_env(actions[0] if n is None else actions)

    def read(self, obs: Any) -> Any:
        """What is kept of an observation from an environment; UnfitError where it is not of the shape
        that the environment's space says."""
        try:
            is_one = self._batch_size(obs) is None
        except ValueError as error:
            raise UnfitError(f"env: what it returns is not what its space says: {error}") from error
        if not is_one:
            raise UnfitError("env: found a batch of observations, allowed one of the space's shape")
        return self.inputs.read(obs)

    def choose(self, view: Any, rng: np.random.Generator | None = None) -> Array:
        """Action (d,) for what was kept of one observation, in units where the bounds are ±1."""
        return self._actions([view], rng)[0]

    def to_env(self, actions: Array) -> Array:
        """From units where the bounds are ±1, (..., d), to the environment's own, clipped."""
        low, high = self._low, self._high
        shaped = np.clip(actions.reshape(actions.shape[:-1] + low.shape), -1.0, 1.0)
        return np.clip(low + (high - low) / 2 * (shaped + 1.0), low, high)  # rounding may exceed them

    def require_spaces(self, spaces: Spaces) -> None:
        """ValueError unless observations and actions have the shapes that the policy knows."""
        for name, found, known in (
            ("observations", _said(spaces.shapes), _said(self.shapes)),
            ("actions", str(spaces.action.shape), str(self._low.shape)),
        ):
            if found != known:
                raise ValueError(f"env: found {name} of shape {found}, the policy has {known}")
        bounds = action_bounds(spaces.action)
        if not (np.array_equal(bounds[0], self._low) and np.array_equal(bounds[1], self._high)):
            both = bounds, (self._low, self._high)
            found, known = (f"from {low.min():g} to {high.max():g}" for low, high in both)
            raise ValueError(f"env: found actions {found}, the policy's are {known}")

    @torch.inference_mode()
    def _actions(self, views: Sequence[Any], rng: np.random.Generator | None) -> Array:
        seen = self.inputs.stack(views)
        actions: Array = self.network(seen).numpy()
        if not np.isfinite(actions).all():
            raise ValueError("policy: its action is not finite: the network's weights are damaged")
        return actions if rng is None else self.noise(actions, seen, rng)

    def _batch_size(self, obs: Any) -> int | None:
        """Observations in a batch; None for one observation by itself."""
        if isinstance(obs, tuple):
            raise ValueError("obs: found a tuple; env.reset() returns (observation, info)")
        keys = set(obs) if isinstance(obs, Mapping) else {""}
        if not keys >= set(self.shapes):
            got = sorted(keys) if isinstance(obs, Mapping) else type(obs).__name__
            expected = "an array" if "" in self.shapes else f"a Dict with {list(self.shapes)}"
            raise ValueError(f"obs: found {got}, expected {expected}")
        found = {key: np.shape(obs[key] if key else obs) for key in self.shapes}
        if found == self.shapes:
            return None
        sizes = {shape[:1] for shape in found.values()}
        if {key: shape[1:] for key, shape in found.items()} == self.shapes and len(sizes) == 1:
            return sizes.pop()[0]
        raise ValueError(
            f"obs: found shape {_said(found)}, expected {_said(self.shapes)}, or a batch of such"
        )


def _said(shapes: dict[str, tuple[int, ...]]) -> str:
    return str(shapes.get("", shapes))


def _rows(obs: Any, n: int) -> list[Any]:
    """Each observation of a batch."""
    is_dict = isinstance(obs, Mapping)
    return [{key: part[i] for key, part in obs.items()} if is_dict else obs[i] for i in range(n)]


def new_actor(hidden: Sequence[int], spaces: Spaces, weights: torch.Generator) -> MLP:
    """A policy's network, with `hidden` units in its layers and weights drawn from a generator."""
    return MLP(network_sizes(hidden, spaces), weights, tanh=True, inputs=spaces.inputs())


def network_sizes(hidden: Sequence[int], spaces: Spaces) -> tuple[int, ...]:
    """Values that each layer of a policy's network gives, the inputs first."""
    sizes = flat_size(spaces.observation), *hidden, action_size(spaces.action)
    if 0 in sizes:
        raise ValueError("observation and action space: found an empty one, allowed entries in both")
    return sizes


def on_cpu(network: MLP) -> MLP:
    """The network itself where it is on the CPU already, else a copy: acting is one observation
    at a time, and should give the same digits in every worker."""
    is_there = next(network.parameters()).device.type == "cpu"
    return network if is_there else copy.deepcopy(network).cpu()
