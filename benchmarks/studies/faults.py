"""How much failing touch does a trained policy bear? Success of trained runs under faults.

    python -m benchmarks faults studies/handover/runs/*run_type-main* --out docs/data/faults.json

Each point is the mean over runs, each of 100 episodes from starts that training never saw
(50 in docs/data/faults.json: --episodes 50). What is in the file already is not played again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import count, earlier, parser, python, write
from benchmarks.printing import markdown
from benchmarks.studies.study_tables import mean

SWEEPS = {
    "taxel-dead": ("0", "0.1", "0.2", "0.3", "0.5", "0.7", "0.9", "1"),
    "taxel-false-on": ("0", "0.001", "0.01", "0.05", "0.1"),
    "taxel-false-off": ("0", "0.1", "0.3", "0.5"),
    "taxel-delay": ("0", "1", "2", "3", "5", "8"),
}
IN_WORDS = {
    "taxel-dead": "share of dead taxels",
    "taxel-false-on": "false touches, per taxel and step",
    "taxel-false-off": "missed touches, per taxel and step",
    "taxel-delay": "delay, steps of 0.1 s",
}


def sweep(run: Path, flag: str, episodes: int) -> list[float]:
    """Success of one run, by size of the fault."""
    command = ("-m", "tactilerl", "evaluate", str(run.resolve()), "--workers", "1", "--json")
    printed = python(*command, "--episodes", str(episodes), "--sweep", flag, *SWEEPS[flag])
    return [point["success_rate"] for point in json.loads(printed)["points"]]


def show(results: dict[str, Any], flags: Iterable[str] = SWEEPS) -> None:
    """Success by kind and size of the fault, as Markdown."""
    for flag in flags:
        rates = np.array([found[flag] for found in results.values() if flag in found]).T
        head = " | ".join((IN_WORDS[flag], *SWEEPS[flag]))
        markdown(f"| {head} |", [("success", *map(mean, rates))])
        print()


def main() -> None:
    """Play what is missing, then print the tables."""
    flags = parser(__doc__)
    flags.add_argument("runs", nargs="+", type=Path)
    flags.add_argument("--episodes", type=count, default=100)
    options = flags.parse_args()
    known = earlier(options.out)
    for run in options.runs:
        found = known.setdefault(run.name, {})
        for flag in SWEEPS:
            if flag not in found:
                found[flag] = sweep(run, flag, options.episodes)
                write(options.out, known)
    show(known)
