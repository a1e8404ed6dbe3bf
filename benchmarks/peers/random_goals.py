"""A goal environment of random numbers: data of the right shapes for benchmarks of updates."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from tactilerl.algos.mpi import Communicator
from tactilerl.envs import vector

GOAL, STEPS = 3, 100


class RandomGoals(gym.Env[Any, Any]):
    """Episodes of `STEPS` steps; `n_obs` does not count the goals."""

    max_episode_steps, n_boolean = STEPS, 0

    def __init__(self, n_obs: int, n_actions: int) -> None:
        sizes = {"observation": n_obs, "achieved_goal": GOAL, "desired_goal": GOAL}
        boxes = {k: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for k, n in sizes.items()}
        self.observation_space = gym.spaces.Dict(boxes, seed=0)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (n_actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return a random observation."""
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        """Return another observation, with its reward."""
        self.steps += 1
        obs = self.observation_space.sample()
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}))
        return obs, reward, False, self.steps >= STEPS, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        """Return 0 where the goal is reached, and −1 elsewhere."""
        return (np.linalg.norm(achieved - desired, axis=-1) < 1.0) - 1.0


def fed(kind: Any, config: Any, n_obs: int, n_actions: int, cores: int = 1) -> Any:
    """Return a learner of this kind that has collected there once."""
    workers = vector.start(partial(RandomGoals, n_obs, n_actions))
    learner = kind(config, workers, Communicator(), 0, 10**6, cores=cores)
    learner.collect()
    return learner
