"""TOML files of anybody: layouts, scenes, hands."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LARGEST = 10_000_000  # bytes


def read(path: Path, what: str) -> dict[str, Any]:
    """The content of a file, called `what` in errors: ValueError naming what is wrong with it, and
    FileNotFoundError."""
    if not os.path.isfile(
        path
    ):  # False for any name; Path.is_file raises when it is too long
        raise FileNotFoundError(f"{what} {str(path)!r} does not exist")
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise ValueError(f"found more than {LARGEST:,} bytes")
        return tomllib.loads(content.decode("utf-8"))
    except RecursionError:
        raise ValueError(f"{what} {path}: nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{what} {path}: not valid TOML: {error}") from None


@contextmanager
def blamed(what: str) -> Iterator[None]:
    """ValueErrors inside say of what they are."""
    try:
        yield
    except ValueError as error:
        about = "" if str(error).startswith(what) else f"{what}: "
        raise ValueError(f"{about}{error}") from None


def only(data: dict[str, Any], allowed: set[str], where: str) -> None:
    """ValueError naming the first key that is not allowed."""
    unknown = sorted(set(data) - allowed)
    if unknown:
        raise ValueError(
            f"{where}: unknown key {unknown[0]!r}; allowed: {', '.join(sorted(allowed))}"
        )


def table(
    data: dict[str, Any], key: str, allowed: set[str] | None = None
) -> dict[str, Any]:
    """A table of a file, empty where there is none; ValueError for something else, and for a key in it
    that is not allowed."""
    value = data.get(key, {})
    if not isinstance(value, dict):
        raise ValueError(f"{key}: found {value!r}, expected a table")
    only(value, set(value) if allowed is None else allowed, key)
    return value


def is_number(value: Any, least: float = -1e9, most: float = 1e9) -> bool:
    """Is it one, and in this range?"""
    is_one = isinstance(value, int | float) and not isinstance(value, bool)
    return is_one and least <= value <= most


def number(value: Any, where: str, least: float = -1e9, most: float = 1e9) -> float:
    """A number from `least` to `most`; ValueError for anything else."""
    if not is_number(value, least, most):
        raise ValueError(
            f"{where}: found {value!r}, expected a number{_span(least, most)}"
        )
    return float(value)


def vector(
    value: Any, n: int, where: str, least: float = -1e9, most: float = 1e9
) -> tuple[float, ...]:
    """`n` numbers from `least` to `most`; ValueError for anything else."""
    is_list = isinstance(value, list | tuple) and len(value) == n
    if not is_list or not all(is_number(x, least, most) for x in value):
        raise ValueError(
            f"{where}: found {value!r}, expected {n} numbers{_span(least, most)}"
        )
    return tuple(float(x) for x in value)


def interval(
    value: Any, where: str, least: float = -1e9, most: float = 1e9
) -> tuple[float, ...]:
    """(low, high), the first below the second; ValueError for anything else."""
    low, high = vector(value, 2, where, least, most)
    if low >= high:
        raise ValueError(f"{where}: found {value!r}, expected the lower end first")
    return low, high


def _span(least: float, most: float) -> str:
    return f" from {least:g}" * (least > -1e9) + f" to {most:g}" * (most < 1e9)


def strings(value: Any, where: str) -> tuple[str, ...]:
    """One or more strings; ValueError for anything else."""
    if (
        not isinstance(value, list)
        or not value
        or not all(isinstance(item, str) for item in value)
    ):
        raise ValueError(f"{where}: found {value!r}, expected a list of names")
    if len(set(value)) < len(value):
        raise ValueError(f"{where}: found {value!r}, expected each name once")
    return tuple(value)
