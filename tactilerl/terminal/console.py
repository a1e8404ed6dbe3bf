"""Print for people: one line stays one line however wide the terminal is."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import Progress

console = Console(highlight=False, soft_wrap=True, markup=False)
beside = Console(stderr=True, soft_wrap=True, markup=False)
"""Console on standard error, for notes that are no result."""
COLUMNS = 100
FIRST_ESTIMATE = 0.02  # share of the work after which its time is said


def paragraph(label: str, text: str) -> str:
    """Return lines of at most COLUMNS: a label, and the text to the right of it."""
    return textwrap.fill(
        text, COLUMNS, initial_indent=f"  {label:8} ", subsequent_indent=11 * " ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


class Tenths:
    """Print on standard error what is done, how long it will take, and every tenth of it."""

    def __init__(self, what: str, total: int) -> None:
        """Say nothing before something is done: what is wrong may need no playing."""
        self._what, self._total = what, total
        self._done, self._due = 0, FIRST_ESTIMATE
        self._began = time.monotonic()

    def __call__(self, n: int = 1) -> None:
        """Count `n` more as done."""
        if not self._done:
            beside.print(self._what)
        self._done += n
        share = self._done / self._total
        if self._due <= share < 1:
            left = (time.monotonic() - self._began) * (1 - share) / share
            about = f"{left / 60:.0f} min" if left > 90 else f"{left:.0f} s"
            beside.print(f"{100 * share:.0f} %, about {about} left")
            self._due = int(10 * share + 1) / 10


@contextmanager
def progress(
    what: str, total: int | None = None, is_shown: bool = True, is_long: bool = False
) -> Iterator[Callable[..., None]]:
    """Show a bar on standard error, where that is a terminal; elsewhere `Tenths` of what `is_long`.

    Yields a function to be called whenever one more is done, or with a number whenever as many are.
    """
    screen = Console(stderr=True)
    if is_shown and is_long and total and not screen.is_terminal:
        yield Tenths(what, total)
        return
    is_hidden = not (is_shown and screen.is_terminal)
    with Progress(console=screen, transient=True, disable=is_hidden) as bar:
        yield partial(bar.advance, bar.add_task(what, total=total))
