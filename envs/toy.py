"""Toy environments whose optimum is known exactly, for regression tests of algorithms."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from .state import Array

BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


class _Toy(gym.Env[Any, Array]):
    """Play episodes of a fixed length, with actions in [-1, 1]."""

    side_by_side = "in turn"
    n_actions: int
    max_episode_steps: int

    def __init__(self, render_mode: None = None) -> None:
        """Make the space of actions; ValueError where it is to be rendered."""
        if render_mode is not None:
            raise ValueError(
                f"render_mode: found {render_mode!r}, allowed None: a toy has no picture"
            )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.n_actions,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Draw a start."""
        super().reset(seed=seed)
        self._steps = 0
        info = self._begin()
        return self._obs(), info

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply an action."""
        reward, info = self._move(np.clip(np.asarray(action, np.float64), -1.0, 1.0))
        self._steps += 1
        return self._obs(), reward, False, self._steps >= self.max_episode_steps, info

    def _begin(self) -> dict[str, Any]:
        raise NotImplementedError

    def _move(self, action: Array) -> tuple[float, dict[str, Any]]:
        raise NotImplementedError

    def _obs(self) -> Any:
        raise NotImplementedError


class LQREnv(_Toy):
    """Bring a double integrator to rest at the origin at the least quadratic cost.

    State (position, velocity), one force in [-1, 1], x' = A x + B a. The reward is
    -(x'Qx + r a²). `optimal_return` is exact, from the Riccati recursion, as long as the
    optimal force stays inside its bounds, which the start box is chosen for.
    """

    n_actions, max_episode_steps = 1, 60
    observation_space = BOX
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    B = np.array([[0.005], [0.1]])
    Q = np.diag([1.0, 0.1])
    R = np.array([[0.5]])
    start = 0.3
    """Largest position and velocity at the start, which are uniform."""

    def _begin(self) -> dict[str, Any]:
        self._state = self.np_random.uniform(-self.start, self.start, 2)
        return {}

    def _move(self, force: Array) -> tuple[float, dict[str, Any]]:
        cost = self._state @ self.Q @ self._state + force @ self.R @ force
        self._state = self.A @ self._state + self.B @ force
        return -float(cost), {}

    def _obs(self) -> Array:
        return self._state.astype(np.float32)

    @classmethod
    def optimal_return(cls, state: Array) -> float:
        """Return what the optimal policy earns from `state` (2,), by the Riccati recursion."""
        cost = np.zeros((2, 2))  # to go: the least cost from x is x' cost x
        for _ in range(cls.max_episode_steps):
            effort = cls.R + cls.B.T @ cost @ cls.B
            gain = np.linalg.solve(effort, cls.B.T @ cost @ cls.A)
            cost = cls.Q + cls.A.T @ cost @ (cls.A - cls.B @ gain)
        return -float(state @ cost @ state)


class PointReachEnv(_Toy):
    """Move a point in the plane to a goal; a sparse goal environment (0 at the goal, else -1).

    Each step moves up to `speed` along each axis.
    """

    n_actions, max_episode_steps = 2, 25
    observation_space = gym.spaces.Dict(
        {"observation": BOX, "achieved_goal": BOX, "desired_goal": BOX}
    )
    speed = 0.1
    tolerance = 0.08

    def _begin(self) -> dict[str, Any]:
        self._place, self._goal = self.np_random.uniform(-1.0, 1.0, (2, 2))
        return {"is_success": False}

    def _move(self, action: Array) -> tuple[float, dict[str, Any]]:
        self._place = self._place + self.speed * action
        obs = self._obs()
        reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})
        return float(reward), {"is_success": bool(reward == 0.0)}

    def compute_reward(
        self, achieved_goal: Array, desired_goal: Array, info: Any
    ) -> Array:
        """Return the rewards (...) of goals (..., 2)."""
        offset = np.asarray(achieved_goal) - np.asarray(desired_goal)
        return (np.linalg.norm(offset, axis=-1) <= self.tolerance) - 1.0

    def _obs(self) -> dict[str, Array]:
        point, goal = self._place.astype(np.float32), self._goal.astype(np.float32)
        return {
            "observation": point,
            "achieved_goal": point.copy(),
            "desired_goal": goal,
        }
