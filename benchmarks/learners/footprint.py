"""How long does importing take? Fresh processes in turn.

python -m benchmarks footprint --out docs/data/footprint.json
"""

from __future__ import annotations

from functools import partial

from benchmarks.command import python, run_parts
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


def show(seconds: dict[str, float]) -> None:
    """One table."""
    markdown("| fresh process | ms |", [(name, f"{1e3 * s:.0f}") for name, s in seconds.items()])


def main() -> None:
    """Measure, show, write."""
    run_parts(__doc__, {"start": (starting, show)}, "torch", "numpy", "mujoco")
