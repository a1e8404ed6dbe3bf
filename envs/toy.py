"""Toy environments whose optimum is known exactly, for regression tests of algorithms."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from .state import Array

BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


class LQREnv(gym.Env[Array, Array]):
    """Bring a double integrator to rest at the origin at the least quadratic cost.

    State (position, velocity), one force in [-1, 1], x' = A x + B a. The reward is
    -(x'Qx + r a²). `optimal_return` is exact, from the Riccati recursion, as long as the
    optimal force stays inside its bounds, which the start box is chosen for.
    """

    side_by_side = "in turn"
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    B = np.array([[0.005], [0.1]])
    Q = np.diag([1.0, 0.1])
    R = np.array([[0.5]])
    start = 0.3
    """Largest position and velocity at the start, which are uniform."""
    max_episode_steps = 60

    def __init__(self, render_mode: None = None) -> None:
        """Make the spaces; ValueError where it is to be rendered."""
        _require_no_picture(render_mode)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = BOX

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw a start, and return it as the observation, and an empty info."""
        super().reset(seed=seed)
        self._state = self.np_random.uniform(-self.start, self.start, 2)
        self._steps = 0
        return self._state.astype(np.float32), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply a force (1,)."""
        force = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        cost = self._state @ self.Q @ self._state + force @ self.R @ force
        self._state = self.A @ self._state + self.B @ force
        self._steps += 1
        is_over = self._steps >= self.max_episode_steps
        return self._state.astype(np.float32), -float(cost), False, is_over, {}

    @classmethod
    def optimal_return(cls, state: Array) -> float:
        """Return what the optimal policy earns from `state` (2,), by the Riccati recursion."""
        cost = np.zeros((2, 2))  # to go: the least cost from x is x' cost x
        for _ in range(cls.max_episode_steps):
            effort = cls.R + cls.B.T @ cost @ cls.B
            gain = np.linalg.solve(effort, cls.B.T @ cost @ cls.A)
            cost = cls.Q + cls.A.T @ cost @ (cls.A - cls.B @ gain)
        return -float(state @ cost @ state)


class PointReachEnv(gym.Env[Any, Array]):
    """Move a point in the plane to a goal; a sparse goal environment (0 at the goal, else -1).

    Each step moves up to `speed` along each axis.
    """

    side_by_side = "in turn"
    speed = 0.1
    tolerance = 0.08
    max_episode_steps = 25

    def __init__(self, render_mode: None = None) -> None:
        """Make the spaces of a goal environment; ValueError where it is to be rendered."""
        _require_no_picture(render_mode)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Dict(
            {"observation": BOX, "achieved_goal": BOX, "desired_goal": BOX}
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Draw the point's place and its goal."""
        super().reset(seed=seed)
        self._place, self._goal = self.np_random.uniform(-1.0, 1.0, (2, 2))
        self._steps = 0
        return self._obs(), {"is_success": False}

    def step(
        self, action: Array
    ) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Move the point by an action (2,)."""
        move = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        self._place = self._place + self.speed * move
        self._steps += 1
        obs = self._obs()
        goals = obs["achieved_goal"], obs["desired_goal"]
        reward = float(self.compute_reward(*goals, {}))
        is_over = self._steps >= self.max_episode_steps
        return obs, reward, False, is_over, {"is_success": reward == 0.0}

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


def _require_no_picture(render_mode: str | None) -> None:
    if render_mode is not None:
        raise ValueError(
            f"render_mode: found {render_mode!r}, allowed None: a toy has no picture"
        )
