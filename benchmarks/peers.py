"""How fast are we, against our peers and against the limits?

Environments against gymnasium-robotics and the bare simulators, updates against Stable-Baselines3
and the bare matrix products, and the time until toys are solved. One thread, contenders in turn;
what counts are the ratios. Prints tables and writes JSON:

    python benchmarks/peers.py --out docs/data/peers.json
    python benchmarks/peers.py --only solve
"""

from __future__ import annotations

from typing import Any

from peers_env import environments
from peers_solve import show_solve, solve
from peers_updates import updates
from timing import run_parts, show


def show_rates(part: dict[str, Any]) -> None:
    """A table for each contest."""
    for title, contest in part.items():
        show(title, contest["per_s"], contest["ratios"])


# Part: what measures it, what shows it.
PARTS = {
    "env": (environments, show_rates),
    "updates": (updates, show_rates),
    "solve": (solve, show_solve),
}


if __name__ == "__main__":
    packages = ("mujoco", "pybullet", "torch", "numpy", "gymnasium-robotics", "stable_baselines3")
    run_parts(__doc__, PARTS, *packages)
