"""How long the commands of the docs take, from the shell's point of view.

Each runs once, from beginning to end, on a machine that does nothing else. Prints and writes JSON:

    python -m benchmarks times --out docs/data/times.json
"""

from __future__ import annotations

import os
import platform
import shlex
import tempfile
import time
from importlib.metadata import version

from benchmarks.command import parser, python, write
from benchmarks.printing import markdown, progress

POLICY = "examples/policies/handover_touch"
COMMANDS = (
    "train --algo ppo --env shadow --layout 4 --total-timesteps 36000 --hold-verdict settled --out OUT",
    "train --scene handover --out OUT",
    "train --scene handover --workers 1 --out OUT",
    f"evaluate {POLICY}",
    f"evaluate {POLICY} --sweep taxel-dead 0 0.5 0.9",
    "design --scene handover_anywhere --taxels 4 --out OUT.toml",
    "gate --scene handover --starts 50 --search 5",
    "gate --scene handover",
    "doctor --env shadow",
    "probe --env shadow --out OUT",
    "probe --env mpl --simulator mujoco --out OUT",
    "probe --env mpl --simulator pybullet --out OUT",
)
"""Of `tactilerl`, as the docs have them; OUT is an empty place."""


def measure() -> dict[str, float]:
    """Seconds of each command."""
    seconds = {}
    for command in progress(COMMANDS, "commands"):
        with tempfile.TemporaryDirectory() as folder:
            words = shlex.split(command.replace("OUT", f"{folder}/out"))
            started = time.perf_counter()
            python("-m", "tactilerl", *words)
            seconds[command] = time.perf_counter() - started
    return seconds


def show(seconds: dict[str, float]) -> None:
    """One table."""
    rows = []
    for command, taken in seconds.items():
        spoken = f"{taken:.0f} s" if taken < 100 else f"{taken / 60:.1f} min"
        rows.append((f"`tactilerl {command.partition(' --out OUT')[0]}`", spoken))
    markdown("| command | time |", rows)


def main() -> None:
    """All commands."""
    options = parser(__doc__).parse_args()
    seconds = measure()
    show(seconds)
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    versions = {name: version(name) for name in ("tactilerl", "torch", "numpy", "mujoco")}
    write(options.out, {"machine": machine, "versions": versions, "seconds": seconds})
