"""What benchmarks share: command lines, processes, timing, tables and JSON."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import time
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[1]  # where `python -m benchmarks` runs
DOCS = ROOT / "docs"
DATA = DOCS / "data"


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the flag --out, for a benchmark with this docstring."""
    flags = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    flags.add_argument("--out", type=Path, help="write JSON here")
    return flags


def no_flags(description: str | None) -> None:
    """Read the command line of a benchmark that has no flag but --help."""
    argparse.ArgumentParser(description=(description or "").splitlines()[0]).parse_args()


def count(text: str) -> int:
    """Return a flag's whole number, from 1 to a million."""
    if not text.isdecimal() or not 1 <= int(text) <= 1_000_000:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed 1 to 1000000")
    return int(text)


def processes(n: int | None) -> ProcessPoolExecutor:
    """Return a pool of `n` fresh processes, which share nothing with this one."""
    return ProcessPoolExecutor(n, multiprocessing.get_context("spawn"))


def on_one_thread() -> None:
    """Let PyTorch use one thread in this process, and silence warnings between the tables."""
    import torch  # not for `figures`

    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")


def earlier(path: Path | None) -> dict[str, Any]:
    """Return what an earlier run wrote there, or an empty dict."""
    return json.loads(path.read_text(encoding="utf-8")) if path and path.exists() else {}


def data(name: str) -> Any:
    """Return the content of a JSON file in docs/data."""
    return json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))


def write(path: Path | None, result: Any) -> None:
    """Write JSON where it was asked for."""
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def measure_missing(path: Path | None, measures: dict[str, Callable[[], Any]]) -> dict[str, Any]:
    """Return what is known of all `measures`; write after each that was not in the file."""
    known = earlier(path)
    for name, measure in measures.items():
        if name not in known:
            known[name] = measure()
            write(path, known)
    return known


# -- tables and progress ---------------------------------------------------------------------


def markdown(head: str, rows: Iterable[Iterable[Any]]) -> None:
    """Print a table; its head is given as it stands in the docs."""
    print(head, "|---" * (head.count("|") - 1) + "|", sep="\n")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |")


def interval(value: float, low: float, high: float, form: str = ".2f", to: str = " – ") -> str:
    """Return a number with its interval, as text."""
    return f"{value:{form}} ({low:{form}}{to}{high:{form}})"


def progress(items: Iterable[T], what: str, total: int | None = None) -> Iterable[T]:
    """Yield the same items, and show on standard error how many of them are done."""
    return track(items, what, total=total, console=Console(stderr=True))


# -- timing: contenders in turn on one machine -----------------------------------------------

ROUNDS = 7
Contender = Callable[[], int]
"""Works once, and returns how many items it did."""


def contest(contenders: dict[str, Contender], *pairs: tuple[str, str]) -> dict[str, Any]:
    """Return median rates, and for each pair of names the ratio of the first to the second.

    Contenders take turns, after a round to warm up. Seconds are the processor's, which stand still
    while the machine does something else.
    """

    def per_second(run: Contender) -> float:
        started = time.process_time()
        return run() / (time.process_time() - started)

    turns = [[per_second(run) for run in contenders.values()] for _ in range(ROUNDS + 1)]
    medians = map(statistics.median, zip(*turns[1:], strict=True))
    rates = dict(zip(contenders, medians, strict=True))
    return {"per_s": rates, "ratios": {f"{a} / {b}": rates[a] / rates[b] for a, b in pairs}}
