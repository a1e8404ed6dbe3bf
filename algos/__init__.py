"""Learn to act in any Gymnasium environment: the learners, and what they ask of environments."""

from __future__ import annotations

if __name__ == "algos":  # found by its folder: all of it would be there twice
    raise ImportError("algos is part of tactilerl: import tactilerl.algos")

import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

import gymnasium as gym
import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")
Array = np.ndarray
# Of hyperparameters, with their ranges; float32 has room for 1e30.
Positive32 = Annotated[float, "(0, 1e30]"]
NotNegative = Annotated[float, "[0, inf)"]
Fraction = Annotated[float, "[0, 1]"]
Count = Annotated[int, "[1, inf)"]


@dataclass(frozen=True)
class LearnerSpec:
    """Say where a learner is that can be asked for by name."""

    config: str
    """Name of the class of its hyperparameters."""
    algorithm: str
    """Name of its own class."""
    total_timesteps: int
    """Length of the paper's runs, in environment steps of all processes."""
    task: str
    """The paper's task with it, where an environment has several."""
    module: str = ""
    """Module of both classes; default: the module here that has the learner's name."""


ALGORITHMS = {
    "ppo": LearnerSpec("PPOConfig", "PPO", 500_000, "lift-and-hold"),
    # 19 workers took 5,000,000 steps each.
    "ddpg_her": LearnerSpec("DDPGHERConfig", "DDPGHER", 19 * 5_000_000, "reach-goal"),
}


class DivergenceError(FloatingPointError):
    """Say that something the learner needs is no longer a finite number."""


class EndlessError(ValueError):
    """Say that an episode of the environment has no end."""


class Workers(Protocol):
    """Play episodes in environments of one kind, several side by side."""

    observation_space: gym.Space[Any]
    """Observation space of each environment."""
    action_space: gym.Space[Any]

    def __len__(self) -> int:
        """Return how many episodes are played at the same time."""

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which an episode is cut off; None where the environment does not say."""

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Return a goal environment's rewards (n,) for goals (n, goal_size)."""

    def compute_terminated(
        self, achieved_goal: Array, desired_goal: Array
    ) -> Array | None:
        """Return whether goals (n, goal_size) end an episode, (n,); None where nobody says."""

    def play(
        self,
        job: Callable[[gym.Env[Any, Any], int, Callable[[], bool]], T],
        numbers: Iterable[int],
    ) -> Iterator[T]:
        """Yield `job(env, number, is_wanted)` for `numbers`, in order; stop iterating at will."""


class Communicator:
    """One process on its own; `mpi.MPICommunicator` is several."""

    rank = 0
    size = 1
    local_size = 1
    """Ranks on this machine."""

    def sum_(self, tensor: Tensor) -> None:
        """Replace `tensor` by its sum over ranks, in place."""

    def sum(self, values: np.ndarray) -> np.ndarray:
        """Elementwise sum of float64 arrays over ranks."""
        return values

    def all_gather(self, value: Any) -> list[Any]:
        """Return the values of all ranks, in their order, on every rank."""
        return [value]


def get(name: str) -> tuple[Any, Any]:
    """Return (hyperparameters, `Learner`) by name; PyTorch is imported here and not before."""
    if name not in ALGORITHMS:
        raise ValueError(
            f"unknown algorithm {name!r}; allowed: {', '.join(ALGORITHMS)}"
        )
    registered = ALGORITHMS[name]
    module = importlib.import_module(registered.module or f".{name}", __name__)
    return getattr(module, registered.config), getattr(module, registered.algorithm)
