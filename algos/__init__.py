"""The learners. They know Gymnasium's spaces and nothing of the environments behind them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, TypeVar

import gymnasium as gym

from .spaces import Array as Array

T = TypeVar("T")
# Of hyperparameters, with their ranges; float32 has room for 1e30.
Positive32 = Annotated[float, "(0, 1e30]"]
NotNegative = Annotated[float, "[0, inf)"]
Fraction = Annotated[float, "[0, 1]"]
Count = Annotated[int, "[1, inf)"]


@dataclass(frozen=True)
class LearnerSpec:
    """A learner that can be asked for by name."""

    config: str
    """Name of the class of its hyperparameters."""
    algorithm: str
    """Name of its own class."""
    total_timesteps: int
    """Length of the paper's runs, in environment steps of all processes."""
    task: str
    """The paper's task with it, where an environment has several."""
    module: str = ""
    """Where both classes are; default: in the module here that has the learner's name."""


ALGORITHMS = {
    "ppo": LearnerSpec("PPOConfig", "PPO", 500_000, "lift-and-hold"),
    # 19 workers took 5,000,000 steps each.
    "ddpg_her": LearnerSpec("DDPGHERConfig", "DDPGHER", 19 * 5_000_000, "reach-goal"),
}


class DivergenceError(FloatingPointError):
    """Something the learner needs is no longer a finite number."""


class UnfitError(ValueError):
    """The environment is not what the learner takes for granted."""


class Workers(Protocol):
    """Environments of one kind, and who plays in them side by side."""

    observation_space: gym.Space[Any]
    """Of each environment."""
    action_space: gym.Space[Any]

    def __len__(self) -> int:
        """How many episodes are played at the same time."""

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which an episode is cut off; None where the environment does not say."""

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """A goal environment's rewards (n,) of goals (n, goal_size)."""

    def play(
        self,
        job: Callable[[gym.Env[Any, Any], int, Callable[[], bool]], T],
        numbers: Iterable[int],
    ) -> Iterator[T]:
        """`job(env, number, is_wanted)` for `numbers`, in order; who has enough stops iterating."""


def get(name: str) -> tuple[Any, Any]:
    """(hyperparameters, `Learner`) by name; PyTorch is imported here and not before."""
    if name not in ALGORITHMS:
        raise ValueError(
            f"unknown algorithm {name!r}; allowed: {', '.join(ALGORITHMS)}"
        )
    registered = ALGORITHMS[name]
    module = importlib.import_module(registered.module or f".{name}", __name__)
    return getattr(module, registered.config), getattr(module, registered.algorithm)
