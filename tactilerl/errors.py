"""Define the errors that a user can mend, and the names that people know from other libraries."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

BAD_INPUT, BUSY = 2, 75
"""Exit codes of commands that did nothing, since the input was wrong, or since another process is at it
(EX_TEMPFAIL of sysexits.h)."""


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
    except InputError:  # is one line already
        raise
    except (
        ValueError,
        OSError,
        ImportError,
        RuntimeError,
        OverflowError,
        MemoryError,
    ) as error:
        line = " ".join(str(error).split())
        raise InputError(f"{where}: {line}" if where else line) from error
