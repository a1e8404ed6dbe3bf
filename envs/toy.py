"""Toy environments whose optimum is known exactly, for regression tests of algorithms."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from .state import Array


class LQREnv(gym.Env[Array, Array]):
    """Bring a double integrator to rest at the origin at the least quadratic cost.

    State (position, velocity), one force in [-1, 1], x' = A x + B a. The reward is
    -(x'Qx + r a²). `optimal_return` is exact, from the Riccati recursion, as long as the
    optimal force stays inside its bounds, which the start box is chosen for.
    """

    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    B = np.array([[0.005], [0.1]])
    Q = np.diag([1.0, 0.1])
    R = np.array([[0.5]])
    start = 0.3
    """Starts are uniform in the box ±start."""
    max_episode_steps = 60
    side_by_side = "in turn"
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self._state, self._steps = self.np_random.uniform(-self.start, self.start, 2), 0
        return self._state.astype(np.float32), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        force = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        cost = self._state @ self.Q @ self._state + force @ self.R @ force
        self._state = self.A @ self._state + self.B @ force
        self._steps += 1
        is_over = self._steps >= self.max_episode_steps
        return self._state.astype(np.float32), -float(cost), False, is_over, {}

    def render(self) -> Array | None:
        """The state in the plane of position and velocity, RGB uint8."""
        return None if self.render_mode is None else _drawn(self._state)

    @classmethod
    def riccati(cls) -> list[tuple[Array, Array]]:
        """(cost-to-go matrix (2, 2), gain (1, 2)) at each step: the optimal force is -gain @ x."""
        cost, solution = np.zeros((2, 2)), []
        for _ in range(cls.max_episode_steps):
            gain = np.linalg.solve(
                cls.R + cls.B.T @ cost @ cls.B, cls.B.T @ cost @ cls.A
            )
            cost = cls.Q + cls.A.T @ cost @ (cls.A - cls.B @ gain)
            solution.append((cost, gain))
        return solution[::-1]

    @classmethod
    def optimal_return(cls, state: Array) -> float:
        """Return of the optimal policy from `state` (2,)."""
        return -float(state @ cls.riccati()[0][0] @ state)


class PointReachEnv(gym.Env[Any, Array]):
    """Move a point in the plane to a goal; a sparse goal environment (0 at the goal, else -1).

    Each step moves up to `speed` along each axis.
    """

    speed = 0.1
    tolerance = 0.08
    max_episode_steps = 25
    side_by_side = "in turn"
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        box = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = gym.spaces.Dict(
            {"observation": box, "achieved_goal": box, "desired_goal": box}
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        super().reset(seed=seed)
        self._point, self._goal = self.np_random.uniform(-1.0, 1.0, (2, 2))
        self._steps = 0
        return self._obs(), {"is_success": False}

    def step(
        self, action: Array
    ) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        self._point = self._point + self.speed * np.clip(
            np.asarray(action, np.float64), -1.0, 1.0
        )
        self._steps += 1
        obs = self._obs()
        reward = float(
            self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})
        )
        return (
            obs,
            reward,
            False,
            self._steps >= self.max_episode_steps,
            {"is_success": reward == 0.0},
        )

    def render(self) -> Array | None:
        """The point, and its goal in grey, RGB uint8."""
        return None if self.render_mode is None else _drawn(self._goal, self._point)

    def compute_reward(
        self, achieved_goal: Array, desired_goal: Array, info: Any
    ) -> Array:
        """Rewards (...) of goals (..., 2)."""
        distance = np.linalg.norm(
            np.asarray(achieved_goal) - np.asarray(desired_goal), axis=-1
        )
        return (distance <= self.tolerance) - 1.0

    def _obs(self) -> dict[str, Array]:
        point, goal = self._point.astype(np.float32), self._goal.astype(np.float32)
        return {
            "observation": point,
            "achieved_goal": point.copy(),
            "desired_goal": goal,
        }


def _drawn(*points: Array) -> Array:
    """A picture (64, 64, 3) of points (2,) in the square from -1 to 1; the last is black."""
    picture = np.full((64, 64, 3), 255, np.uint8)
    for point, shade in zip(points[::-1], (0, 160), strict=False):
        column, row = np.clip((np.array([1, -1]) * point + 1) * 32, 2, 61).astype(int)
        picture[row - 2 : row + 3, column - 2 : column + 3] = shade
    return picture
