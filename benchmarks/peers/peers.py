"""How fast are we, against our peers and against the limits?

Environments against gymnasium-robotics and the bare simulators, updates against Stable-Baselines3
and the bare matrix products, and the time until toys are solved. One thread, contenders in turn, the
processor's time; what counts are the ratios. Prints tables and writes JSON:

    python -m benchmarks peers --out docs/data/peers.json
    python -m benchmarks peers --only solve
"""

from __future__ import annotations

import platform
from importlib.metadata import version

from benchmarks.command import earlier, on_one_thread, parser, write
from benchmarks.peers import env, solve, updates

PARTS = {
    "env": (env.environments, env.show),
    "updates": (updates.updates, updates.show),
    "solve": (solve.solve, solve.show),
}

PACKAGES = "mujoco", "pybullet", "torch", "numpy", "gymnasium-robotics", "stable_baselines3"


def main() -> None:
    """Measure all parts, or one."""
    flags = parser(__doc__)
    flags.add_argument("--only", choices=PARTS, help="one part instead of all")
    options = flags.parse_args()
    on_one_thread()
    result = earlier(options.out) | {
        "machine": {"processor": platform.processor() or platform.machine(), "threads": 1},
        "versions": {name: version(name) for name in PACKAGES},
    }
    for name in [options.only] if options.only else PARTS:
        measure, show = PARTS[name]
        result[name] = measure()
        show(result[name])
    write(options.out, result)
