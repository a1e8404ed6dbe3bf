"""Define the learner that the training loop calls, and what all learners here have in common."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, ClassVar, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector
from torch.utils._pytree import tree_map_only

from . import Array, Communicator, Workers, rollout
from .policy import Policy, Spaces, finite, flat_size
from .rollout import Key, PlayEpisode, summary

A = TypeVar("A")
B = TypeVar("B")


def progress_remaining(env_steps: int, total_timesteps: int) -> float:
    """Return what is left of a run, from 1 to 0."""
    return max(0.0, 1.0 - env_steps / total_timesteps)


class LearnerConfig:
    """Hold a learner's hyperparameters; a subclass is a frozen dataclass, whose fields become flags."""

    @property
    def anneals(self) -> bool:
        """True if the course of a run depends on how long it will be."""
        return False

    def acting(self, remaining: float) -> Self:
        """Return a copy with annealed exploration noise; `remaining` falls from 1 to 0 over a run."""
        return self

    @property
    def explores(self) -> bool:
        """True if a policy that acts by this configuration has exploration noise."""
        return True

    def validate(self) -> None:
        """Raise ValueError naming what does not go together; ranges are in the types."""


class Learner(ABC):
    """Learn from episodes: `collect` and `update` in turn. A subclass is one algorithm.

    Random numbers follow from the seed and the counters, so these and the states of its
    parts are all that a checkpoint needs after `update`. Networks start from the seed
    alone, so they are the same on all ranks.
    """

    policy_parts: ClassVar[Sequence[str]]
    """Attributes that its policy is made of."""
    saved: ClassVar[Sequence[str]]
    """Attributes that have states of their own, the policy's among them."""
    plain: ClassVar[Sequence[str]]
    """Attributes that are saved as they are: numbers, or dicts of numbers and
    tensors."""
    cycles_per_epoch = 1
    """Number of times that an epoch collects and updates."""
    n_tests = 0
    """Number of episodes of a test at the end of an epoch."""
    replay: Any = None
    """The `Replay` of an off-policy learner."""

    def __init__(
        self,
        config: Any,
        workers: Workers,
        comm: Communicator,
        seed: int,
        total_timesteps: int,
        device: str = "cpu",
        cores: int = 1,
    ) -> None:
        """Prepare to learn in `workers` until `total_timesteps` over all ranks.

        Raises ValueError where hyperparameters or spaces do not fit. With several
        ranks, each learns on one core, whatever `cores` says.
        """
        config.validate()
        self.config, self.workers, self.comm = config, workers, comm
        self.seed, self.total_timesteps = seed, total_timesteps
        self.device = torch.device(device)
        self.spaces = Spaces(workers.observation_space, workers.action_space)
        self.n_inputs = flat_size(self.spaces.observation)  # of the networks
        self.env_steps = 0  # so far, on all ranks
        self._second_thread: ThreadPoolExecutor | None = None
        is_free = cores > 1 and torch.get_num_threads() == 1
        if is_free and comm.size == 1 and self.device.type == "cpu":
            self._second_thread = second_thread()
        self.build(torch.Generator().manual_seed(seed))

    @abstractmethod
    def build(self, generator: torch.Generator) -> None:
        """Make networks, with weights drawn from `generator`, optimizers and all else it has."""

    def check(self) -> None:
        """Raise ValueError where rewards do not fit; may play an episode."""

    @abstractmethod
    def describe(self) -> str:
        """Return in words what the configuration amounts to."""

    @staticmethod
    def new_parts(
        config: Any, spaces: Spaces, comm: Communicator, generator: torch.Generator
    ) -> dict[str, Any]:
        """Return what a policy is made of, named as `policy_parts`, before anything was learned."""
        raise NotImplementedError

    @staticmethod
    def as_policy(config: Any, spaces: Spaces, *parts: Any) -> Policy:
        """Return the policy that these parts make."""
        raise NotImplementedError

    def policy(self) -> Policy:
        """Return what acts now; on the CPU it shares the actor's weights, so only until `update`."""
        config = self.config.acting(self.progress_remaining)
        parts = (getattr(self, name) for name in self.policy_parts)
        return self.as_policy(config, self.spaces, *parts)

    @abstractmethod
    def collect(self) -> dict[str, float]:
        """Gather experience for one cycle; return counts and means of its episodes."""

    @abstractmethod
    def update(self) -> dict[str, float]:
        """Learn from what was collected; return losses and other metrics."""

    def key(self, purpose: int) -> Key:
        """Return the key of random numbers for a purpose of `rollout`; a learner with tests has one."""
        raise NotImplementedError

    def player(self, purpose: int) -> PlayEpisode:
        """Return what plays this rank's episodes, for a purpose of `rollout`."""
        explores = purpose != rollout.TEST
        return PlayEpisode(self.policy(), self.key(purpose), explores)

    @property
    def is_tested(self) -> bool:
        """True if this epoch ends with a test."""
        return self.n_tests > 0

    def test(self) -> dict[str, float]:
        """Return how good it is without exploration.

        NaN where an epoch has no test; empty where none has.
        """
        if not self.is_tested:
            return tested({}) if self.n_tests else {}
        job = self.player(rollout.TEST)
        episodes = [*self.workers.play(job, range(self.n_tests))]
        return tested(summary(episodes, self.comm))

    @classmethod
    def saved_policy(cls, config: Any, spaces: Spaces, saved: dict[str, Any]) -> Policy:
        """Return the policy in what `state_dict` returned, on the CPU, without a learner around it.

        `config` are the learner's hyperparameters.
        """
        parts = cls.new_parts(config, spaces, Communicator(), torch.Generator())
        restore(parts, saved)
        return cls.as_policy(config, spaces, *parts.values())

    @property
    def progress_remaining(self) -> float:
        """Fraction of the run that is left; falls from 1 to 0."""
        return progress_remaining(self.env_steps, self.total_timesteps)

    # -- shared steps of learning ------------------------------------------------------------

    def adam(self, parameters: list[nn.Parameter], lr: float) -> torch.optim.Adam:
        """Return Adam (Kingma & Ba 2014) on `parameters`."""
        group = {"params": parameters, "initial_lr": lr}
        return torch.optim.Adam([group], lr, fused=True)

    def anneal(self, *adams: torch.optim.Adam) -> None:
        """Set learning rates to what is left of the run, from 1 to 0, times those at its start."""
        for adam in adams:
            for group in adam.param_groups:
                group["lr"] = self.progress_remaining * group["initial_lr"]

    def in_two_threads(
        self, first: Callable[[], A], second: Callable[[], B]
    ) -> tuple[A, B]:
        """Return what both functions return, computed at the same time where there are two cores.

        They must share nothing that they write to; then the results do not depend on
        the cores. PyTorch lets go of Python's lock while it computes. An error of
        either is raised once both have ended.
        """
        if self._second_thread is None:
            return first(), second()
        future = self._second_thread.submit(second)
        try:
            result = first()
        finally:
            wait([future])
        return result, future.result()

    def check_learned(self, losses: Sequence[float], *networks: nn.Module) -> None:
        """Raise DivergenceError rather than go on from losses or parameters that are not finite."""
        weights = (parameters_to_vector(network.parameters()) for network in networks)
        for values in (torch.tensor(losses), *weights):
            what = f"a loss or a parameter after {self.env_steps} steps"
            finite(values.detach().cpu().numpy(), what)

    # -- saving ------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return what the rest of the run depends on; a replay is saved by itself."""
        state = states({name: getattr(self, name) for name in self.saved})
        return state | {name: getattr(self, name) for name in self.plain}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken."""
        restore({name: getattr(self, name) for name in self.saved}, state)
        for name in self.plain:
            setattr(self, name, state[name])


class Counts:
    """Save numbers and flags, which are all that a subclass has."""

    def state_dict(self) -> dict[str, float]:
        """Return them by name."""
        return dict(vars(self))

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Put back what `state_dict` returned."""
        vars(self).update(state)


class RewardScale(Counts):
    """Follow the bounds of a run's rewards (DDPG+HER) and, where asked, the largest return so far.

    Rewards are divided by that scale. As it grows, the critics' last layers shrink, so
    that values in the environment's unit stay (PopArt, van Hasselt et al. 2016).
    """

    def __init__(self, is_running: bool, lowest: float = 0.0) -> None:
        """Begin with rewards between `lowest` and 0; without `is_running`, the scale stays 1."""
        self.is_running, self.lowest, self.highest = is_running, lowest, 0.0
        self.scale = 0.0 if is_running else 1.0  # 0 before the first reward

    @property
    def unit(self) -> float:
        """Return what rewards are divided by."""
        return self.scale or 1.0

    def see(self, rewards: Array) -> None:
        """Widen the bounds to hold these rewards (n,)."""
        self.lowest = min(self.lowest, float(rewards.min()))
        self.highest = max(self.highest, float(rewards.max()))

    def grow(self, scale: float) -> float:
        """Raise a running scale to this, where it is larger; return the factor for critics' outputs."""
        if not self.is_running or scale <= self.scale:
            return 1.0
        # A new critic stays as it is.
        factor = self.scale / scale if self.scale else 1.0
        self.scale = scale
        return factor


def tested(stats: Mapping[str, float]) -> dict[str, float]:
    """Return what the table keeps of test episodes; of none, NaN and no faults."""
    columns = {"success_rate": math.nan, "mean_return": math.nan}
    columns |= dict.fromkeys(rollout.FAULTS, 0.0)
    return {f"test_{name}": stats.get(name, none) for name, none in columns.items()}


def second_thread() -> ThreadPoolExecutor:
    """Start a thread that computes on one core, and treats denormal numbers as zero."""

    def set_up() -> None:
        torch.set_num_threads(1)
        torch.set_flush_denormal(True)

    return ThreadPoolExecutor(1, initializer=set_up)


def states(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Return copies of the states of parts, by name.

    Of tensors that are part of a larger one, as those of a batch of runs are, only the
    part is copied; in order, as a fused Adam takes numbers as they lie in memory.
    """
    state = {name: part.state_dict() for name, part in parts.items()}
    copied = tree_map_only(Tensor, lambda part: part.contiguous().clone(), state)
    return copied  # type: ignore[no-any-return]


def restore(parts: Mapping[str, Any], state: dict[str, Any]) -> None:
    """Put back parts, by name, of a learner's state."""
    for name, part in parts.items():
        part.load_state_dict(copy.deepcopy(state[name]))  # Adam would keep the tensors
