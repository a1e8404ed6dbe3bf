"""Actor and critic computed at the same time: the same bits as in turn, errors of either; on a GPU."""

import threading

import numpy as np
import pytest
import torch
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector

from states import flat

HER = DDPGHERConfig(hidden=(32, 32), n_batches=20, batch_size=32, buffer_size=1000)
SMALL = {
    PPO: (PPOConfig(hidden=(32, 32), steps_per_epoch=100, n_passes=4, target_kl=0.05), "lqr"),
    DDPGHER: (HER, "point-reach"),
}


def learner(two_threads, kind=PPO, device="cpu"):
    config, env = SMALL[kind]
    workers = vector.start(lambda: envs.make(env))
    return kind(config, workers, Communicator(), 0, 1000, device, cores=1 + two_threads)


def test_both_run_at_the_same_time_only_where_there_are_two_cores():
    both_there = threading.Barrier(2, timeout=20)
    wait = both_there.wait
    assert sorted(learner(True).in_two_threads(wait, wait)) == [0, 1]
    threads = learner(False).in_two_threads(threading.get_ident, threading.get_ident)
    assert threads == (threading.get_ident(),) * 2


@pytest.mark.parametrize("together", [False, True])
def test_an_error_of_either_comes_out(together):
    def fail():
        raise FloatingPointError("of one")

    for jobs in ((fail, int), (int, fail)):
        with pytest.raises(FloatingPointError, match="of one"):
            learner(together).in_two_threads(*jobs)


@pytest.mark.parametrize("kind", SMALL)
def test_the_same_bits(kind):
    results = []
    for together in (False, True):
        one, losses = learner(together, kind), []
        for _ in range(3):
            one.collect()
            losses.append(one.update())
        results.append((losses, flat(one.state_dict())))
    assert results[0] == results[1]


NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.mark.parametrize("device", ["meta", pytest.param("cuda", marks=NO_GPU)])
def test_a_learner_is_on_its_device_with_all_of_its_networks(device):
    one = learner(False, DDPGHER, device)
    for network in (one.actor, one.critic, one.target_actor, one.target_critic):
        assert {p.device.type for p in network.parameters()} == {device}
    if device == "cuda":
        one.collect()
        assert np.isfinite(list(one.update().values())).all()
        assert next(one.policy().network.parameters()).device.type == "cpu"
