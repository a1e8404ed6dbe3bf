"""What the benchmarks print: tables as the docs show them, and how far they are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")


def markdown(head: str, rows: Iterable[Iterable[Any]]) -> None:
    """A table, with its head as it stands in the docs."""
    print(head, "|---" * (head.count("|") - 1) + "|", sep="\n")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |")


def interval(value: float, low: float, high: float, form: str = ".2f", to: str = " – ") -> str:
    """A number with its interval."""
    return f"{value:{form}} ({low:{form}}{to}{high:{form}})"


def progress(things: Iterable[T], what: str, total: int | None = None) -> Iterable[T]:
    """The same things, and on standard error how many of them are done."""
    return track(things, what, total=total, console=Console(stderr=True))
