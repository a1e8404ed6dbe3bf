"""The learners. They know Gymnasium's spaces and nothing of the environments behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np

Array = np.ndarray
ALGORITHMS = ("ppo",)


class DivergenceError(FloatingPointError):
    """Something the learner needs is no longer a finite number."""


class Transition(NamedTuple):
    """What `gymnasium.Env.step` returns."""

    obs: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class EnvPool(Protocol):
    """Several environments of one kind that step side by side."""

    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]

    def __len__(self) -> int: ...

    def reset(self, index: int, seed: int) -> Any:
        """First observation of a new episode of one environment."""

    def step(self, indices: Sequence[int], actions: Array) -> list[Transition]:
        """Step the environments `indices` with actions (len(indices), ...)."""


class Algorithm(Protocol):
    """What the training loop asks of a learner."""

    env_steps: int
    """Environment steps taken so far, on all ranks."""

    def collect(self) -> dict[str, float]:
        """Gather experience for one epoch; what was seen."""

    def update(self) -> dict[str, float]:
        """Learn from it; losses and the like."""

    def act(self, obs: Any, deterministic: bool = False) -> Array:
        """Action for one observation."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the rest of the run depends on."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken."""


def load(name: str) -> tuple[type, type]:
    """(Config, Algorithm) by name; PyTorch is imported here and not before."""
    if name == "ppo":
        from .ppo import PPO, PPOConfig

        return PPOConfig, PPO
    raise ValueError(f"unknown algorithm {name!r}; allowed: {', '.join(ALGORITHMS)}")


def flat_observation(obs: Any) -> Array:
    """What a policy sees, float32 (n,): a goal environment's observation and desired goal.

    Always a copy: an environment may reuse its buffer.
    """
    if isinstance(obs, dict):
        obs = np.concatenate([np.ravel(obs["observation"]), np.ravel(obs["desired_goal"])])
    return np.array(obs, np.float32).ravel()


def check_ranges(
    config: Any,
    positive: Sequence[str] = (),
    shares: Sequence[str] = (),
    counts: Sequence[str] = (),
) -> None:
    """Raise ValueError naming the first field out of its range; None is in every range.

    `positive` are finite and above 0, `shares` lie in [0, 1], `counts` are 1 or more.
    """
    ranges: list[tuple[Sequence[str], Callable[[float], bool], str]] = [
        (positive, lambda x: 0 < x < np.inf, "a finite number above 0"),
        (shares, lambda x: 0 <= x <= 1, "from 0 to 1"),
        (counts, lambda x: x >= 1, "1 or more"),
    ]
    for names, is_allowed, allowed in ranges:
        for name in names:
            value = getattr(config, name)
            if value is not None and not is_allowed(value):
                raise ValueError(f"{name}: found {value}, allowed {allowed}")
    if not config.hidden or min(config.hidden) < 1:
        raise ValueError(f"hidden: found {config.hidden}, allowed one or more sizes of 1 or more")


def action_bounds(space: gym.Space[Any]) -> tuple[Array, Array]:
    """(low, high) of an action space; ValueError when it is not a bounded Box."""
    if isinstance(space, gym.spaces.Box) and space.is_bounded():
        return space.low, space.high
    raise ValueError(f"action space: found {space}, allowed Box with finite bounds")


def flat_size(space: gym.Space[Any]) -> int:
    """Length of `flat_observation`; ValueError for spaces no algorithm here can read."""
    if isinstance(space, gym.spaces.Dict) and {"observation", "desired_goal"} <= set(space.spaces):
        return sum(flat_size(space[key]) for key in ("observation", "desired_goal"))
    if isinstance(space, gym.spaces.Box):
        return int(np.prod(space.shape))
    raise ValueError(
        f"observation space: found {space}, allowed Box, or Dict with observation, "
        "achieved_goal and desired_goal"
    )
