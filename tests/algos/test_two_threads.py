"""Actor and critic computed at the same time: the same bits as in turn, and errors of either."""

import threading

import pytest
import torch
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector

from states import flat


def learner(two_threads, algorithm=PPO, config=None, env="lqr"):
    workers = vector.start(lambda: envs.make(env))
    config = config or PPOConfig(hidden=(8,))
    return algorithm(config, workers, Communicator(), 0, 1000, cores=1 + two_threads)


def test_both_run_at_the_same_time_only_where_there_are_two_cores():
    both_there = threading.Barrier(2, timeout=20)
    wait = both_there.wait
    assert sorted(learner(True).in_two_threads(wait, wait)) == [0, 1]
    threads = learner(False).in_two_threads(threading.get_ident, threading.get_ident)
    assert threads == (threading.get_ident(),) * 2


def test_the_second_thread_treats_denormal_numbers_as_zero():
    def is_flushed():
        return bool((torch.full((8,), 1e-38) * 0.1 == 0).all())

    assert learner(True).in_two_threads(is_flushed, is_flushed) == (False, True)


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("failing", ["first", "second"])
def test_an_error_of_either_comes_out(together, failing):
    def fail():
        raise FloatingPointError(failing)

    jobs = (fail, lambda: 1) if failing == "first" else (lambda: 1, fail)
    with pytest.raises(FloatingPointError, match=failing):
        learner(together).in_two_threads(*jobs)


PPO_SMALL = PPOConfig(hidden=(32, 32), steps_per_epoch=100, n_passes=4, target_kl=0.05)
HER_SMALL = DDPGHERConfig(hidden=(32, 32), n_batches=20, batch_size=32, buffer_size=1000)


BOTH = pytest.mark.parametrize(
    ("algorithm", "config", "env"), [(PPO, PPO_SMALL, "lqr"), (DDPGHER, HER_SMALL, "point-reach")]
)


@BOTH
def test_denormal_numbers_are_zero_while_it_learns(algorithm, config, env):
    """Adam's moments of units that are never active fade until they are, and are slow then."""
    one, seen = learner(False, algorithm, config, env), []
    one.collect()
    step, tiny = one.actor_adam.step, torch.full((8,), 1e-38)
    one.actor_adam.step = lambda: seen.append(bool((tiny * 0.1 == 0).all())) or step()
    one.update()
    assert all(seen)
    assert not (tiny * 0.1 == 0).any()


@BOTH
def test_the_same_bits(algorithm, config, env):
    results = []
    for together in (False, True):
        one = learner(together, algorithm, config, env)
        losses = []
        for _ in range(3):
            one.collect()
            losses.append(one.update())
        results.append((losses, flat(one.state_dict())))
    assert results[0] == results[1]
