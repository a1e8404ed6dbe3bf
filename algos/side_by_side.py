"""Two computations at the same time, where there is a core for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import TypeVar

import torch

from .mpi import Communicator

A = TypeVar("A")
B = TypeVar("B")


def may_share(cores: int, comm: Communicator, device: torch.device) -> bool:
    """May a learner that is allowed so many cores compute on two? Not in one process of several, which
    exchange messages one after another, nor on a GPU, which takes one thing after another anyway."""
    return cores > 1 and comm.size == 1 and device.type == "cpu"


def each(compute: Callable[[A], torch.Tensor], parts: Iterable[A]) -> torch.Tensor:
    """What `compute` says of one part after another, stacked."""
    return torch.stack([compute(part) for part in parts])


class SideBySide:
    """Runs two functions that share nothing they write to: PyTorch lets go of Python's lock while it
    computes. What comes out does not depend on whether they run at once or in turn."""

    def __init__(self, at_once: bool) -> None:
        threads = partial(torch.set_num_threads, torch.get_num_threads())
        self._other = ThreadPoolExecutor(1, initializer=threads) if at_once else None

    def __call__(self, first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
        """What both return; when one raises, so does this, once both have ended."""
        if self._other is None:
            return first(), second()
        later = self._other.submit(second)
        try:
            own = first()
        finally:
            wait([later])
        return own, later.result()
