"""Contenders in stepping: our environments, their simulators alone, gymnasium-robotics."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from tactilerl import envs

from benchmarks.command import Contender, contest, markdown

CONTROL_DT = 0.04  # s: gymnasium-robotics' own, 20 steps of 2 ms
STEPS = 250
LAYOUTS = ("1", "6")  # the most and the fewest taxels of the paper


def policy_actions(size: int) -> np.ndarray:
    """Return the actions of an untrained PPO policy: Gaussian, with the paper's variance of 0.05."""
    noise = np.random.default_rng(0).standard_normal((STEPS, size))
    return np.clip(0.05**0.5 * noise, -1, 1)


class Steps:
    """Play the same random actions in one scene, through our environment or past it.

    An untrained policy presses the hand on the cube all the time; `raised` keeps the hand in
    the air, as gymnasium-robotics' hand is once its block has fallen off.
    """

    def __init__(self, hand: str, layout: str, raised: bool = False, **choices: Any) -> None:
        self.env: Any = envs.make(
            hand, layout=layout, task="reach-goal", max_episode_steps=STEPS, **choices
        )
        self.actions = policy_actions(self.env.action_space.shape[0])
        if raised:
            self.actions[:, 2] = 1.0

    def ours(self) -> int:
        """Play an episode through `env.step`."""
        return episode(self.env, self.env.step, self.actions)

    def raw(self, step: Callable[[np.ndarray], None]) -> Contender:
        """Return a contender that calls `step` alone, with the motors' targets."""
        hand = self.env.hand
        targets = itertools.accumulate(
            self.actions, lambda last, a: hand.action_map(a, last), initial=hand.start_targets()
        )
        return partial(episode, self.env, step, list(targets)[1:])


def episode(env: Any, step: Callable[[np.ndarray], Any], items: Iterable[np.ndarray]) -> int:
    """Reset, and call `step` with each item; return the number of steps."""
    env.reset(seed=0)
    for item in items:
        step(item)
    return STEPS


def mj_step(steps: Steps) -> Contender:
    """Return MuJoCo alone as a contender."""
    model, data = steps.env.simulator.model, steps.env.simulator.data
    order = [model.actuator(name).id for name in steps.env.hand.actuators]
    n_substeps = steps.env.config.n_substeps

    def step(target: np.ndarray) -> None:
        data.ctrl[order] = target
        mujoco.mj_step(model, data, n_substeps)

    return steps.raw(step)


def bullet(steps: Steps) -> Contender:
    """Return PyBullet alone as a contender: per timestep the object's weight and `stepSimulation`.

    Bullet's own gravity would pull at the hand too, so the weight is a force to be given anew for
    every timestep.
    """
    simulator, n_substeps = steps.env.simulator, steps.env.config.n_substeps

    def step(target: np.ndarray) -> None:
        simulator._targets = target
        simulator._advance(n_substeps)

    return steps.raw(step)


def gymnasium_robotics() -> Contender:
    """Return Gymnasium-Robotics' Boolean touch block environment, mended in memory for MuJoCo 4."""
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    class Mended:
        """Give MuJoCo's enums as integers, for it no longer compares them with NumPy's."""

        mjtJoint = SimpleNamespace(
            **{name: int(value) for name, value in mujoco.mjtJoint.__members__.items()}
        )

        def __getattr__(self, name: str) -> Any:
            return getattr(mujoco, name)

    mujoco_utils.mujoco = Mended()
    gym.register_envs(gymnasium_robotics)
    name = "HandManipulateBlock_BooleanTouchSensors-v1"
    env: Any = gym.make(name, max_episode_steps=STEPS).unwrapped
    assert abs(env.dt - CONTROL_DT) < 1e-9
    return partial(episode, env, env.step, policy_actions(20))


def environments() -> dict[str, Any]:
    """Measure environment steps per second."""
    result: dict[str, Any] = {}
    peer = {"gymnasium-robotics": gymnasium_robotics()}
    for control_dt in (CONTROL_DT, 0.2):
        layouts = {f"layout {x}": Steps("shadow", x, control_dt=control_dt) for x in LAYOUTS}
        alone = {"mj_step": mj_step(layouts["layout 1"])}
        title = f"Shadow Hand in MuJoCo, control period {control_dt} s"
        result[title] = _compared(layouts, alone | (peer if control_dt == CONTROL_DT else {}))
    air = Steps("shadow", "1", raised=True, control_dt=CONTROL_DT)
    title = f"Shadow Hand in MuJoCo in the air, control period {CONTROL_DT} s"
    result[title] = _compared({"layout 1": air}, {"mj_step": mj_step(air)} | peer)
    layouts = {f"layout {x}": Steps("mpl", x) for x in LAYOUTS}
    first = layouts["layout 1"]
    alone = {"stepSimulation": bullet(first)}
    title = f"MPL hand in PyBullet, control period {first.env.config.control_dt} s"
    result[title] = _compared(layouts, alone)
    return result


def _compared(ours: dict[str, Steps], others: dict[str, Contender]) -> dict[str, Any]:
    """Return all rates, ratios of ours to the others', and of each layout to the one before."""
    contenders = {name: steps.ours for name, steps in ours.items()} | others
    pairs = (*itertools.product(ours, others), *((b, a) for a, b in itertools.pairwise(ours)))
    return contest(contenders, *pairs)


def show(scenes: dict[str, Any]) -> None:
    """Print rates of every layout over those of the simulator alone and of the peer."""
    rows = []
    for title, result in scenes.items():
        rates = dict(result["per_s"])
        ours = [(name, rates.pop(name)) for name in list(rates) if name.startswith("layout")]
        alone, *peer = rates.values()
        for name, rate in ours:
            ratios = [f"{rate / other:.2f}" for other in (alone, *peer)]
            rows.append((title, name, *ratios, *[""] * (1 - len(peer))))
    markdown("| scene | | tactilerl / the simulator alone | tactilerl / Gymnasium-Robotics |", rows)
