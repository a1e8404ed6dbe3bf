"""Networks, and the optimiser on one vector."""

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
def test_moments_fade_to_zero_and_other_numbers_as_the_caller_has_them(flushed):
    """Denormal numbers are slow."""
    adam = FlatAdam((MLP((2, 2), torch.Generator().manual_seed(0)), 1e-3))
    for moment in adam._moments.values():
        moment.fill_(1e-38)
    try:
        torch.set_flush_denormal(flushed)
        adam.step()
        adam.step()
        assert bool((torch.full((8,), 1e-38) * 0.1 == 0).all()) == flushed
    finally:
        torch.set_flush_denormal(False)
    for moment in adam._moments.values():
        kept = (moment != 0) & (moment.abs() < torch.finfo(torch.float32).tiny)
        assert not kept.any()
