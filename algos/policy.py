"""What acts: a network, what it is shown and how it explores. Nothing else of a learner."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from . import Array, UnfitError
from .mpi import Communicator
from .networks import MLP
from .normalizer import Normalizer, Scaling
from .spaces import Spaces, action_bounds, action_size, flat_size, may_be_boolean

FLOAT32_MAX = float(np.finfo(np.float32).max)
Noise = Callable[[Array, np.random.Generator], Array]
"""(actions (n, d) in [-1, 1], rng) -> noisy ones, perhaps beyond."""


@dataclass(frozen=True)
class FlatInputs:
    """The observation, flat; a goal environment's with its desired goal. As it is, or scaled."""

    scaling: Scaling | None = None

    def read(self, obs: Any) -> Array:
        if isinstance(obs, dict):
            obs = np.concatenate(
                [np.ravel(obs["observation"]), np.ravel(obs["desired_goal"])]
            )
        return np.array(obs, np.float32).ravel()

    def stack(self, views: Sequence[Array]) -> Tensor:
        flat = torch.from_numpy(np.stack(views))
        return flat if self.scaling is None else self.scaling(flat)


def flat_stats(
    space: gym.Space[Any], clip: float, comm: Communicator | None = None
) -> Normalizer:
    """Moments of flat observations, without those of entries that may be Boolean; nothing seen yet."""
    as_is = may_be_boolean(space)
    return Normalizer(len(as_is), comm or Communicator(), clip, as_is)


class Inputs(Protocol):
    """What a network is given of the observations."""

    def read(self, obs: Any) -> Any:
        """What is kept of one observation to learn from; a copy: environments reuse buffers."""

    def stack(self, views: Sequence[Any]) -> Tensor:
        """The network's input (n, size) for n of these."""


class Policy:
    """Acts on observations; small, picklable, and the same wherever it is.

    It has no random state of its own: who asks for exploration brings a generator.
    """

    def __init__(self, network: MLP, inputs: Inputs, noise: Noise, spaces: Spaces):
        self.network, self.inputs, self.noise = network, inputs, noise
        self.shapes = _read(spaces.shapes)
        self._low, self._high = action_bounds(spaces.action)

    def act(
        self,
        obs: Any,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
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
            if (
                values.dtype.kind not in "bifu"
                or not (np.abs(values) < FLOAT32_MAX).all()
            ):
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
            raise UnfitError(
                f"env: what it returns is not what its space says: {error}"
            ) from error
        if not is_one:
            raise UnfitError(
                "env: found a batch of observations, allowed one of the space's shape"
            )
        return self.inputs.read(obs)

    def choose(self, view: Any, rng: np.random.Generator | None = None) -> Array:
        """Action (d,) for what was kept of one observation, in units where the bounds are ±1."""
        return self._actions([view], rng)[0]

    def to_env(self, actions: Array) -> Array:
        """From units where the bounds are ±1, (..., d), to the environment's own, clipped."""
        low, high = self._low, self._high
        shaped = np.clip(actions.reshape(actions.shape[:-1] + low.shape), -1.0, 1.0)
        return np.clip(
            low + (high - low) / 2 * (shaped + 1.0), low, high
        )  # rounding may exceed them

    def require_spaces(self, spaces: Spaces) -> None:
        """ValueError unless observations and actions have the shapes that the policy knows."""
        for name, found, known in (
            ("observations", _shown(_read(spaces.shapes)), _shown(self.shapes)),
            ("actions", str(spaces.action.shape), str(self._low.shape)),
        ):
            if found != known:
                raise ValueError(
                    f"env: found {name} of shape {found}, the policy has {known}"
                )
        bounds = action_bounds(spaces.action)
        if not (
            np.array_equal(bounds[0], self._low)
            and np.array_equal(bounds[1], self._high)
        ):
            both = bounds, (self._low, self._high)
            found, known = (
                f"from {low.min():g} to {high.max():g}" for low, high in both
            )
            raise ValueError(f"env: found actions {found}, the policy's are {known}")

    @torch.inference_mode()
    def _actions(self, views: Sequence[Any], rng: np.random.Generator | None) -> Array:
        actions: Array = self.network(self.inputs.stack(views)).numpy()
        if not np.isfinite(actions).all():
            raise ValueError(
                "policy: its action is not finite: the network's weights are damaged"
            )
        return actions if rng is None else self.noise(actions, rng)

    def _batch_size(self, obs: Any) -> int | None:
        """Observations in a batch; None for one observation by itself."""
        if isinstance(obs, tuple):
            raise ValueError(
                "obs: found a tuple; env.reset() returns (observation, info)"
            )
        keys = set(obs) if isinstance(obs, Mapping) else {""}
        if not keys >= set(self.shapes):
            got = sorted(keys) if isinstance(obs, Mapping) else type(obs).__name__
            expected = (
                "an array" if "" in self.shapes else f"a Dict with {list(self.shapes)}"
            )
            raise ValueError(f"obs: found {got}, expected {expected}")
        found = {key: np.shape(obs[key] if key else obs) for key in self.shapes}
        if found == self.shapes:
            return None
        sizes = {shape[:1] for shape in found.values()}
        if {key: shape[1:] for key, shape in found.items()} == self.shapes and len(
            sizes
        ) == 1:
            return sizes.pop()[0]
        raise ValueError(
            f"obs: found shape {_shown(found)}, expected {_shown(self.shapes)}, or a batch of such"
        )


def _read(shapes: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Those that a network sees: the achieved goal is the truth, for learning alone."""
    return {key: shape for key, shape in shapes.items() if key != "achieved_goal"}


def _shown(shapes: dict[str, tuple[int, ...]]) -> str:
    return str(shapes.get("", shapes))


def _rows(obs: Any, n: int) -> list[Any]:
    """Each observation of a batch."""
    is_dict = isinstance(obs, Mapping)
    return [
        {key: part[i] for key, part in obs.items()} if is_dict else obs[i]
        for i in range(n)
    ]


def new_actor(hidden: Sequence[int], spaces: Spaces, generator: torch.Generator) -> MLP:
    """A policy's network, with `hidden` units in its layers and weights drawn from `generator`."""
    return MLP(
        network_sizes(hidden, spaces), generator, tanh=True, inputs=spaces.inputs()
    )


def network_sizes(hidden: Sequence[int], spaces: Spaces) -> tuple[int, ...]:
    """Values that each layer of a policy's network gives, the inputs first."""
    sizes = flat_size(spaces.observation), *hidden, action_size(spaces.action)
    if 0 in sizes:
        raise ValueError(
            "observation and action space: found an empty one, allowed entries in both"
        )
    return sizes


def on_cpu(network: MLP) -> MLP:
    """The network itself where it is on the CPU already, else a copy: acting is one observation
    at a time, and should give the same digits in every worker."""
    is_there = next(network.parameters()).device.type == "cpu"
    return network if is_there else copy.deepcopy(network).cpu()
