"""How fast are we, against our peers and against the limits?

Environments against gymnasium-robotics and the bare simulators, updates against Stable-Baselines3
and the bare matrix products, and the time until toys are solved. One thread, contenders in turn, the
processor's time; what counts are the ratios. Prints tables and writes JSON:

    python -m benchmarks peers --out docs/data/peers.json
    python -m benchmarks peers --only solve
"""

from __future__ import annotations

from benchmarks.command import Part, run_parts
from benchmarks.peers import env, solve, updates

PARTS: dict[str, Part] = {
    "env": (env.environments, env.show),
    "updates": (updates.updates, updates.show),
    "solve": (solve.solve, solve.show),
}


def main() -> None:
    """Measure all parts, or one."""
    packages = ("mujoco", "pybullet", "torch", "numpy", "gymnasium-robotics", "stable_baselines3")
    run_parts(__doc__, PARTS, *packages)
