"""What the benchmarks print: tables on the terminal, tables of the docs, and how far they are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track
from rich.table import Table

T = TypeVar("T")
WIDTH = 200  # a table takes what it needs of it


def show(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """A table on the terminal. A row with nothing in it is a gap."""
    table = Table(title=title)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    for row in rows:
        table.add_row(*map(str, row))
    Console(width=WIDTH).print(table)


def markdown(head: str, rows: Iterable[Iterable[Any]]) -> None:
    """A table of the docs, with its head as it stands there."""
    print(head, "|---" * (head.count("|") - 1) + "|", sep="\n")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |")


def interval(value: float, low: float, high: float, form: str = ".2f", to: str = " – ") -> str:
    """A number with its interval."""
    return f"{value:{form}} ({low:{form}}{to}{high:{form}})"


def progress(things: Iterable[T], what: str, total: int | None = None) -> Iterable[T]:
    """The same things, and on standard error how many of them are done."""
    return track(things, what, total=total, console=Console(stderr=True))
