"""What the benchmarks' command lines have in common: a description, parts, runs side by side, JSON."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path
from typing import Any

from .printing import progress

ROOT = Path(__file__).resolve().parents[1]  # where `python -m benchmarks` runs
DOCS = ROOT / "docs"
DATA = DOCS / "data"
Part = tuple[Callable[[], dict[str, Any]], Callable[[dict[str, Any]], None]]
"""What measures a part of a benchmark, and what shows what came out."""


def parser(description: str | None) -> argparse.ArgumentParser:
    """Flags of a benchmark with this docstring: --out, and what it adds."""
    flags = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    flags.add_argument("--out", type=Path, help="write JSON here")
    return flags


def no_flags(description: str | None) -> None:
    """The command line of a benchmark that writes to the docs alone: --help, and nothing else."""
    argparse.ArgumentParser(description=(description or "").splitlines()[0]).parse_args()


def count(text: str) -> int:
    """A flag's number of things, 1 to a million."""
    if not text.isdecimal() or not 1 <= int(text) <= 1_000_000:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed 1 to 1000000")
    return int(text)


def run_parts(description: str | None, parts: dict[str, Part], *packages: str) -> None:
    """A benchmark's command line: all parts or one, on one thread; machine, versions of
    `packages` and results as JSON where asked for. Other parts in the file are kept."""
    flags = parser(description)
    flags.add_argument("--only", choices=parts, help="one part instead of all")
    options = flags.parse_args()
    on_one_thread()
    result = earlier(options.out) | {
        "machine": {"processor": platform.processor() or platform.machine(), "threads": 1},
        "versions": {name: version(name) for name in packages},
    }
    for name in [options.only] if options.only else parts:
        measure, display = parts[name]
        result[name] = measure()
        display(result[name])
    write(options.out, result)


def run_missing(
    out: Path | None,
    about: dict[str, Any],
    places: Iterable[tuple[Any, ...]],
    run: Callable[..., dict[str, Any]],
    jobs: int,
) -> dict[str, Any]:
    """`run(*place)` for each place that `out` does not have yet, `jobs` at a time, each on one thread;
    all by place, in words. Written as soon as one is there, beside what they are `about`: a second call
    goes on."""
    about, before = json.loads(json.dumps(about)), earlier(out)
    if before and {key: before.get(key) for key in about} != about:
        raise SystemExit(f"{out}: of other configurations; give another --out")
    runs: dict[str, Any] = before.get("runs", {})
    todo = [place for place in places if " ".join(map(str, place)) not in runs]
    with processes(jobs, on_one_thread) as pool:
        futures = {pool.submit(run, *place): place for place in todo}
        for future in progress(as_completed(futures), "runs", len(todo)):
            runs[" ".join(map(str, futures[future]))] = future.result()
            write(out, {**about, "runs": runs})
    return runs


def processes(n: int, begin: Callable[[], None] | None = None) -> ProcessPoolExecutor:
    """Fresh processes that share nothing with this one."""
    return ProcessPoolExecutor(n, multiprocessing.get_context("spawn"), begin)


def on_one_thread() -> None:
    """For this process: PyTorch's threads, and no warnings between the tables."""
    import torch  # not for `figures`

    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")


def python(*arguments: str, launcher: Sequence[str] = (), checkout: Path = ROOT) -> str:
    """What a fresh Python process with the code of a checkout prints, started by a `launcher` such as
    mpirun; where it fails, so does this."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    command = [*launcher, sys.executable, *arguments]
    done = subprocess.run(command, cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True)
    if done.returncode:  # it has said why
        raise SystemExit(done.returncode)
    return done.stdout


def earlier(path: Path | None) -> dict[str, Any]:
    """What an earlier run wrote there: parts that are not measured anew are kept."""
    return json.loads(path.read_text(encoding="utf-8")) if path and path.exists() else {}


def data(name: str) -> Any:
    """A file of docs/data."""
    return json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))


def write(path: Path | None, result: Any) -> None:
    """Write JSON where it was asked for."""
    if path:
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
