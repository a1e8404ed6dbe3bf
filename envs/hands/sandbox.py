"""Call what reads a model in a process of its own: it may hang, crash or fill the memory."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from types import ModuleType
from typing import Any, TypeVar
from unittest import mock

T = TypeVar("T")
CPU_SECONDS, SECONDS = 30, 300
"""Limits of reading, s: on a processor, and by the clock, which counts where a file is waited for."""
MAX_MEMORY = 8 * 2**30  # bytes of address space


def call(function: Callable[..., T], *args: Any) -> T:
    """Return what a function of a module returns.

    Its ValueErrors, OSErrors and ImportErrors are raised here. Raise ValueError where it takes too long
    or too much memory, or ends its process.
    """
    if multiprocessing.parent_process() is not None:  # whoever started it has called it
        return function(*args)
    spawned = multiprocessing.get_context("spawn")
    limits = os.getcwd(), CPU_SECONDS
    # The child has no use for this program, which may be a script without a guard.
    with (
        mock.patch.dict(sys.modules, {"__main__": ModuleType("__main__")}),
        ProcessPoolExecutor(1, spawned, _limit, limits) as pool,
    ):
        try:
            return pool.submit(function, *args).result()
        except (ValueError, OSError, ImportError):
            raise
        except BrokenProcessPool:
            how = (
                f"breaks MuJoCo's reader, or takes longer than {CPU_SECONDS} s to read"
            )
        except MemoryError:
            how = f"needs more than {MAX_MEMORY >> 30} GB to read"
        except Exception as error:  # whatever MuJoCo or a parser raises
            line = " ".join(str(error).split())[:300]
            raise ValueError(f"model: {type(error).__name__}: {line}") from None
    raise ValueError(f"the model {how}; make it smaller, or drop what is no hand")


def _limit(folder: str, cpu_seconds: int) -> None:
    """Limit a process that has just begun, have it work in a folder, and say nothing."""
    os.chdir(folder)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    with suppress(ImportError, AttributeError, ValueError, OSError):  # not everywhere
        import resource

        signal.alarm(SECONDS)
        for limit, value in (("AS", MAX_MEMORY), ("CPU", cpu_seconds), ("CORE", 0)):
            resource.setrlimit(getattr(resource, f"RLIMIT_{limit}"), (value, value))
