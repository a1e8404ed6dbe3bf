"""Several environments side by side, stepped by threads.

MuJoCo releases the GIL while it steps, so threads suffice, and what comes out does not
depend on how many there are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np


class Step(NamedTuple):
    """What `gymnasium.Env.step` returns; `algos.Transition` by structure, for neither layer
    imports the other."""

    obs: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class ThreadedEnvs:
    """Environments made by `make()`; any of them can be stepped in any combination."""

    def __init__(self, make: Callable[[], gym.Env[Any, Any]], n: int, threads: int = 1) -> None:
        self.envs = [make() for _ in range(n)]
        self.observation_space = self.envs[0].observation_space
        self.action_space = self.envs[0].action_space
        self._threads = ThreadPoolExecutor(threads) if min(n, threads) > 1 else None

    def __len__(self) -> int:
        return len(self.envs)

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which an episode is cut off; None where the environment does not say."""
        env = self.envs[0]
        limits = [getattr(env.unwrapped, "max_episode_steps", None)]
        limits += [env.spec.max_episode_steps] if env.spec else []
        return min((limit for limit in limits if limit), default=None)

    @property
    def n_boolean(self) -> int:
        """How many entries at the end of a goal environment's observation are 0 or 1."""
        return int(getattr(self.envs[0].unwrapped, "n_boolean", 0))

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Rewards (n,) of goals (n, goal_size); ValueError where the environment has no such."""
        env: Any = self.envs[0].unwrapped
        if not hasattr(env, "compute_reward"):
            raise ValueError("compute_reward: found none, allowed environments that have it")
        return np.asarray(env.compute_reward(achieved_goal, desired_goal, {}))

    def reset(self, index: int, seed: int) -> Any:
        """First observation of a new episode of one environment."""
        return self.envs[index].reset(seed=seed)[0]

    def step(self, indices: Sequence[int], actions: np.ndarray) -> list[Step]:
        """Step the environments `indices` with actions (len(indices), ...)."""
        run = map if self._threads is None or len(indices) == 1 else self._threads.map
        return [Step(*result) for result in run(self._step_one, indices, actions)]

    def _step_one(self, index: int, action: np.ndarray) -> tuple[Any, ...]:
        return self.envs[index].step(action)

    def close(self) -> None:
        """Close every environment."""
        if self._threads is not None:
            self._threads.shutdown()
        for env in self.envs:
            env.close()
