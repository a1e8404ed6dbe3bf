"""How fast are the environments and PPO's updates, against their limits and peers?

The contenders take turns for several rounds, on one thread in one process but where a second core
is what is measured; what counts are the ratios, of medians over rounds. Prints tables and writes JSON:

    python benchmarks/speed.py --out docs/data/speed.json
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from tactilerl import envs
from tactilerl.algos import Transition
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector

CONTROL_DT = 0.04  # s: gymnasium-robotics' own, 20 steps of 2 ms
STEPS = 250
ROUNDS = 7
# The shapes of PPO-for-Beginners' minibatch on the paper's PyBullet set-up, layout 2.
BATCH, OBS, ACTIONS = 1000, 97, 7


def per_second(run: Callable[[], int]) -> float:
    """Things done per second of one call that says how many it did."""
    started = time.perf_counter()
    return run() / (time.perf_counter() - started)


def rounds(contenders: dict[str, Callable[[], int]]) -> dict[str, float]:
    """Median rate of each contender; they take turns, after one round to warm up."""
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    for round_ in range(ROUNDS + 1):
        for name, run in contenders.items():
            rate = per_second(run)
            if round_:
                rates[name].append(rate)
    return {name: statistics.median(values) for name, values in rates.items()}


# -- environments ----------------------------------------------------------------------------


def policy_actions(size: int) -> np.ndarray:
    """What an untrained PPO policy does: Gaussian actions of the paper's variance, 0.05."""
    noise = np.random.default_rng(0).standard_normal((STEPS, size))
    return np.clip(0.05**0.5 * noise, -1, 1)


def shadow_steps(
    control_dt: float, layout: str, raised: bool = False
) -> tuple[Callable[[], int], Callable[[], int]]:
    """(our env.step, raw mj_step) over the same random actions in the same scene.

    An untrained policy presses the hand on the cube all the time; `raised` keeps the hand in
    the air, as gymnasium-robotics' hand is once its block has fallen off.
    """
    choices = {"task": "reach-goal", "control_dt": control_dt, "max_episode_steps": STEPS}
    env: Any = envs.make("shadow", layout=layout, **choices)
    actions = policy_actions(env.action_space.shape[0])
    if raised:
        actions[:, 2] = 1.0
    model, data = env.simulator.model, env.simulator.data
    targets = [env.hand.action_map(action, None) for action in actions]
    order = [model.actuator(name).id for name in env.hand.actuators]
    n_substeps = env.config.n_substeps

    def ours() -> int:
        env.reset(seed=0)
        for action in actions:
            env.step(action)
        return STEPS

    def raw() -> int:
        env.reset(seed=0)
        for target in targets:
            data.ctrl[order] = target
            mujoco.mj_step(model, data, n_substeps)
        return STEPS

    return ours, raw


def gymnasium_robotics_steps() -> Callable[[], int]:
    """The Boolean touch block environment (92 zones), mended in memory for MuJoCo 4."""
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    class Mended:
        """MuJoCo 4 no longer compares its enums with NumPy's integers."""

        mjtJoint = SimpleNamespace(
            **{name: int(value) for name, value in mujoco.mjtJoint.__members__.items()}
        )

        def __getattr__(self, name: str) -> Any:
            return getattr(mujoco, name)

    mujoco_utils.mujoco = Mended()
    gym.register_envs(gymnasium_robotics)
    name = "HandManipulateBlock_BooleanTouchSensors-v1"
    env: Any = gym.make(name, max_episode_steps=STEPS).unwrapped
    actions = policy_actions(20)

    def run() -> int:
        env.reset(seed=0)
        for action in actions:
            env.step(action)
        return STEPS

    assert abs(env.dt - CONTROL_DT) < 1e-9
    return run


def environments() -> dict[str, Any]:
    """Environment steps per second."""
    result: dict[str, Any] = {}
    for control_dt in (CONTROL_DT, 0.2):
        contenders: dict[str, Callable[[], int]] = {}
        for layout in ("1", "6"):
            contenders[f"layout {layout}"], contenders[f"mj_step {layout}"] = shadow_steps(
                control_dt, layout
            )
        if control_dt == CONTROL_DT:
            contenders["layout 1, in the air"], _ = shadow_steps(control_dt, "1", raised=True)
            contenders["gymnasium-robotics"] = gymnasium_robotics_steps()
        rates = rounds(contenders)
        result[f"control_dt {control_dt}"] = {"steps_per_s": rates, "ratios": _ratios(rates)}
    return result


def _ratios(rates: dict[str, float]) -> dict[str, float]:
    ratios = {
        f"layout {layout} / mj_step": rates[f"layout {layout}"] / rates[f"mj_step {layout}"]
        for layout in ("1", "6")
    }
    if "gymnasium-robotics" in rates:
        for name in ("layout 1", "layout 6", "layout 1, in the air"):
            ratios[f"{name} / gymnasium-robotics"] = rates[name] / rates["gymnasium-robotics"]
    ratios["cost of layout 1 against layout 6"] = rates["layout 6"] / rates["layout 1"]
    return ratios


# -- several environments ---------------------------------------------------------------------


def several(hand: str, cores: int, n: int = 4) -> Callable[[], int]:
    """Steps of `n` environments side by side; the same actions whatever the cores."""
    pool = vector.start(partial(envs.make, hand, task="reach-goal", layout="2"), n, cores)

    def run() -> int:
        rng = np.random.default_rng(0)
        for index in range(n):
            pool.reset(index, index)
        for _ in range(20):
            pool.step(range(n), rng.uniform(-1, 1, (n, *pool.action_space.shape)))
        return 20 * n

    return run


def parallel() -> dict[str, Any]:
    """What a second core gives: threads in MuJoCo, processes in PyBullet; resets included."""
    rates, ratios = {}, {}
    for hand in ("shadow", "mpl"):
        found = rounds({"1 core": several(hand, 1), "2 cores": several(hand, 2)})
        rates |= {f"{hand}, {cores}": rate for cores, rate in found.items()}
        ratios[f"{hand}: 2 cores / 1"] = found["2 cores"] / found["1 core"]
    return {"steps_per_s": rates, "ratios": ratios}


# -- PPO's updates ---------------------------------------------------------------------------


class RandomPool:
    """Episodes of random numbers in the shapes of the benchmark."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
        self.rng, self.steps = np.random.default_rng(0), 0

    def __len__(self) -> int:
        return 1

    def reset(self, index: int, seed: int) -> Any:
        """A random observation."""
        return self.rng.standard_normal(OBS, dtype=np.float32)

    def step(self, indices: Any, actions: Any) -> list[Transition]:
        """A random observation and reward; every 100th ends the episode."""
        self.steps += 1
        obs, reward = self.reset(0, 0), float(self.rng.standard_normal())
        return [Transition(obs, reward, self.steps % 100 == 0, False, {})]


def our_updates(passes: int = 8) -> Callable[[], int]:
    """PPO.update on a batch of 1,000: six minibatches a pass."""
    config = PPOConfig(n_passes=passes)
    learner = PPO(config, RandomPool(), Communicator(), seed=0, total_timesteps=BATCH)
    learner.collect()
    return lambda: int(learner.update()["updates"])


def sb3_updates(passes: int = 8) -> Callable[[], int]:
    """Stable-Baselines3's PPO.train on a batch of the same shapes and networks."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.logger import Logger

    class RandomEnv(gym.Env):
        """The same random numbers behind Gymnasium's interface."""

        def __init__(self) -> None:
            self.pool = RandomPool()
            self.observation_space = self.pool.observation_space
            self.action_space = self.pool.action_space

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return self.pool.reset(0, 0), {}

        def step(self, action: Any) -> Any:
            return tuple(self.pool.step([0], action)[0])

    layers = {"pi": [256] * 3, "vf": [256] * 3}
    model = sb3.PPO(
        "MlpPolicy", RandomEnv(), n_steps=BATCH, batch_size=-(-BATCH // 6), n_epochs=passes,
        policy_kwargs={"net_arch": layers, "activation_fn": torch.nn.ReLU}, device="cpu",
    )  # fmt: skip
    model.set_logger(Logger(None, []))
    model.learn(BATCH)
    model.set_logger(Logger(None, []))

    def run() -> int:
        model.train()
        return 6 * passes

    return run


def matrix_products(passes: int = 8) -> Callable[[], int]:
    """The matrix products of forward and backward pass alone: what no implementation beats."""
    n = BATCH // 6
    hidden = [torch.randn(n, 256) for _ in range(3)]
    inputs = [torch.randn(n, OBS), *hidden]

    def run() -> int:
        for _ in range(6 * passes):
            for outputs in (ACTIONS, 1):
                sizes = [OBS, 256, 256, 256, outputs]
                for layer, x in enumerate(inputs):
                    weight, grad = weights[sizes[layer], sizes[layer + 1]], grads[sizes[layer + 1]]
                    x @ weight.T
                    grad.T @ x
                    if layer:
                        grad @ weight
        return 6 * passes

    pairs = [(OBS, 256), (256, 256), (256, ACTIONS), (256, 1)]
    weights = {(i, o): torch.randn(o, i) for i, o in pairs}
    grads = {o: torch.randn(n, o) for _, o in pairs}
    return run


def updates() -> dict[str, Any]:
    """Minibatch updates (actor and critic) per second."""
    contenders = {"tactilerl": our_updates(), "matrix products": matrix_products()}
    contenders["stable-baselines3"] = sb3_updates()
    rates = rounds(contenders)
    ratios = {
        "tactilerl / stable-baselines3": rates["tactilerl"] / rates["stable-baselines3"],
        "tactilerl / matrix products": rates["tactilerl"] / rates["matrix products"],
    }
    return {"updates_per_s": rates, "ratios": ratios}


# -- report ----------------------------------------------------------------------------------


def show(title: str, rates: dict[str, float], ratios: dict[str, float]) -> None:
    """One table."""
    table = Table("", "per second", title=title)
    for name, rate in rates.items():
        table.add_row(name, f"{rate:,.0f}")
    table.add_section()
    for name, ratio in ratios.items():
        table.add_row(name, f"{ratio:.2f} ×")
    Console().print(table)


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("env", "ppo", "parallel"), help="one part instead of all")
    parser.add_argument("--out", type=Path, help="write JSON here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    packages = ("mujoco", "torch", "numpy", "gymnasium-robotics", "stable_baselines3")
    result: dict[str, Any] = {
        "machine": {"processor": platform.processor() or platform.machine(), "threads": 1},
        "versions": {name: version(name) for name in packages},
    }
    if options.only in (None, "env"):
        result["environment"] = environments()
        for title, part in result["environment"].items():
            show(f"environment steps, {title} s", part["steps_per_s"], part["ratios"])
    if options.only in (None, "parallel"):
        result["parallel"] = part = parallel()
        show("four environments, steps", part["steps_per_s"], part["ratios"])
    if options.only in (None, "ppo"):
        result["ppo"] = part = updates()
        show("PPO minibatch updates, 167 × 97 → 7", part["updates_per_s"], part["ratios"])
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
