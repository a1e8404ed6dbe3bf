"""What both learners are made of, however they learn."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from . import DivergenceError, Workers
from .mpi import Communicator, same_on_all_ranks
from .networks import FlatAdam
from .side_by_side import SideBySide
from .spaces import Spaces, flat_size
from .state import Saved


class Learner(Saved):
    """Who plays, who else learns, and how far the run is."""

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
        """ValueError where the hyperparameters or the spaces do not fit. On one of several ranks there
        is one core, as messages are exchanged one after another."""
        config.validate()
        self.config, self.workers, self.comm = config, workers, comm
        self.seed, self.total_timesteps, self.device = seed, total_timesteps, torch.device(device)
        self.spaces = Spaces(workers.observation_space, workers.action_space)
        self._n_obs = flat_size(self.spaces.observation)
        self.side_by_side = SideBySide(cores > 1 and comm.size == 1 and self.device.type == "cpu")
        self.env_steps = 0

    @property
    def progress_remaining(self) -> float:
        """Of the run, from 1 to 0."""
        return max(0.0, 1.0 - self.env_steps / self.total_timesteps)

    def _require_finite(self, losses: Tensor, *adams: FlatAdam) -> None:
        """DivergenceError, rather than going on from losses or parameters that are not finite."""
        if not all(torch.isfinite(values).all() for values in (losses, *(a.vector for a in adams))):
            raise DivergenceError(
                f"a loss or a parameter is not finite after {self.env_steps} steps "
                f"(losses {[f'{x:.3g}' for x in losses.tolist()]})"
            )

    def _require_same(self, *tensors: Tensor) -> None:
        """DivergenceError where the ranks have parted."""
        if not all(same_on_all_ranks(self.comm, tensor) for tensor in tensors):
            raise DivergenceError("the ranks' parameters differ")
