"""What runs of one seed have in common, whatever they observe: weights, noise, order of minibatches."""

from contextlib import closing
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from tactilerl import envs
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import MLP, start_orthogonal
from tactilerl.algos.policy import Spaces
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector
from tactilerl.envs.toy import PointReachEnv

FEW, MANY = ["a", "b", "c"], ["x", "b", "a", "y", "c", "z"]
PLACES = [MANY.index(name) for name in FEW]


def networks(**choices):
    """Two with other inputs from the same seed, and the ones drawn after them."""
    found = []
    for names in (FEW, MANY):
        generator = torch.Generator().manual_seed(3)
        found.append([MLP((len(names), 16, 4), generator, inputs=names, **choices) for _ in range(2)])
    return found


@pytest.mark.parametrize("which", [0, 1])
def test_weights_belong_to_inputs_by_name(which):
    few, many = (pair[which].linears for pair in networks())
    scale = np.sqrt(len(FEW) / len(MANY))
    torch.testing.assert_close(many[0].weight[:, PLACES], few[0].weight * scale)
    torch.testing.assert_close(many[0].bias, few[0].bias * scale)
    assert torch.equal(many[1].weight, few[1].weight)
    assert torch.equal(many[1].bias, few[1].bias)


def test_weights_are_uniform_within_their_bound_and_differ():
    weight = MLP((3, 4000), torch.Generator().manual_seed(0), inputs=FEW).linears[0].weight.detach()
    bound = 1 / np.sqrt(3)
    assert weight.abs().max() <= bound
    assert weight.std(dim=0).numpy() == pytest.approx(bound / np.sqrt(3), rel=0.03)
    assert np.abs(np.corrcoef(weight.numpy().T) - np.eye(3)).max() < 0.05
    first, second = networks()[0]
    assert not torch.isclose(first.linears[0].weight, second.linears[0].weight).any()


@pytest.mark.parametrize("n_out", [400, 2])
def test_an_orthogonal_start_is_orthogonal(n_out):
    generator = torch.Generator().manual_seed(1)
    network = MLP((3, n_out, n_out, 4), generator, inputs=FEW)
    start_orthogonal(network, 0.1, generator, FEW)
    first, second, last = (linear.weight.detach() for linear in network.linears)
    torch.testing.assert_close(second @ second.T, 2 * torch.eye(n_out), atol=1e-5, rtol=0)
    product = last @ last.T if n_out > 4 else last.T @ last
    torch.testing.assert_close(product, 0.01 * torch.eye(len(product)), atol=1e-5, rtol=0)
    length = 2 * min(1, n_out / 3)  # wide layers keep the size of their sums
    torch.testing.assert_close((first**2).sum(0), torch.full((3,), float(length)))
    if n_out == 400:  # drawn apart, so nearly
        torch.testing.assert_close(first.T @ first, 2 * torch.eye(3), atol=0.5, rtol=0)


class Distracted(gym.ObservationWrapper):
    """The toy, with zeros behind its observation."""

    side_by_side, max_episode_steps = "in turn", PointReachEnv.max_episode_steps

    def __init__(self, n):
        super().__init__(PointReachEnv())
        self.n, spaces = n, dict(self.env.observation_space.spaces)
        size = spaces["observation"].shape[0] + n
        spaces["observation"] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)
        self.compute_reward = self.env.compute_reward

    def observation(self, observation):
        seen = np.append(observation["observation"], np.zeros(self.n, np.float32))
        return {**observation, "observation": seen}


def test_starts_and_exploration_do_not_depend_on_what_is_observed():
    config = PPOConfig(hidden=(8,), steps_per_epoch=100, n_passes=2)
    noise, starts = [], []
    for n in (0, 5):
        with closing(vector.start(partial(Distracted, n))) as workers:
            learner = PPO(config, workers, Communicator(), 4, 1000)
            learner.collect()
            first = learner._episodes[1]
            means = learner.actor(torch.from_numpy(np.stack(first.obs[:-1]))).numpy(force=True)
        noise.append(np.stack(first.actions) - means)
        starts.append(first.obs[0][:2])
    np.testing.assert_array_equal(*starts)
    np.testing.assert_allclose(*(each[:3] for each in noise), atol=1e-6)


def test_names_come_with_the_environments_spaces():
    env = envs.make("shadow", layout="5", touch="on")
    spaces = Spaces(env.observation_space, env.action_space)
    names = spaces.inputs(with_action=True)
    observed = [f"observation {name}" for name in env.observation_names()]
    assert names[: len(observed)] == observed
    env.close()
    assert len(set(names)) == len(names)
    assert len(names) == len(spaces.inputs()) + env.action_space.shape[0]
    assert Spaces(gym.spaces.Box(-1, 1, (3,)), env.action_space).inputs() is None
