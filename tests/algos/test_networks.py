"""Networks, and the optimiser on one vector."""

import numpy as np
import pytest
import torch
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import flushed_denormals
from tactilerl.envs import vector
from tactilerl.envs.toy import PointReachEnv

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
    if device == "cuda":
        learner.collect()
        assert np.isfinite(list(learner.update().values())).all()
        assert next(learner.policy().network.parameters()).device.type == "cpu"


@pytest.mark.parametrize("before", [False, True])
def test_moments_fade_to_zero_and_other_numbers_as_the_caller_has_them(before):
    """Denormal numbers are slow."""
    parameter = torch.nn.Parameter(torch.ones(8))
    parameter.grad = torch.zeros(8)
    adam = torch.optim.Adam([parameter], fused=True)
    adam.step()
    moments = [adam.state[parameter][name] for name in ("exp_avg", "exp_avg_sq")]
    for moment in moments:
        moment.fill_(1e-38)
    try:
        torch.set_flush_denormal(before)
        with flushed_denormals():
            adam.step()
            adam.step()
        assert bool((torch.full((8,), 1e-38) * 0.1 == 0).all()) == before
    finally:
        torch.set_flush_denormal(False)
    for moment in moments:
        assert not ((moment != 0) & (moment.abs() < torch.finfo(torch.float32).tiny)).any()
