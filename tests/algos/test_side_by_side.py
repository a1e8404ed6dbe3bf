"""Actor and critic computed at the same time: the same bits as in turn, and errors of either."""

import threading
from contextlib import closing

import pytest
import torch
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.algos.side_by_side import SideBySide
from tactilerl.envs import vector
from tactilerl.runs import training
from tactilerl.runs.config import defaults


def test_both_run_at_the_same_time_only_when_asked():
    both_there = threading.Barrier(2, timeout=20)
    assert SideBySide(True)(lambda: both_there.wait() >= 0, lambda: both_there.wait() >= 0) == (
        True,
        True,
    )
    threads = SideBySide(False)(threading.get_ident, threading.get_ident)
    assert threads == (threading.get_ident(),) * 2


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("failing", ["first", "second"])
def test_an_error_of_either_comes_out(together, failing):
    def fail():
        raise FloatingPointError(failing)

    jobs = (fail, lambda: 1) if failing == "first" else (lambda: 1, fail)
    with pytest.raises(FloatingPointError, match=failing):
        SideBySide(together)(*jobs)


@pytest.mark.parametrize("algo", ["ppo", "ddpg_her"])
@pytest.mark.parametrize(("asked", "free", "two"), [(None, 2, True), (None, 1, False), (1, 2, False)])
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_toy_is_played_on_one_core_and_learned_from_on_those_that_are_allowed(
    monkeypatch, algo, asked, free, two, ranks
):
    """But on one in each of several processes."""
    monkeypatch.setattr(training, "free_cores", lambda comm=None: free)
    config = defaults(algo, "point-reach").choose({"workers": asked, "hidden": (8,)})
    comm = Communicator()
    comm.size = ranks
    learner, workers = training.make_algorithm(config, comm)
    with closing(workers):
        assert len(workers) == 1
        assert (learner.side_by_side._other is not None) == (two and ranks == 1)


PPO_SMALL = PPOConfig(hidden=(32, 32), steps_per_epoch=100, n_passes=4, target_kl=0.05)
HER_SMALL = DDPGHERConfig(hidden=(32, 32), n_batches=20, batch_size=32, buffer_size=1000)


@pytest.mark.parametrize(
    ("learner", "config", "env"), [(PPO, PPO_SMALL, "lqr"), (DDPGHER, HER_SMALL, "point-reach")]
)
def test_the_same_bits(learner, config, env):
    found = []
    for together in (False, True):
        one = learner(config, vector.start(lambda: envs.make(env)), Communicator(), 0, 1000)
        one.side_by_side = SideBySide(together)
        learned = []
        for _ in range(3):
            one.collect()
            learned.append(one.update())
        found.append((learned, one.state_dict()))
    (first, state), (second, other) = found
    assert first == second
    for name in ("actor", "critic"):
        for key, value in state[name].items():
            assert torch.equal(value, other[name][key])
