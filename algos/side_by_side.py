"""Two computations at the same time, where there is a core for each."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import TypeVar

import torch

A = TypeVar("A")
B = TypeVar("B")


class SideBySide:
    """Runs two functions that share nothing they write to: PyTorch lets go of Python's lock while it
    computes. What comes out does not depend on whether they run at once or in turn."""

    def __init__(self, on_two_cores: bool) -> None:
        threads = partial(torch.set_num_threads, torch.get_num_threads())
        self._other = (
            ThreadPoolExecutor(1, initializer=threads) if on_two_cores else None
        )

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
