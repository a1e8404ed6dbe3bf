"""How long does importing take, and how much memory a DDPG+HER worker whose replay is full?

Everything in fresh processes. Prints tables and writes JSON:

    python -m benchmarks footprint --out docs/data/footprint.json
    python -m benchmarks footprint --only memory
"""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from benchmarks.command import Part, python, run_parts
from benchmarks.printing import markdown
from benchmarks.timing import rounds

STARTS = {
    "python -c pass": ("-c", "pass"),
    "import tactilerl": ("-c", "import tactilerl"),
    "tactilerl --help": ("-m", "tactilerl", "--help"),
    "import tactilerl.envs": ("-c", "import tactilerl.envs"),
    "import torch": ("-c", "import torch"),
}


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
    markdown("| fresh process | ms |", [(name, f"{1e3 * s:.0f}") for name, s in seconds.items()])


def memory() -> dict[str, Any]:
    """What `full_replay` found."""
    return json.loads(python("-m", "benchmarks.learners.full_replay").splitlines()[-1])


def show_memory(found: dict[str, Any]) -> None:
    """One table."""
    sizes = found["peaks"] | {"the replay itself": found["replay"]}
    markdown("| peak of the process | GB |", [(what, f"{n / 1e9:.2f}") for what, n in sizes.items()])


PARTS: dict[str, Part] = {"start": (starting, show_starting), "memory": (memory, show_memory)}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "torch", "numpy", "mujoco")
