"""TOML files of anybody: layouts, scenes."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

LARGEST = 1_000_000  # bytes


def read(path: Path, what: str) -> dict[str, Any]:
    """The content of a file, called `what` in errors: ValueError naming what is wrong with it, and
    FileNotFoundError."""
    if not os.path.isfile(path):  # False for any name; Path.is_file raises when it is too long
        raise FileNotFoundError(f"{what} {str(path)!r} does not exist")
    try:
        with path.open("rb") as file:
            return tomllib.loads(file.read(LARGEST).decode("utf-8"))
    except RecursionError:
        raise ValueError(f"{what} {path}: nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{what} {path}: not valid TOML: {error}") from None
