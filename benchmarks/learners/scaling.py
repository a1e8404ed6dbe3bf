"""What does a second core give, and where does the time of a DDPG+HER run go?

Two processes that share nothing, threads and processes that play episodes, and MPI ranks that learn
together; the same work with one and with two, in turn. Starts mpirun itself. Prints tables
and writes JSON:

    python -m benchmarks scaling --out docs/data/scaling.json
    python -m benchmarks scaling --only ranks
"""

from __future__ import annotations

import json
import multiprocessing
import statistics
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.command import ROOT, run_parts
from benchmarks.learners.random_goals import RandomGoals
from benchmarks.peers.env import Steps, mj_step
from benchmarks.timing import per_second, rounds, show
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.algos.rollout import TRAIN, PlayEpisode
from tactilerl.algos.side_by_side import SideBySide
from tactilerl.envs import vector

REPEATS = 3  # of each number of processes
EPISODES = 12  # of a turn


# -- the machine -----------------------------------------------------------------------------


def bare_steps(_: int) -> float:
    """`mj_step` per second in this process."""
    run = mj_step(Steps("shadow", "2"))
    run()
    return per_second(run)


def limit() -> dict[str, Any]:
    """What two processes that share nothing get done, against one: more is not to be had."""
    found: dict[int, list[float]] = {1: [], 2: []}
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(bare_steps, range(2)))  # both are there
        for _ in range(REPEATS):
            for n, rates in found.items():
                rates.append(sum(pool.map(bare_steps, range(n))))
    one, two = (statistics.median(rates) for rates in found.values())
    return {"per_s": {"1 process": one, "2 processes": two}, "ratios": {"2 / 1": two / one}}


# -- collecting ------------------------------------------------------------------------------


def play(workers: vector.Workers, task: PlayEpisode[Any]) -> int:
    """Steps of some episodes, the same ones however many workers play them."""
    return sum(map(len, workers.play(task, range(EPISODES))))


def collecting() -> dict[str, Any]:
    """What a second core gives: threads in MuJoCo, processes in PyBullet; resets included."""
    rates, ratios = {}, {}
    for hand, simulator in (("shadow", "MuJoCo"), ("mpl", "PyBullet")):
        make = partial(envs.make, hand, task="reach-goal", layout="2")
        set_up = partial(torch.set_num_threads, 1)
        with ExitStack() as opened:
            one, two = (opened.enter_context(closing(vector.start(make, n, set_up))) for n in (1, 2))
            policy = PPO(PPOConfig(), one, Communicator(), 0, 1).policy()
            task = PlayEpisode[Any](policy, (0, 0, TRAIN, 0))
            found = rounds({"1 core": partial(play, one, task), "2 cores": partial(play, two, task)})
        rates |= {f"{hand} in {simulator}, {cores}": rate for cores, rate in found.items()}
        ratios[f"{hand} in {simulator}: 2 cores / 1"] = found["2 cores"] / found["1 core"]
    return {"per_s": rates, "ratios": ratios}


# -- learning --------------------------------------------------------------------------------


def updates() -> dict[str, Any]:
    """Actor and critic in turn on one core, and at the same time on two: the same bits."""
    rates, ratios = {}, {}
    for name, make in {"PPO": ppo, "DDPG+HER": ddpg_her}.items():
        contenders = {}
        for cores, at_once in (("1 core", False), ("2 cores", True)):
            learner = make()
            learner._both = SideBySide(at_once)
            contenders[cores] = partial(_n_updates, learner)
        found = rounds(contenders)
        rates |= {f"{name}, {cores}": rate for cores, rate in found.items()}
        ratios[f"{name}: 2 cores / 1"] = found["2 cores"] / found["1 core"]
    return {"per_s": rates, "ratios": ratios}


def ppo() -> PPO:
    """With a batch of the paper's PyBullet set-up, layout 2."""
    config = PPOConfig(n_passes=8, steps_per_epoch=1000)
    learner = PPO(config, vector.start(partial(RandomGoals, 94, 7)), Communicator(), 0, 1000)
    learner.collect()
    return learner


def ddpg_her() -> DDPGHER:
    """With a replay of the Shadow Hand's sizes, layout 1."""
    workers = vector.start(partial(RandomGoals, 197, 23))
    learner = DDPGHER(DDPGHERConfig(n_rollouts=50), workers, Communicator(), 0, 1000)
    learner.collect()
    return learner


def _n_updates(learner: PPO | DDPGHER) -> int:
    return int(learner.update()["updates"])


def ranks() -> dict[str, Any]:
    """The same work for each of one and two ranks, in turn."""
    found: dict[int, list[dict[str, Any]]] = {1: [], 2: []}
    for _ in range(REPEATS):
        for n, results in found.items():
            command = [str(Path(sys.executable).with_name("mpirun")), "-n", str(n)]
            command += [sys.executable, "-m", "benchmarks", "rank_shares"]
            done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
            output = done.stdout
            results.append(json.loads(output.strip().splitlines()[-1]))
    result: dict[str, Any] = {"ratios": {}}
    for key in ("transitions_per_s", "env_steps_per_s"):
        rates = {n: statistics.median(r[key] for r in results) for n, results in found.items()}
        result[key] = {f"{n} ranks" if n > 1 else "1 rank": rate for n, rate in rates.items()}
        result["ratios"][f"{key}: 2 ranks / 1 rank"] = rates[2] / rates[1]
    for n, results in found.items():
        names = results[0]["shares"]
        result[f"shares at {n}"] = {
            name: statistics.median(r["shares"][name] for r in results) for name in names
        }
    return result


# -- report ----------------------------------------------------------------------------------


def show_limit(part: dict[str, Any]) -> None:
    """One table."""
    show("control steps of mj_step alone", part["per_s"], part["ratios"])


def show_collecting(part: dict[str, Any]) -> None:
    """One table."""
    show("environment steps of episodes played by an untrained policy", part["per_s"], part["ratios"])


def show_updates(part: dict[str, Any]) -> None:
    """One table."""
    show("updates of actor and critic", part["per_s"], part["ratios"])


def show_ranks(part: dict[str, Any]) -> None:
    """Rates, and where the time goes."""
    show("transitions learned from", part["transitions_per_s"], part["ratios"])
    table = Table("share of time on the Shadow Hand", "1 rank", "2 ranks")
    for name, share in part["shares at 1"].items():
        table.add_row(name, f"{share:.3f}", f"{part['shares at 2'][name]:.3f}")
    Console().print(table)


# Part: what measures it, what shows it.
PARTS = {
    "limit": (limit, show_limit),
    "collecting": (collecting, show_collecting),
    "updates": (updates, show_updates),
    "ranks": (ranks, show_ranks),
}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "mujoco", "pybullet", "torch", "numpy", "mpi4py")
