"""How the benchmarks measure time: contenders in turn on one machine."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

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
    turns = [[per_second(run, clock) for run in contenders.values()] for _ in range(ROUNDS + 1)]
    return dict(zip(contenders, map(statistics.median, zip(*turns[1:], strict=True)), strict=True))


def contest(rates: dict[str, float], *pairs: tuple[str, str]) -> dict[str, Any]:
    """Rates, and for pairs of names the first's over the second's."""
    return {"per_s": rates, "ratios": {f"{a} / {b}": rates[a] / rates[b] for a, b in pairs}}
