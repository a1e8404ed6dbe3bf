"""What a user can mend."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(Exception):
    """One line: what was wrong, what was found, what is allowed. The command exits with 2."""


@contextmanager
def input_errors(where: str = "") -> Iterator[None]:
    """Turn what library code raises over bad input into an InputError."""
    try:
        yield
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        line = " ".join(str(error).split())
        raise InputError(f"{where}: {line}" if where else line) from error
