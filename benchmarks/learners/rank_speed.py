"""Some cycles of DDPG+HER on the Shadow Hand; rank 0 prints as JSON how fast they were.

`scaling.py` starts this with one rank and with two:

    mpirun -n 2 python -m benchmarks.learners.rank_speed
"""

from __future__ import annotations

import json
import time

import torch

from benchmarks.command import no_flags
from tactilerl import envs
from tactilerl.algos import mpi
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.envs import vector

CYCLES = 3


def measure() -> None:
    """Some cycles on the Shadow Hand on each rank; rank 0 prints how fast they were."""
    no_flags(__doc__)
    torch.set_num_threads(1)
    comm = mpi.world()
    workers = vector.start(lambda: envs.make("shadow", task="reach-goal"))
    learner = DDPGHER(DDPGHERConfig(), workers, comm, 0, 1)
    learner.collect()
    learner.update()
    comm.all_gather(0)  # start together
    started, updating = time.perf_counter(), 0.0
    for _ in range(CYCLES):
        learner.collect()
        since = time.perf_counter()
        learner.update()
        updating += time.perf_counter() - since
    comm.all_gather(0)  # and end together
    seconds, config = time.perf_counter() - started, learner.config
    transitions = comm.size * CYCLES * config.n_batches * config.batch_size
    steps = comm.size * CYCLES * config.n_rollouts * learner.replay.max_steps
    if comm.rank == 0:
        print(
            json.dumps(
                {"transitions_per_s": transitions / updating, "env_steps_per_s": steps / seconds}
            )
        )
    workers.close()


if __name__ == "__main__":
    measure()
