"""How fast are we, against our peers and against the limits?

Environments against gymnasium-robotics and the bare simulators, updates against Stable-Baselines3
and the bare matrix products, and the time until toys are solved. One thread, contenders in turn, the
processor's time; what counts are the ratios. Prints tables and writes JSON:

    python -m benchmarks peers --out docs/data/peers.json
    python -m benchmarks peers --only solve
"""

from __future__ import annotations

from typing import Any

from benchmarks.command import Part, run_parts
from benchmarks.peers.env import environments
from benchmarks.peers.solve import show_solve, solve
from benchmarks.peers.updates import updates
from benchmarks.timing import show_contest


def show_contests(part: dict[str, Any]) -> None:
    """A table for each."""
    for title, found in part.items():
        show_contest(title, found)


PARTS: dict[str, Part] = {
    "env": (environments, show_contests),
    "updates": (updates, show_contests),
    "solve": (solve, show_solve),
}


def main() -> None:
    """All parts or one."""
    packages = ("mujoco", "pybullet", "torch", "numpy", "gymnasium-robotics", "stable_baselines3")
    run_parts(__doc__, PARTS, *packages)
