"""The learners. They know Gymnasium's spaces and nothing of the environments behind them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar, runtime_checkable

import gymnasium as gym

from .spaces import Array as Array
from .spaces import Spaces

if TYPE_CHECKING:
    from .policy import Policy
    from .replay import Replay

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
        self, job: Callable[[gym.Env[Any, Any], int, Callable[[], bool]], T], numbers: Iterable[int]
    ) -> Iterator[T]:
        """`job(env, number, is_wanted)` for `numbers`, in order; who has enough stops iterating."""


class Algorithm(Protocol):
    """What the training loop asks of a learner."""

    env_steps: int
    """Environment steps taken so far, on all ranks."""

    total_timesteps: int
    """Where to stop, on all ranks."""

    cycles_per_epoch: int
    """How often an epoch collects and updates."""

    config: Any
    """Hyperparameters, with those that the environment decides."""

    policy_parts: tuple[str, ...]
    """What of `state_dict` the policy is made of."""

    spaces: Spaces
    """Of the environments it plays in."""

    def describe(self) -> str:
        """What the configuration amounts to, in words."""

    def collect(self) -> dict[str, float]:
        """Gather experience for one cycle; what was seen."""

    def update(self) -> dict[str, float]:
        """Learn from it; losses and the like."""

    def policy(self) -> Policy:
        """What acts now; good until the next update."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the rest of the run depends on, except the experience."""

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken; ValueError, before anything is changed, when the
        learner's own state is another kind."""

    @staticmethod
    def saved_policy(config: Any, spaces: Spaces, saved: dict[str, Any]) -> Policy:
        """The policy in what `state_dict` returned, on the CPU and without a learner around it.

        `config` are the learner's hyperparameters. ValueError when these do not go together.
        """


@runtime_checkable
class OffPolicy(Algorithm, Protocol):
    """A learner that remembers: what it plays is much noisier than what it learns, so that has to be
    tested, and its memory has to fit, be saved, and hold what may be learned from again."""

    replay: Replay
    """Its memory."""

    def check(self) -> None:
        """Raise ValueError when memory is short or the environment's rewards do not fit; plays an
        episode."""

    def test(self) -> dict[str, float]:
        """How good is it without exploration, at the end of an epoch? Empty where not asked."""


def get(name: str) -> tuple[Any, Any]:
    """(Config, Algorithm) by name; PyTorch is imported here and not before."""
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; allowed: {', '.join(ALGORITHMS)}")
    registered = ALGORITHMS[name]
    module = importlib.import_module(registered.module or f".{name}", __name__)
    return getattr(module, registered.config), getattr(module, registered.algorithm)
