"""What does a second core give?

Two processes that share nothing, threads and processes that play episodes, and updates; the same
work with one and with two, in turn. Prints tables and writes JSON:

    python -m benchmarks scaling --out docs/data/scaling.json
    python -m benchmarks scaling --only updates
"""

from __future__ import annotations

from contextlib import ExitStack, closing
from functools import partial
from statistics import median
from typing import Any

import torch
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.algos.rollout import TRAIN, PlayEpisode
from tactilerl.envs import vector

from benchmarks.command import (
    Contender,
    Part,
    markdown,
    per_second,
    processes,
    rounds,
    run_parts,
)
from benchmarks.learners.random_goals import fed
from benchmarks.peers.env import Steps, mj_step

REPEATS = 3  # of each number of processes
EPISODES = 12  # of a turn


def bare_steps(_: int) -> float:
    """Return the number of `mj_step` per second in this process."""
    run = mj_step(Steps("shadow", "2"))
    run()
    return per_second(run)


def limit() -> dict[str, Any]:
    """Measure two processes that share nothing against one: the limit of this machine."""
    rates_of: dict[int, list[float]] = {1: [], 2: []}
    with processes(2) as pool:
        list(pool.map(bare_steps, range(2)))  # both are there
        for _ in range(REPEATS):
            for n, rates in rates_of.items():
                rates.append(sum(pool.map(bare_steps, range(n))))
    one, two = map(median, rates_of.values())
    return {"per_s": {"1 process": one, "2 processes": two}, "ratios": {"2 / 1": two / one}}


def on_two_cores(contests: dict[str, list[Contender]]) -> dict[str, Any]:
    """Measure the same work on one core and on two, in turn."""
    result: dict[str, Any] = {"per_s": {}, "ratios": {}}
    for name, contenders in contests.items():
        rates = rounds(dict(zip(("1 core", "2 cores"), contenders, strict=True)))
        result["per_s"] |= {f"{name}, {cores}": rate for cores, rate in rates.items()}
        result["ratios"][f"{name}: 2 cores / 1"] = rates["2 cores"] / rates["1 core"]
    return result


def play(workers: vector.Workers, task: PlayEpisode[Any]) -> int:
    """Play some episodes, the same with any number of workers; return their number of steps."""
    return sum(map(len, workers.play(task, range(EPISODES))))


def collecting() -> dict[str, Any]:
    """Measure what a second core gives when episodes are collected, resets included."""
    contests: dict[str, list[Contender]] = {}
    with ExitStack() as opened:
        for hand, simulator in (("shadow", "MuJoCo"), ("mpl", "PyBullet")):
            make = partial(envs.make, hand, task="reach-goal", layout="2")
            set_up = partial(torch.set_num_threads, 1)
            both = [opened.enter_context(closing(vector.start(make, n, set_up))) for n in (1, 2)]
            policy = PPO(PPOConfig(), both[0], Communicator(), 0, 1).policy()
            task = PlayEpisode[Any](policy, (0, 0, TRAIN, 0))
            contests[f"{hand} in {simulator}"] = [partial(play, workers, task) for workers in both]
        return on_two_cores(contests)


def updates() -> dict[str, Any]:
    """Measure updates of actor and critic in turn on one core, and at the same time on two.

    PPO has a batch of the paper's PyBullet set-up with layout 2, DDPG+HER a replay of the Shadow
    Hand's sizes with layout 1.
    """
    contests: dict[str, list[Contender]] = {"PPO": [], "DDPG+HER": []}
    for cores in (1, 2):
        ppo = fed(PPO, PPOConfig(n_passes=8, steps_per_epoch=1000), 94, 7, cores)
        ddpg_her = fed(DDPGHER, DDPGHERConfig(n_rollouts=50), 197, 23, cores)
        for contenders, learner in zip(contests.values(), (ppo, ddpg_her), strict=True):
            contenders.append(partial(n_updates, learner))
    return on_two_cores(contests)


def n_updates(learner: PPO | DDPGHER) -> int:
    """Update once; return the number of minibatches."""
    return int(learner.update()["updates"])


WORK = {
    "2 / 1": "MuJoCo alone: `mj_step` in two processes that share nothing",
    "shadow in MuJoCo: 2 cores / 1": "collecting, Shadow Hand in MuJoCo (threads)",
    "mpl in PyBullet: 2 cores / 1": "collecting, MPL hand in PyBullet (processes)",
    "PPO: 2 cores / 1": "PPO updates: actor and critic at the same time",
    "DDPG+HER: 2 cores / 1": "DDPG+HER updates: both gradients at the same time",
}
"""The words for each ratio."""


def show(*parts: dict[str, Any]) -> None:
    """Print the ratios of some parts."""
    ratios = {name: ratio for part in parts for name, ratio in part["ratios"].items()}
    rows = [(words, f"{ratios[name]:.2f}") for name, words in WORK.items() if name in ratios]
    markdown("| work | 2 cores / 1 |", rows)


PARTS: dict[str, Part] = {
    "limit": (limit, show),
    "collecting": (collecting, show),
    "updates": (updates, show),
}


def main() -> None:
    """Measure all parts, or one."""
    run_parts(__doc__, PARTS, "mujoco", "pybullet", "torch", "numpy")
