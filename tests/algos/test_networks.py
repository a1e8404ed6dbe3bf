"""Networks, and the optimiser on one vector."""

import copy
import pickle

import numpy as np
import pytest
import torch

from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import MLP, FlatAdam
from tactilerl.envs import vector
from tactilerl.envs.toy import PointReachEnv


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_adam_is_that_of_torch():
    network, twin = (MLP((5, 16, 3), torch.Generator().manual_seed(0)) for _ in range(2))
    adam, reference = FlatAdam((network, 1e-2)), torch.optim.Adam(twin.parameters(), 1e-2)
    for seed in range(20):
        for parameter, same in zip(network.parameters(), twin.parameters(), strict=True):
            same.grad = random(*parameter.shape, seed=seed)
            parameter.grad.copy_(same.grad)
        adam.step()
        reference.step()
    for parameter, same in zip(network.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(parameter, same)


def test_moments_fade_to_zero_and_other_numbers_do_not():
    """Denormal numbers are slow; outside the step they are as they were."""
    adam = FlatAdam((MLP((2, 2), torch.Generator().manual_seed(0)), 1e-3))
    tiny = torch.full((100,), 1e-39)
    for moment in adam._moments.values():
        moment.fill_(1e-38)
    adam.step()
    adam.step()
    for moment in adam._moments.values():
        kept = (moment != 0) & (moment.abs() < torch.finfo(torch.float32).tiny)
        assert not kept.any()
    assert (tiny * 0.5 != 0).all()


def test_nothing_is_drawn_from_pytorchs_own_generator():
    before = torch.random.get_rng_state()
    network = MLP((3, 8, 2), torch.Generator().manual_seed(0))
    again = pickle.loads(pickle.dumps(network))
    copied = copy.deepcopy(network)
    assert torch.equal(torch.random.get_rng_state(), before)
    for other in (again, copied):
        assert all(map(torch.equal, other.parameters(), network.parameters()))


DEVICES = [
    "meta",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
]


@pytest.mark.parametrize("device", DEVICES)
def test_a_learner_is_on_its_device_with_all_of_its_networks(device):
    env = PointReachEnv()
    workers = vector.Workers([vector.LocalPlayer(env)], env)
    config = DDPGHERConfig(hidden=(8,))
    learner = DDPGHER(config, workers, Communicator(), 0, 100, device)
    for network in (learner.actor, learner.critic, learner.target_actor, learner.target_critic):
        assert {p.device.type for p in network.parameters()} == {device}
    assert learner._target_vector.device.type == device
    if device == "cuda":
        learner.collect()
        assert np.isfinite(list(learner.update().values())).all()
        assert next(learner.policy().network.parameters()).device.type == "cpu"


@pytest.mark.parametrize("flushed", [False, True])
def test_a_step_leaves_denormals_as_the_caller_has_them(flushed):
    network = MLP((2, 2), torch.Generator().manual_seed(0))
    adam = FlatAdam((network, 1e-3))
    try:
        torch.set_flush_denormal(flushed)
        adam.step()
        tiny = torch.full((8,), 1e-38)
        assert bool((tiny * 0.1 == 0).all()) == flushed
    finally:
        torch.set_flush_denormal(False)
