"""What the training loop asks of a learner, and what the learners here have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from . import DivergenceError, Workers
from .mpi import Communicator, same_on_all_ranks
from .networks import FlatAdam
from .side_by_side import SideBySide
from .spaces import Spaces, flat_size

if TYPE_CHECKING:
    from .policy import Policy

NAMES_OF_0_3 = {
    "spread": "gaussian",
    "log": "log_std",
    "truth_stats": "privileged_stats",
}


def progress_remaining(env_steps: int, total_timesteps: int) -> float:
    """Of a run, from 1 to 0."""
    return max(0.0, 1.0 - env_steps / total_timesteps)


class Learner:
    """A subclass says how it is built, collects, updates and acts. Random numbers follow from the seed
    and the counters, so these and the states of its parts are all that a checkpoint needs."""

    policy_parts: ClassVar[Sequence[str]]
    """Attributes that its policy is made of."""
    saved: ClassVar[Sequence[str]]
    """Attributes that have states of their own, the policy's among them."""
    counters: ClassVar[Sequence[str]]
    """Attributes that are numbers."""
    cycles_per_epoch = 1
    """How often an epoch collects and updates."""
    replay: Any = None
    """The `Replay` of a learner that remembers."""

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
        """For environments of `workers`, until `total_timesteps` over all ranks. ValueError where
        hyperparameters or spaces do not fit. On one of several ranks there is one core, as messages
        are exchanged one after another."""
        config.validate()
        self.config, self.workers, self.comm = config, workers, comm
        self.seed, self.total_timesteps, self.device = (
            seed,
            total_timesteps,
            torch.device(device),
        )
        self.spaces = Spaces(workers.observation_space, workers.action_space)
        self._n_obs = flat_size(self.spaces.observation)
        self.side_by_side = SideBySide(
            cores > 1 and comm.size == 1 and self.device.type == "cpu"
        )
        self.env_steps = 0  # so far, on all ranks
        self.build(torch.Generator().manual_seed(seed))

    def build(self, generator: torch.Generator) -> None:
        """Networks, with weights drawn from `generator`, optimisers and whatever else it has."""
        raise NotImplementedError

    def check(self) -> None:
        """ValueError where rewards or this machine's memory do not fit; may play an episode."""

    def describe(self) -> str:
        """What the configuration amounts to, in words."""
        raise NotImplementedError

    def policy(self) -> Policy:
        """What acts now; good until the next update."""
        raise NotImplementedError

    def collect(self) -> dict[str, float]:
        """Gather experience for one cycle; counts and means of its episodes."""
        raise NotImplementedError

    def update(self) -> dict[str, float]:
        """Learn from it; losses and the like."""
        raise NotImplementedError

    def test(self) -> dict[str, float]:
        """How good it is without exploration, at the end of an epoch; empty where not asked."""
        return {}

    @staticmethod
    def saved_policy(config: Any, spaces: Spaces, saved: dict[str, Any]) -> Policy:
        """The policy in what `state_dict` returned, on the CPU and without a learner around it.

        `config` are the learner's hyperparameters. ValueError when these do not go together.
        """
        raise NotImplementedError

    @property
    def progress_remaining(self) -> float:
        """Of the run, from 1 to 0."""
        return progress_remaining(self.env_steps, self.total_timesteps)

    def _require_finite(self, losses: Tensor, *adams: FlatAdam) -> None:
        """DivergenceError, rather than going on from losses or parameters that are not finite."""
        if not all(
            torch.isfinite(values).all()
            for values in (losses, *(a.vector for a in adams))
        ):
            raise DivergenceError(
                f"a loss or a parameter is not finite after {self.env_steps} steps "
                f"(losses {[f'{x:.3g}' for x in losses.tolist()]})"
            )

    def _require_same(self, *tensors: Tensor) -> None:
        """DivergenceError where the ranks have parted."""
        if not all(same_on_all_ranks(self.comm, tensor) for tensor in tensors):
            raise DivergenceError("the ranks' parameters differ")

    # -- saving ------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything that the rest of the run depends on, except what it remembers."""
        states = {name: getattr(self, name).state_dict() for name in self.saved}
        return states | {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken. ValueError where it has other parts: files have
        checksums, so a state may only be another learner's or version's."""
        if self.state_dict().keys() != (state := with_current_names(state)).keys():
            different = ", ".join(sorted(self.state_dict().keys() ^ state.keys()))
            raise ValueError(
                f"state: {different}: missing, or unknown; finish a run with its version"
            )
        restore({name: getattr(self, name) for name in self.saved}, state)
        for name in self.counters:
            setattr(self, name, state[name])


def restore(parts: Mapping[str, Any], state: dict[str, Any]) -> None:
    """Put back parts, by name, of a learner's state; ValueError where one is missing."""
    state = with_current_names(state)
    if missing := parts.keys() - state.keys():
        raise ValueError(f"state: {', '.join(sorted(missing))}: missing")
    for name, part in parts.items():
        part.load_state_dict(state[name])


def with_current_names(state: Any) -> Any:
    """A state that 0.3.0 may have written, all the way down."""
    if not isinstance(state, dict):
        return state
    return {
        NAMES_OF_0_3.get(name, name): with_current_names(part)
        for name, part in state.items()
    }
