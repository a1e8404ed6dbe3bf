"""What share of collecting is lost to episodes that are cut short at the end of an epoch?

Workers run ahead. When an epoch has its steps, what they have begun beyond is thrown away, so that
results do not depend on how many they are. This counts timesteps of the simulator, hold tests
included: it plays the episodes of some epochs of PPO one after another and reckons when workers
that are all equally fast would have begun and ended each. No clock is looked at.

    python -m benchmarks cut_short --run RUN [RUN ...] --out docs/data/cut_short.json

"Discarded" is the share of all timesteps that are thrown away: where workers are processes, and where
they are threads, which stop as soon as the episodes before have the epoch's steps, ended or not
(`rollout.Tally`). "Idle" is the share of the workers' time until then in which nothing is played
that is wanted: it is lost where each has a core that nobody else wants.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.command import DATA, count, data, parser, write
from benchmarks.printing import markdown
from tactilerl import envs
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.algos.rollout import TRAIN, PlayEpisode
from tactilerl.envs import vector
from tactilerl.runs.policies import read_run
from tactilerl.study import records

SEED = 60_000
WORKERS = (2, 4, 8, 16)
Costs = list[int]
"""Timesteps until the end of each step of an episode."""


def played(env: Any, task: PlayEpisode[Any], steps: int) -> list[Costs]:
    """An epoch's episodes, and as many beyond as the workers could begin meanwhile."""
    episodes: list[Costs] = []
    total, beyond = 0, 0
    while total < steps or beyond < 2 * max(WORKERS):
        beyond += total >= steps
        costs = episode(env, task, len(episodes))
        total += len(costs)
        episodes.append(costs)
    return episodes


def episode(env: Any, task: PlayEpisode[Any], number: int) -> Costs:
    """One."""
    step, at_begins, taken = env.simulator.step, [], 0

    def counted(targets: Any, n_substeps: int) -> None:
        nonlocal taken
        taken += n_substeps
        step(targets, n_substeps)

    def is_wanted() -> bool:
        """Asked before each step."""
        at_begins.append(taken)
        return True

    with patch.object(env.simulator, "step", counted):
        task(env, number, is_wanted)
    return [*at_begins[1:], taken]


def reckon(episodes: list[Costs], steps: int, workers: int) -> tuple[int, int, int, int]:
    """Timesteps that are wanted, that are discarded with processes and with threads, and of all workers
    until the epoch has its steps."""
    free, starts = [0] * workers, []
    for costs in episodes:
        starts.append(heapq.heappop(free))
        heapq.heappush(free, starts[-1] + costs[-1])
    n = int(np.searchsorted(np.cumsum([len(costs) for costs in episodes]), steps)) + 1
    end = max(start + costs[-1] for start, costs in zip(starts[:n], episodes, strict=False))
    processes = threads = 0
    for number, (start, costs) in enumerate(zip(starts, episodes, strict=True)):
        if number >= n:
            certain = _certain(starts[:number], episodes, steps)
            processes += until(costs, end - start)
            threads += until(costs, min(end, certain) - start)
    return sum(costs[-1] for costs in episodes[:n]), processes, threads, workers * end


def until(costs: Costs, time: int) -> int:
    """Timesteps of an episode that is told to stop at a time after its start: a step is taken to its
    end."""
    return 0 if time <= 0 else costs[min(bisect_left(costs, time), len(costs) - 1)]


def _certain(starts: list[int], episodes: list[Costs], steps: int) -> int:
    """When the episodes with these starts have taken that many steps together."""
    ends = sorted(s + cost for s, costs in zip(starts, episodes, strict=False) for cost in costs)
    return ends[steps - 1]


def measure(make: Any, policy: Any, steps: int, epochs: int) -> dict[str, Any]:
    """Shares by number of workers, over some epochs of one policy."""
    tasks = [PlayEpisode[Any](policy, (SEED, 0, TRAIN, epoch)) for epoch in range(epochs)]
    with closing(make()) as env:
        every = [played(env, task, steps) for task in tasks]
    lengths = [len(costs) for episodes in every for costs in episodes]
    result: dict[str, Any] = {
        "steps_per_epoch": steps,
        "epochs": epochs,
        "mean_length": float(np.mean(lengths)),
        "timesteps_per_step": sum(e[-1] for episodes in every for e in episodes) / sum(lengths),
    }
    for workers in WORKERS:
        of_epochs = [reckon(episodes, steps, workers) for episodes in every]
        wanted, processes, threads, capacity = map(sum, zip(*of_epochs, strict=True))
        result[str(workers)] = {
            "in_vain_processes": processes / (wanted + processes),
            "in_vain_threads": threads / (wanted + threads),
            "waiting": 1 - wanted / capacity,
        }
    return result


def untrained(hold_verdict: str) -> tuple[Any, Any, int]:
    """(environment's maker, policy, steps of an epoch) before anything was learned."""
    make = partial(envs.make, "shadow", layout="4", hold_verdict=hold_verdict)
    with closing(vector.start(make)) as workers:
        learner = PPO(PPOConfig(), workers, Communicator(), SEED, 1)
    return make, learner.policy(), learner.config.steps_per_epoch


def trained(run: Path) -> tuple[Any, Any, int]:
    """The same of a run's newest policy."""
    found = read_run(run)
    return found.config.make_env, found.policy, found.config.learner.steps_per_epoch


def show(results: dict[str, dict[str, Any]]) -> None:
    """As Markdown."""
    rows = [
        (name, f"{row['mean_length']:.0f}", n, *(f"{100 * x:.1f} %" for x in row[str(n)].values()))
        for name, row in results.items()
        for n in WORKERS
    ]
    head = "| episodes of | mean steps | workers | discarded, processes | discarded, threads | idle |"
    markdown(head, rows)


def many_cores(results: dict[str, dict[str, Any]]) -> None:
    """What one run and a study would gain from more cores: a prediction from measured parts. The run is
    the least disturbed of studies/handover.toml with touch; actor and critic learn on two cores."""
    name = "handover_layout-2_run_type-main_s0"
    idle = {1: 0.0} | {n: results[f"run {name}"][str(n)]["waiting"] for n in WORKERS}
    at_once = data("scaling")["updates"]["ratios"]["PPO: 2 cores / 1"]
    runs = [r for r in records.load(DATA / "handover.tar.gz")[1] if r.run.name[:-1] == name[:-1]]
    parts = [
        [np.nansum(r.column(part)) for part in ("collect_s", "update_s")] / r.column("env_steps")[-1]
        for r in runs
    ]
    collect, update = 1000 * min(parts, key=sum)
    rows = []
    for n, share in idle.items():
        seconds = collect / (n * (1 - share)) + update / (at_once if n > 1 else 1)
        ratio, hourly = (collect + update) / seconds, n * 3600 / (30 * (collect + update))
        rows.append((n, f"{seconds:.2f}", f"{ratio:.1f}", f"{hourly:.0f}"))
    head = (
        "| cores | one run: seconds per 1,000 steps | as fast | a study: runs of 30,000 steps an hour |"
    )
    markdown(head, rows)


def main() -> None:
    """Untrained policies, and those of runs."""
    flags = parser(__doc__)
    flags.add_argument("--run", type=Path, nargs="*", default=[], help="folders of PPO's runs")
    flags.add_argument("--epochs", type=count, default=5)
    options = flags.parse_args()
    sources = {
        f"Shadow Hand, untrained, hold verdict {verdict}": partial(untrained, verdict)
        for verdict in ("full", "settled")
    }
    sources |= {f"run {run.name}": partial(trained, run) for run in options.run}
    results = {name: measure(*source(), options.epochs) for name, source in sources.items()}
    show(results)
    many_cores(results)
    write(options.out, results)
