"""How the benchmarks measure time: contenders in turn on one machine, and what is shown of it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table

ROUNDS = 7
Contender = Callable[[], int]
"""Does its work once and says how many things it did."""
Clock = Callable[[], float]
"""`time.perf_counter`; for work of one process and thread `time.process_time`, which stands still
while the machine does something else."""


def per_second(run: Contender, clock: Clock = time.perf_counter) -> float:
    """Things done per second of one call."""
    started = clock()
    return run() / (clock() - started)


def rounds(contenders: dict[str, Contender], clock: Clock = time.perf_counter) -> dict[str, float]:
    """Median rate of each contender; they take turns, after one round to warm up."""
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    for round_ in range(ROUNDS + 1):
        for name, run in contenders.items():
            rate = per_second(run, clock)
            if round_:
                rates[name].append(rate)
    return {name: statistics.median(values) for name, values in rates.items()}


def quotients(rates: dict[str, float], *pairs: tuple[str, str]) -> dict[str, float]:
    """The first's rate over the second's, for pairs of names."""
    return {f"{a} / {b}": rates[a] / rates[b] for a, b in pairs}


def show(title: str, rates: dict[str, float], ratios: dict[str, float]) -> None:
    """One table."""
    table = Table("", "per second", title=title)
    for name, rate in rates.items():
        table.add_row(name, f"{rate:,.0f}")
    table.add_section()
    for name, ratio in ratios.items():
        table.add_row(name, f"{ratio:.2f} ×")
    Console().print(table)


class Watches:
    """Seconds spent in some methods; what one of them spends in another counts for both."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def watch(self, name: str, thing: Any, method: str) -> None:
        """Count the time of `thing.method` as `name`."""
        run = getattr(thing, method)
        self.seconds.setdefault(name, 0.0)

        def timed(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            try:
                return run(*args, **kwargs)
            finally:
                self.seconds[name] += time.perf_counter() - started

        setattr(thing, method, timed)
