"""End processes: by Ctrl-C, on the spot or in order, or with the process that started them."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn


def leave_at_once() -> None:
    """Let Ctrl-C end the process from now on with one line, wherever it is.

    For a program that has just started: nothing changes where Ctrl-C is handled otherwise, or ignored
    as in the background of a shell. For commands that leave nothing behind, and while modules are
    imported: a KeyboardInterrupt in the middle of an import comes out as all kinds of errors.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


@contextmanager
def in_order() -> Iterator[None]:
    """Have Ctrl-C raise KeyboardInterrupt again inside, after `leave_at_once`."""
    is_ours = signal.getsignal(signal.SIGINT) is _leave
    if is_ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, _leave)


PR_SET_PDEATHSIG = 1  # of prctl, linux/prctl.h


def end_with(parent: int) -> None:
    """Have this process get SIGTERM when its `parent` ends, however that ends; Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it has ended already
        os._exit(128 + signal.SIGTERM)


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"tactilerl: interrupted\n")
    os._exit(130)
