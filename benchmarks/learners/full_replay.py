"""A DDPG+HER worker with a full replay; prints as JSON how much memory its process takes.

The Shadow Hand with layout 1, and the default number of transitions, all written to. Peaks are
Linux's. `footprint.py` starts this in a fresh process:

    python -m benchmarks.learners.full_replay
"""

from __future__ import annotations

import json
import re
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import torch

from benchmarks.command import no_flags
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.replay import GoalObs, Replay
from tactilerl.algos.rollout import Episode
from tactilerl.envs import vector


def peak() -> int:
    """Most bytes that this process has had in memory so far."""
    status = Path("/proc/self/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert found
    return 1024 * int(found[1])


def synthetic(replay: Replay, rng: np.random.Generator) -> Episode[GoalObs]:
    """An episode of full length, random numbers and bits."""
    n_obs, n_goal, n_action, n_privileged = replay.sizes
    rows = replay.max_steps + 1
    obs = rng.standard_normal((rows, n_obs), np.float32)
    if replay.n_boolean:
        obs[:, -replay.n_boolean :] = rng.integers(2, size=(rows, replay.n_boolean))
    achieved = rng.standard_normal((rows, n_goal), np.float32)
    actions = rng.standard_normal((rows - 1, n_action), np.float32)
    desired = np.zeros(n_goal, np.float32)
    seen = [GoalObs(o, a, desired) for o, a in zip(obs, achieved, strict=True)]
    return Episode(
        seen, list(actions), [-1.0] * len(actions), privileged=[np.zeros(n_privileged)] * len(seen)
    )


def measure() -> None:
    """Peaks after each stage of a worker's life."""
    no_flags(__doc__)
    torch.set_num_threads(1)
    with closing(vector.start(lambda: envs.make("shadow", task="reach-goal", layout="1"))) as workers:
        learner = DDPGHER(DDPGHERConfig(), workers, Communicator(), 0, 1)
        replay, rng, peaks = learner.replay, np.random.default_rng(0), {}
        learner.collect()
        learner.update()
        peaks["before"] = peak()
        while replay.n_episodes < replay.n_slots:
            replay.store([synthetic(replay, rng)])
        peaks["full"] = peak()
        learner.update()
        peaks["after an update"] = peak()
        with tempfile.TemporaryFile() as file:
            torch.save(replay.new_experience(everything=True), file)
        peaks["after saving all of it"] = peak()
    print(json.dumps({"transitions": len(replay), "replay": replay.nbytes, "peaks": peaks}))


if __name__ == "__main__":
    measure()
