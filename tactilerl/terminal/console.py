"""Print for people: one line stays one line however wide the terminal is."""

from __future__ import annotations

import textwrap
import time

from rich.console import Console

console = Console(highlight=False, soft_wrap=True, markup=False)
beside = Console(stderr=True, soft_wrap=True, markup=False)
"""Console on standard error, for notes that are no result."""
COLUMNS = 100
FIRST = 5.0  # s of work, before which nothing is said of its time
UNITS = {"days": 86_400, "h": 3600, "min": 60, "s": 1}


def paragraph(label: str, text: str) -> str:
    """Return lines of at most COLUMNS: a label, and the text to the right of it."""
    return textwrap.fill(
        text, COLUMNS, initial_indent=f"  {label:8} ", subsequent_indent=11 * " ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


class Progress:
    """Say at every tenth of long work how much is done, and how long the rest takes."""

    def __init__(self, what: str, total: int) -> None:
        """Say nothing at first: what is wrong may need no work, and short work no words."""
        self._what, self._total = what, total
        self._done, self._due = 0, 0.0
        self._began = time.monotonic()

    def __call__(self) -> None:
        """Count one more as done."""
        self._done += 1
        share, spent = self._done / self._total, time.monotonic() - self._began
        if spent >= FIRST and self._due <= share < 1:
            left = about(spent * (1 - share) / share)
            percent = f"{100 * share:.{'0f' if share > 0.01 else '2g'}}"
            beside.print(f"{self._what}: {percent} %, about {left} left")
            self._due = int(10 * share + 1) / 10


def about(seconds: float) -> str:
    """Return a time as people say it: "40 s", "24 min", "3 h", "12 days"."""
    unit = next((unit for unit in UNITS if seconds >= 1.5 * UNITS[unit]), "s")
    return f"{seconds / UNITS[unit]:.0f} {unit}"
