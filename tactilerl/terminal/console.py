"""Print for people: one line stays one line however wide the terminal is."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import Progress

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
) -> Iterator[Callable[[], None]]:
    """Show a bar on standard error, where that is a terminal.

    Yields a function to be called whenever one more is done.
    """
    screen = Console(stderr=True)
    is_hidden = not (is_shown and screen.is_terminal)
    with Progress(console=screen, transient=True, disable=is_hidden) as bar:
        yield partial(bar.advance, bar.add_task(what, total=total))
