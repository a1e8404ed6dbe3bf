"""Act in an environment: policies, their inputs and exploration, and the spaces they act in."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from . import Array, Communicator, DivergenceError
from .networks import MLP
from .normalizer import MIN_STD, Normalizer, Scaling

FLOAT32_MAX = float(np.finfo(np.float32).max)
OBS = "an observation of the environment"
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
SEEN = ("observation", "desired_goal")  # by a policy
GOAL_DICT = "Dict with observation, achieved_goal and desired_goal"
Noise = Callable[[Array], Array]
"""Make actions (n, d) in [-1, 1] noisy, perhaps beyond these bounds."""
TaxelScale = Literal["none", "block", "each"]


class Spaces(NamedTuple):
    """Hold an environment's observation and action space, as Gymnasium has them."""

    observation: gym.Space[Any]
    action: gym.Space[Any]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of a goal environment's observations by their names; of others, one, named ""."""
        parts: dict[str, Any] = {"": self.observation}
        if isinstance(self.observation, gym.spaces.Dict):
            spaces = self.observation.spaces
            parts = {key: spaces[key] for key in GOAL_KEYS if key in spaces}
        return {key: tuple(part.shape or ()) for key, part in parts.items()}


def finite(values: Any, what: str) -> Any:
    """Return `values` if all are finite in float32; DivergenceError where they are not."""
    is_finite = np.abs(values) <= FLOAT32_MAX
    if not is_finite.all():
        which = f" (entry {np.argmin(is_finite)})" if np.size(values) > 1 else ""
        raise DivergenceError(f"{what} is not finite, or beyond float32{which}")
    return values


def action_bounds(space: gym.Space[Any]) -> tuple[Array, Array]:
    """Return (low, high) of an action space; ValueError when it is not a bounded Box."""
    if isinstance(space, gym.spaces.Box) and space.dtype.kind == "f":
        with np.errstate(over="ignore"):
            if np.isfinite(space.high - space.low).all():
                return space.low, space.high
    raise ValueError(
        f"action space: found {space}, allowed Box of floats with finite bounds"
    )


def action_size(space: gym.Space[Any]) -> int:
    """Return the number of entries of an action; ValueError if the space is no bounded Box."""
    return int(action_bounds(space)[0].size)


def flat_parts(space: gym.Space[Any]) -> list[gym.spaces.Box]:
    """Return the parts of a flat observation in order; ValueError for spaces no learner can read."""
    parts: list[Any] = [space]
    if isinstance(space, gym.spaces.Dict) and set(SEEN) <= set(space.spaces):
        parts = [space[key] for key in SEEN]
    for part in parts:
        is_box = isinstance(part, gym.spaces.Box)
        if not is_box or (part.dtype == np.uint8 and len(part.shape) == 3):
            raise ValueError(
                f"observation space: found {part}, allowed Box (no images), or {GOAL_DICT}; "
                "gymnasium.wrappers.FlattenObservation makes a Box"
            )
    return parts


def flat_size(space: gym.Space[Any]) -> int:
    """Return the length of a flat observation; ValueError as `flat_parts` raises it."""
    return sum(math.prod(part.shape) for part in flat_parts(space))


def goal_size(space: gym.Space[Any]) -> int:
    """Return the length of a goal environment's goals; ValueError when it is not one."""
    if isinstance(space, gym.spaces.Dict) and set(GOAL_KEYS) <= set(space.spaces):
        _, achieved, desired = (flat_size(space[key]) for key in GOAL_KEYS)
        if achieved == desired > 0:
            return desired
    raise ValueError(
        f"observation space: found {space}, allowed a goal environment's: {GOAL_DICT}"
    )


def may_be_boolean(space: gym.Space[Any]) -> Array:
    """Return a mask (n,) of the flat entries between 0 and 1, which may be Boolean taxels."""
    parts = flat_parts(space)
    return np.concatenate([np.ravel((p.low == 0.0) & (p.high == 1.0)) for p in parts])


@dataclass(frozen=True)
class FlatInputs:
    """Flatten the observation, a goal environment's with its desired goal, and scale it."""

    scaling: Scaling

    def read(self, obs: Any) -> Array:
        parts = [obs[key] for key in SEEN] if isinstance(obs, dict) else [obs]
        return np.concatenate([np.ravel(part) for part in parts], dtype=np.float32)

    def stack(self, views: Sequence[Array]) -> Tensor:
        return self.scaling(torch.from_numpy(np.stack(views)))


def input_stats(
    space: gym.Space[Any],
    comm: Communicator,
    clip: float,
    normalize: bool,
    taxel_scale: TaxelScale,
    min_std: float = MIN_STD,
    bound: float = math.inf,
) -> Normalizer:
    """Return moments of flat observations, before anything was seen.

    Entries between 0 and 1, such as Boolean taxels, are scaled as `taxel_scale` says
    (see `PPOConfig.taxel_scale`), all others where `normalize` is true, divided by at
    least `min_std`.
    """
    taxels = may_be_boolean(space)
    as_is = (taxels & (taxel_scale == "none")) | (~taxels & (not normalize))
    block = taxels & (taxel_scale == "block")
    floors = np.where(taxels, MIN_STD, min_std)
    return Normalizer(len(taxels), comm, clip, as_is, block, floors, bound)


class Policy:
    """Act on observations; small, picklable, and the same wherever it is.

    `inputs.read(obs)` is what is kept of one observation, a copy, as environments reuse
    buffers; `inputs.stack(views)` the network's input (n, size) for n of these. It has
    no random state of its own: who asks for exploration brings a generator.
    `explore(rng)` begins the exploration of one episode.
    """

    def __init__(
        self,
        network: MLP,
        inputs: Any,
        explore: Callable[[np.random.Generator], Noise],
        spaces: Spaces,
    ):
        self.network, self.inputs, self.explore = network, inputs, explore
        self.shapes, self.action_space = seen_shapes(spaces), spaces.action
        self._low, self._high = action_bounds(spaces.action)

    def act(
        self,
        obs: Any,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> Array:
        """Return the action for one observation, in the environment's own range and units.

        For a batch, which has one more axis in front (each part of a Dict has it), a
        batch of actions: up to rounding those for each observation alone. With
        `deterministic=False` the policy explores as in the first step of an episode,
        with random numbers from `rng` (None: anew at every call). ValueError when the
        observation has another shape than those it was trained on or is not finite.
        """
        noise = None if deterministic else self.explore(rng or np.random.default_rng())
        parts, is_batch = self._parts(obs)
        rows = [parts]
        if is_batch:
            n = len(next(iter(parts.values())))
            rows = [{key: part[i] for key, part in parts.items()} for i in range(n)]
        views = [self.inputs.read(row.get("", row)) for row in rows]
        if not np.isfinite(views).all():
            raise ValueError("obs: not finite, or beyond float32")
        actions = self.to_env(self._actions(views, noise))
        return actions if is_batch else actions[0]

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Array, None]:
        """Return (actions, None), as a model of Stable-Baselines3 does, whose tools can play it.

        Noise is drawn anew at every call; for noise from a seed, see `act`.
        """
        return self.act(observation, deterministic), None

    def read(self, obs: Any) -> Any:
        """Return what is kept of one observation of the environment.

        ValueError where it has another shape, DivergenceError where it is not finite.
        """
        _, is_batch = self._parts(obs)
        if is_batch:
            raise ValueError("obs: found a batch, allowed one observation")
        return finite(self.inputs.read(obs), OBS)

    def choose(self, view: Any, noise: Noise | None = None) -> Array:
        """Return the action (d,) for what was kept of one observation, where bounds are ±1."""
        return self._actions([view], noise)[0]

    def to_env(self, actions: Array) -> Array:
        """Map actions (..., d) from bounds of ±1 to the environment's own bounds, clipped."""
        low, high = self._low, self._high
        shaped = np.clip(actions.reshape(actions.shape[:-1] + low.shape), -1.0, 1.0)
        return np.clip(
            low + (high - low) / 2 * (shaped + 1.0), low, high
        )  # rounding may exceed them

    def require_spaces(self, spaces: Spaces) -> None:
        """Raise ValueError unless observations and actions are as those that the policy knows."""
        shapes, actions = seen_shapes(spaces), spaces.action
        if shapes != self.shapes:
            raise ValueError(
                f"env: found observations of shape {_shown(shapes)}, the policy has "
                f"{_shown(self.shapes)}"
            )
        if actions != self.action_space:
            raise ValueError(
                f"env: found actions {actions}, the policy has {self.action_space}"
            )

    @torch.inference_mode()
    def _actions(self, views: Sequence[Any], noise: Noise | None) -> Array:
        actions: Array = self.network(self.inputs.stack(views)).numpy()
        if not np.isfinite(actions).all():
            raise ValueError(
                "policy: its action is not finite: the network's weights are damaged"
            )
        return actions if noise is None else noise(actions)

    def _parts(self, obs: Any) -> tuple[dict[str, Array], bool]:
        """Return the parts of an observation that are seen, and whether it is a batch of them."""
        whole = obs if isinstance(obs, Mapping) else {"": obs}
        if isinstance(obs, tuple):  # as `env.reset` returns it
            whole = {}
        parts = {key: np.asarray(whole[key]) for key in self.shapes if key in whole}
        shapes = {key: part.shape for key, part in parts.items()}
        if shapes == self.shapes:
            return parts, False
        batch = {shape[:1] for shape in shapes.values()}
        rest = {key: shape[1:] for key, shape in shapes.items()}
        if rest == self.shapes and len(batch) == 1:
            return parts, True
        found = f"shape {_shown(shapes)}" if shapes else f"a {type(obs).__name__}"
        raise ValueError(
            f"obs: found {found}, expected {_shown(self.shapes)}, or a batch of such"
        )


def seen_shapes(spaces: Spaces) -> dict[str, tuple[int, ...]]:
    """Return the shapes that a network sees: the achieved goal is for learning alone."""
    shapes = spaces.shapes
    return {key: shapes[key] for key in shapes if key != "achieved_goal"}


def _shown(shapes: dict[str, tuple[int, ...]]) -> str:
    return str(shapes.get("", shapes))


def new_actor(hidden: Sequence[int], spaces: Spaces, generator: torch.Generator) -> MLP:
    """Return a policy's network with `hidden` units in its layers."""
    sizes = flat_size(spaces.observation), *hidden, action_size(spaces.action)
    if 0 in sizes:
        raise ValueError(
            "observation and action space: found an empty one, allowed entries in both"
        )
    return MLP(sizes, generator, tanh=True)


def on_cpu(network: MLP) -> MLP:
    """Return the network itself where it is on the CPU already, else a copy.

    Acting is one observation at a time, and should give the same digits in every
    worker.
    """
    is_there = next(network.parameters()).device.type == "cpu"
    return network if is_there else copy.deepcopy(network).cpu()
