"""How a command ends: with an error that a user can mend, by Ctrl-C, or with its parent process."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

BAD_INPUT, BUSY = 2, 75
"""Exit codes of commands that did nothing, since the input was wrong, or since another
process is at it (EX_TEMPFAIL of sysexits.h)."""
PR_SET_PDEATHSIG = 1  # of prctl, linux/prctl.h


class InputError(ValueError):
    """One line: what was wrong, what was found, what is allowed. The command exits with 2."""


class BusyError(InputError):
    """Another process has what this one needs; the command exits with `BUSY`."""


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Raise InputError where a package of an extra is missing, for what is imported inside."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(
            f"found no {error.name}, which this needs: pip install 'tactilerl[{name}]'"
        ) from error


@contextmanager
def input_errors(where: str = "") -> Iterator[None]:
    """Turn what library code raises over bad input into an InputError."""
    try:
        yield
    except (InputError, ChildProcessError):  # one line already; no input's fault
        raise
    except (
        ValueError,
        OSError,
        ImportError,
        RuntimeError,
        OverflowError,
        MemoryError,
    ) as error:
        line = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{where}: {line}" if where else line) from error


def leave_at_once() -> None:
    """Let Ctrl-C end the process from now on with one line, wherever it is.

    For a program that has just started: nothing changes where Ctrl-C is handled
    otherwise, or ignored as in the background of a shell. For commands that leave
    nothing behind, and while modules are imported: a KeyboardInterrupt in the middle of
    an import comes out as all kinds of errors.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


@contextmanager
def interrupts_in_order() -> Iterator[None]:
    """Have Ctrl-C raise KeyboardInterrupt again inside, after `leave_at_once`."""
    is_ours = signal.getsignal(signal.SIGINT) is _leave
    if is_ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, _leave)


def end_with(parent: int) -> None:
    """Have this process get SIGTERM when its `parent` ends, however that ends; Linux only."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it has ended already
        os._exit(128 + signal.SIGTERM)


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"tactilerl: interrupted\n")
    os._exit(130)
