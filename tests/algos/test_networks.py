"""Networks, and the optimiser on one vector."""

import numpy as np
import pytest
import torch
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
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
