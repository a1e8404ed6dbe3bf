"""How long does importing take, and how much memory a DDPG+HER worker whose replay is full?

Everything in fresh processes. Prints tables and writes JSON:

    python -m benchmarks footprint --out docs/data/footprint.json
    python -m benchmarks footprint --only memory
"""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.command import ROOT, Part, run_parts
from benchmarks.timing import rounds

STARTS = {
    "python -c pass": ("-c", "pass"),
    "import tactilerl": ("-c", "import tactilerl"),
    "tactilerl --help": ("-m", "tactilerl", "--help"),
    "import tactilerl.envs": ("-c", "import tactilerl.envs"),
    "import torch": ("-c", "import torch"),
}


def python(*arguments: str) -> str:
    """What a fresh process prints."""
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout


def start(arguments: tuple[str, ...]) -> int:
    """A process from beginning to end."""
    python(*arguments)
    return 1


def starting() -> dict[str, float]:
    """Seconds each of STARTS takes, the median of fresh processes in turn."""
    rates = rounds({name: partial(start, arguments) for name, arguments in STARTS.items()})
    return {name: 1.0 / rate for name, rate in rates.items()}


def show_starting(seconds: dict[str, float]) -> None:
    """One table."""
    table = Table("fresh process", "ms")
    for name, value in seconds.items():
        table.add_row(name, f"{1e3 * value:.0f}")
    Console().print(table)


def memory() -> dict[str, Any]:
    """What `full_replay` found."""
    return json.loads(python("-m", "benchmarks", "full_replay").splitlines()[-1])


def show_memory(found: dict[str, Any]) -> None:
    """One table."""
    table = Table("peak memory of the process", "GB")
    for stage, value in found["peaks"].items():
        table.add_row(stage, f"{value / 1e9:.2f}")
    table.add_section()
    table.add_row(f"a replay of {found['transitions']:,} transitions", f"{found['replay'] / 1e9:.2f}")
    Console().print(table)


# Part: what measures it, what shows it.
PARTS: dict[str, Part] = {"start": (starting, show_starting), "memory": (memory, show_memory)}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "torch", "numpy", "mujoco")
