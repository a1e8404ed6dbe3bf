"""Some cycles of DDPG+HER on the Shadow Hand; rank 0 prints as JSON where their time went.

`scaling.py` starts this with one rank and with two:

    mpirun -n 2 python -m benchmarks.learners.rank_shares
"""

from __future__ import annotations

import json
import time
from typing import Any

import torch

from benchmarks.command import no_flags
from benchmarks.timing import Watches
from tactilerl import envs
from tactilerl.algos import mpi
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.envs import vector

CYCLES = 3


def measure() -> None:
    """Some cycles on the Shadow Hand on each rank; rank 0 prints where its time went."""
    no_flags(__doc__)
    torch.set_num_threads(1)
    comm = mpi.world()
    workers: Any = vector.start(lambda: envs.make("shadow", task="reach-goal"))
    learner = DDPGHER(DDPGHERConfig(), workers, comm, 0, 1)
    learner.collect()
    learner.update()
    watches = Watches(
        physics=(workers.env.simulator, "step"), collecting=(learner, "collect"),
        updating=(learner, "update"), sampling=(learner.replay, "sample"),
        reducing=(learner.adam, "reduce"), optimiser=(learner.adam, "step"),
    )  # fmt: skip
    comm.all_gather(0)  # start together
    started = time.perf_counter()
    for _ in range(CYCLES):
        sampled = watches.seconds["sampling"]
        learner.collect()
        watches.seconds["sampling"] = sampled  # the normaliser's samples are part of collecting
        learner.update()
    comm.all_gather(0)  # and end together
    seconds = time.perf_counter() - started
    physics, collecting, updating, sampling, reducing, optimiser = watches.seconds.values()
    shares = {
        "physics": physics,
        "rest of the environment and acting": collecting - physics,
        "sampling": sampling,
        "normaliser, forward and backward": updating - sampling - reducing - optimiser,
        "all-reduce, with waiting": reducing,
        "optimiser": optimiser,
    }
    config = learner.config
    transitions = comm.size * CYCLES * config.n_batches * config.batch_size
    steps = comm.size * CYCLES * config.n_rollouts * learner.replay.max_steps
    result = {
        "transitions_per_s": transitions / updating,
        "env_steps_per_s": steps / seconds,
        "shares": {name: part / seconds for name, part in shares.items()},
    }
    if comm.rank == 0:
        print(json.dumps(result))
    workers.close()


if __name__ == "__main__":
    measure()
