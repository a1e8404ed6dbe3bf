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
FIRST_ESTIMATE, AT_LATEST = (
    0.02,
    15.0,
)  # share of the work, and s, after which its time is said
UNITS = {"days": 86_400, "h": 3600, "min": 60, "s": 1}


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
        self._done, self._due = 0, 0.0
        self._began = time.monotonic()

    def __call__(self, n: int = 1) -> None:
        """Count `n` more as done."""
        if not self._done and self._what:
            beside.print(self._what)
        self._done += n
        share, spent = self._done / self._total, time.monotonic() - self._began
        is_known = self._due or share >= FIRST_ESTIMATE or spent >= AT_LATEST
        if is_known and self._due <= share < 1:
            left = about(spent * (1 - share) / share)
            percent = f"{100 * share:.{'0f' if share > 0.01 else '2g'}}"
            beside.print(f"{percent} %, about {left} left")
            self._due = int(10 * share + 1) / 10


def about(seconds: float) -> str:
    """Return a time as people say it: "40 s", "24 min", "3 h", "12 days"."""
    unit = next((unit for unit in UNITS if seconds >= 1.5 * UNITS[unit]), "s")
    return f"{seconds / UNITS[unit]:.0f} {unit}"


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
