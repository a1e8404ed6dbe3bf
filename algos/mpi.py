"""All of MPI: who am I, and how to sum, gather and agree.

mpi4py is imported only under an MPI launcher, so that nobody else needs it.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from . import Communicator as Communicator

if TYPE_CHECKING:
    from torch import Tensor

RANKS = (
    "OMPI_COMM_WORLD_RANK",
    "PMI_RANK",
    "PMIX_RANK",
    "MPI_LOCALRANKID",
)  # set by launchers
SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS", "MPI_LOCALNRANKS")


class MPICommunicator(Communicator):
    """The processes of one MPI launch."""

    def __init__(self) -> None:
        try:
            from mpi4py import MPI
        except (ImportError, RuntimeError) as error:
            raise ImportError(
                f"started by an MPI launcher, but mpi4py cannot be loaded ({error}); "
                "install the extra: pip install 'tactilerl[mpi]'"
            ) from error
        self._mpi = MPI
        self._comm = MPI.COMM_WORLD
        self.rank = self._comm.Get_rank()
        self.size = self._comm.Get_size()
        self.local_size = self._comm.Split_type(MPI.COMM_TYPE_SHARED).Get_size()

    def sum_(self, tensor: Tensor) -> None:
        on_host = tensor.detach().cpu()
        self._comm.Allreduce(self._mpi.IN_PLACE, on_host.numpy(), op=self._mpi.SUM)
        if on_host.data_ptr() != tensor.data_ptr():
            tensor.detach().copy_(on_host)

    def sum(self, values: np.ndarray) -> np.ndarray:
        total = np.empty_like(values, dtype=np.float64)
        self._comm.Allreduce(np.asarray(values, np.float64), total, op=self._mpi.SUM)
        return total

    def all_gather(self, value: Any) -> list[Any]:
        return list(self._comm.allgather(value))


def launched_rank() -> str | None:
    """Return the rank that an MPI launcher gave this process; None without a launcher."""
    return next((os.environ[name] for name in RANKS if name in os.environ), None)


def world() -> Communicator:
    """Return all ranks of this launch; a lone Communicator without a launcher or for a launch of one.

    Without mpi4py, rank 0 of a launch whose size nobody told is alone. ImportError on
    several ranks.
    """
    size = next((os.environ[name] for name in SIZES if name in os.environ), None)
    if launched_rank() is None or size == "1":
        return Communicator()
    try:
        return MPICommunicator()
    except ImportError:
        if size is None and launched_rank() == "0":  # most likely a launch of one
            return Communicator()
        raise


def abort(code: int) -> None:
    """End every rank at once, when there are several: the others would wait for this one."""
    if "mpi4py.MPI" in sys.modules:
        comm = sys.modules["mpi4py.MPI"].COMM_WORLD
        if comm.Get_size() > 1:
            sys.stdout.flush()
            sys.stderr.flush()
            comm.Abort(code)
