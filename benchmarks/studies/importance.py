"""Which taxels matter to a policy that was trained with a dense skin?"""

from __future__ import annotations

from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import tactilerl
from tactilerl.algos.policy import Policy
from tactilerl.envs import scenes
from tactilerl.statistics import Array

EPISODES = 50


def of_policy(scene: str, layout: str, seed: int) -> Array:
    """Gradient of the actions by each taxel times its reading (taxels,), mean size along episodes of a
    PPO policy that learned as the scene's file says."""
    named = scenes.load(scene)
    how = {name: value for name, value in named.train.items() if name != "algo"}
    steps = how.pop("total_timesteps")
    env = tactilerl.make(scene=scene, layout=layout)
    with closing(env):
        learner = tactilerl.PPO(env, seed=seed, workers=1, **how)
        with closing(learner):
            policy = learner.learn(steps).policy()
        n = len(env.unwrapped.taxels)  # type: ignore[attr-defined]
        views = np.concatenate([_episode(env, policy, seed + 1 + i) for i in range(EPISODES)])
    x = policy.inputs.stack(list(views)).requires_grad_()
    policy.network(x).sum().backward()
    assert x.grad is not None
    size = (x.grad * x.detach()).abs().mean(dim=0).numpy()
    history = named.scene["history"]
    return np.asarray(size[-n * history :].reshape(history, n).sum(axis=0))


def _episode(env: gym.Env[Any, Any], policy: Policy, seed: int) -> Array:
    """What the policy sees in one episode (steps, inputs)."""
    obs, _ = env.reset(seed=seed)
    views, is_done = [], False
    while not is_done:
        views.append(policy.read(obs))
        obs, _, terminated, truncated, _ = env.step(policy.act(obs))
        is_done = terminated or truncated
    return np.array(views)
