"""What the benchmarks' command lines have in common: a description, parts, JSON."""

from __future__ import annotations

import argparse
import json
import platform
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]  # where `python -m benchmarks` runs
Part = tuple[Callable[[], dict[str, Any]], Callable[[dict[str, Any]], None]]
"""What measures a part of a benchmark, and what shows what came out."""


def parser(description: str | None) -> argparse.ArgumentParser:
    """Flags of a benchmark with this docstring: --out, and what it adds."""
    flags = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    flags.add_argument("--out", type=Path, help="write JSON here")
    return flags


def run_parts(description: str | None, parts: dict[str, Part], *packages: str) -> None:
    """A benchmark's command line: all parts or one, on one thread; machine, versions of
    `packages` and results as JSON where asked for. Other parts in the file are kept."""
    import torch  # not for `figures`

    flags = parser(description)
    flags.add_argument("--only", choices=parts, help="one part instead of all")
    options = flags.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    result = earlier(options.out) | {
        "machine": {"processor": platform.processor() or platform.machine(), "threads": 1},
        "versions": {name: version(name) for name in packages},
    }
    for name in [options.only] if options.only else parts:
        measure, display = parts[name]
        result[name] = measure()
        display(result[name])
    write(options.out, result)


def earlier(path: Path | None) -> dict[str, Any]:
    """What an earlier run wrote there: parts that are not measured anew are kept."""
    return json.loads(path.read_text(encoding="utf-8")) if path and path.exists() else {}


def write(path: Path | None, result: Any) -> None:
    """Write JSON where it was asked for."""
    if path:
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
