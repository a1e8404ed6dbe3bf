"""Some cycles of DDPG+HER on the Shadow Hand; rank 0 prints as JSON where their time went.

`scaling.py` starts this with one rank and with two:

    mpirun -n 2 python -m benchmarks rank_shares
"""

from __future__ import annotations

import json
import time

import torch

from benchmarks.timing import Watches
from tactilerl import envs
from tactilerl.algos import mpi
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.envs import vector

CYCLES = 3


def main() -> None:
    """Some cycles on the Shadow Hand on each rank; rank 0 prints where its time went."""
    torch.set_num_threads(1)
    comm = mpi.world()
    workers = vector.start(lambda: envs.make("shadow", task="reach-goal"))
    learner = DDPGHER(DDPGHERConfig(), workers, comm, 0, 1)
    learner.collect()
    learner.update()
    watches = Watches()
    watches.watch("physics", workers.env.simulator, "step")  # type: ignore[attr-defined]
    watches.watch("collecting", learner, "collect")
    watches.watch("sampling", learner.replay, "sample")
    watches.watch("all-reduce", learner.adam, "reduce")
    watches.watch("optimiser", learner.adam, "step")
    watches.watch("updating", learner, "update")
    comm.all_gather(0)  # start together
    started = time.perf_counter()
    for _ in range(CYCLES):
        sampled = watches.seconds["sampling"]
        learner.collect()
        watches.seconds["sampling"] = sampled  # the normaliser's samples are part of collecting
        learner.update()
    comm.all_gather(0)  # and end together
    seconds = time.perf_counter() - started
    s = watches.seconds
    rest = s["updating"] - s["sampling"] - s["all-reduce"] - s["optimiser"]
    shares = {
        "physics": s["physics"],
        "rest of the environment and acting": s["collecting"] - s["physics"],
        "sampling": s["sampling"],
        "normaliser, forward and backward": rest,
        "all-reduce, with waiting": s["all-reduce"],
        "optimiser": s["optimiser"],
    }
    config = learner.config
    updates = CYCLES * config.n_batches
    steps = comm.size * CYCLES * config.n_rollouts * learner.replay.max_steps
    if comm.rank == 0:
        result = {
            "transitions_per_s": comm.size * updates * config.batch_size / s["updating"],
            "env_steps_per_s": steps / seconds,
            "shares": {name: part / seconds for name, part in shares.items()},
        }
        print(json.dumps(result))
    workers.close()
