"""What does an untrained DDPG+HER policy with its exploration noise do in variants of the scene?

Whether reach-goal can be learned is decided by how often chance lifts the cube. Prints a
table of shares with 95 % intervals and writes JSON:

    python -m benchmarks exploration --out docs/data/exploration.json
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy import stats

from benchmarks.command import count, parser, write
from tactilerl import envs
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


def explore(choices: dict[str, Any], episodes: int) -> dict[str, float]:
    """Counts of episodes in which the cube is lifted, passes the goal, ends there."""
    workers = vector.start(lambda: envs.make("shadow", task="reach-goal", **choices))
    learner = DDPGHER(DDPGHERConfig(), workers, Communicator(), seed=0, total_timesteps=1)
    counts = {"lifted": 0.0, "passes the goal": 0.0, "ends at the goal": 0.0}
    task = PlayEpisode[GoalObs](learner.policy(), (0, 0, TRAIN, 0))
    for episode in workers.play(task, range(episodes)):
        heights = np.array([obs.achieved_goal[2] for obs in episode.obs])
        counts["lifted"] += heights.max() > heights[0] + LIFT
        counts["passes the goal"] += max(episode.rewards) == 0
        counts["ends at the goal"] += episode.success
    workers.close()
    return counts


def main() -> None:
    """All variants."""
    flags = parser(__doc__)
    flags.add_argument("--episodes", type=count, default=300)
    options = flags.parse_args()
    torch.set_num_threads(1)
    result: dict[str, Any] = {"episodes": options.episodes, "variants": {}}
    table = Table("scene", title=f"untrained exploration, {options.episodes} episodes each")
    for name, choices in track(VARIANTS.items(), console=Console(stderr=True)):
        counts = explore(choices, options.episodes)
        row = {}
        for what, number in counts.items():
            test = stats.binomtest(int(number), options.episodes).proportion_ci(method="wilson")
            row[what] = [number / options.episodes, float(test.low), float(test.high)]
        result["variants"][name] = row
        if not table.row_count:
            for what in counts:
                table.add_column(what)
        table.add_row(name, *(f"{m:.3f} ({a:.3f}-{b:.3f})" for m, a, b in row.values()))
    Console().print(table)
    write(options.out, result)
