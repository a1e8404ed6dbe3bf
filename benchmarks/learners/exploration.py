"""What does an untrained DDPG+HER policy with its exploration noise do in variants of the scene?

Whether reach-goal can be learned is decided by how often chance lifts the cube. Prints a
table of shares with 95 % intervals and writes JSON:

    python -m benchmarks exploration --out docs/data/exploration.json
"""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np

from benchmarks.command import count, on_one_thread, parser, write
from benchmarks.printing import interval, progress, show
from tactilerl import envs, statistics
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.replay import GoalObs
from tactilerl.algos.rollout import TRAIN, PlayEpisode
from tactilerl.envs import vector

LIFT = 0.02  # m: higher than a cube that is tipped over
VARIANTS: dict[str, dict[str, Any]] = {
    "as shipped": {},
    "control period 0.1 s, 40 steps": {"control_dt": 0.1, "max_episode_steps": 40},
    "control period 0.04 s, 100 steps": {"control_dt": 0.04, "max_episode_steps": 100},
    "friction 2": {"friction": 2.0},
    "friction 0.5": {"friction": 0.5},
    "finger gains x 3": {"finger_gain": 3.0},
    "cube of 4 cm": {"object_size": 0.04},
    "goal 5 cm up": {"goal_height": 0.05},
    "goal 12 cm up": {"goal_height": 0.12},
    "tolerance 5 cm": {"goal_tolerance": 0.05},
    "no jitter": {"jitter": False},
}


def explore(choices: dict[str, Any], episodes: int) -> dict[str, int]:
    """Counts of episodes in which the cube is lifted, passes the goal, ends there."""
    with closing(vector.start(lambda: envs.make("shadow", task="reach-goal", **choices))) as workers:
        learner = DDPGHER(DDPGHERConfig(), workers, Communicator(), seed=0, total_timesteps=1)
        task = PlayEpisode[GoalObs](learner.policy(), (0, 0, TRAIN, 0))
        played = list(workers.play(task, range(episodes)))
    heights = [np.array([obs.achieved_goal[2] for obs in episode.obs]) for episode in played]
    return {
        "lifted": sum(bool(height.max() > height[0] + LIFT) for height in heights),
        "passes the goal": sum(max(episode.rewards) == 0 for episode in played),
        "ends at the goal": sum(bool(episode.success) for episode in played),
    }


def main() -> None:
    """All variants."""
    flags = parser(__doc__)
    flags.add_argument("--episodes", type=count, default=300)
    options = flags.parse_args()
    on_one_thread()
    n, variants = options.episodes, dict[str, dict[str, list[float]]]()
    for name, choices in progress(VARIANTS.items(), "variants"):
        variants[name] = {
            what: [number / n, *statistics.wilson_interval(number, n)]
            for what, number in explore(choices, n).items()
        }
    rows = [
        (name, *(interval(*rate, ".3f", "-") for rate in row.values()))
        for name, row in variants.items()
    ]
    title = f"untrained exploration, {n} episodes each"
    show(title, ("scene", *next(iter(variants.values()))), rows)
    write(options.out, {"episodes": n, "variants": variants})
