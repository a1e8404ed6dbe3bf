"""Print for people: one line stays one line however wide the terminal is."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

console = Console(highlight=False, soft_wrap=True, markup=False)
beside = Console(stderr=True, soft_wrap=True, markup=False)
"""Console on standard error, for notes that are no result."""
COLUMNS = 100


def paragraph(label: str, text: str) -> str:
    """Return lines of at most COLUMNS: a label, and the text to the right of it."""
    return textwrap.fill(
        text, COLUMNS, initial_indent=f"  {label:8} ", subsequent_indent=11 * " ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


@contextmanager
def progress(
    what: str, total: int | None = None, is_shown: bool = True
) -> Iterator[Callable[..., None]]:
    """Show a bar on standard error, or one line where that is no terminal.

    Yields a function to be called as work goes on: with how much is done, and perhaps of how much;
    without arguments, one more is done.
    """
    screen = Console(stderr=True)
    begun = iter([f"{what} ..."] if is_shown and not screen.is_terminal else [])
    columns = TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(
        *columns,
        console=screen,
        transient=True,
        disable=not (is_shown and screen.is_terminal),
    ) as bar:
        task = bar.add_task("", total=total)

        def show(done: int | None = None, of: int | None = None) -> None:
            for line in begun:
                screen.print(line)
            bar.update(
                task, completed=done, total=of, advance=1 if done is None else None
            )

        yield show
