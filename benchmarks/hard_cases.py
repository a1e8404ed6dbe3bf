"""Does the physics survive what it was not made for?

Each case runs one scene for some steps and reports how often it diverged (which must be caught),
the deepest overlap of hand and object, the fastest object and the worst violation of a joint's
range. Exits with 1 when a case leaves its limits. Prints tables and writes JSON:

    python benchmarks/hard_cases.py --steps 1000 --out docs/data/hard_cases.json
    python benchmarks/hard_cases.py --hand mpl --simulator pybullet --steps 100000
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from speed_vs_error import deepest

from tactilerl.envs.grasp import GraspEnv, setup

SEED = 50_000
EPISODE = 50  # steps
Policy = Callable[[np.random.Generator, int, int], np.ndarray]
"""(random numbers, step of the episode, number of actions) -> action."""


def noise(rng: np.random.Generator, step: int, n: int) -> np.ndarray:
    """Uniform."""
    return rng.uniform(-1, 1, n)


def bang_bang(rng: np.random.Generator, step: int, n: int) -> np.ndarray:
    """From one end of the range to the other."""
    return rng.choice([-1.0, 1.0], n)


def squeeze(rng: np.random.Generator, step: int, n: int) -> np.ndarray:
    """Close everything as hard as it goes, where the hand is."""
    return np.concatenate([np.zeros(3), np.ones(n - 3)])


def press(rng: np.random.Generator, step: int, n: int) -> np.ndarray:
    """Down, on the object and into the ground."""
    return np.concatenate([[0.0, 0.0, -1.0], np.zeros(n - 3)])


@dataclass(frozen=True)
class Limits:
    """What a case may do."""

    overlap: float = 0.020
    """m, of hand and object: a phalanx is about as thick."""
    speed: float = 10.0
    """m/s, of the object between two control steps."""
    joint: float = 0.25
    """rad beyond a joint's range."""
    diverged: int = 0
    """Episodes that ended because the physics broke, and said so."""


@dataclass(frozen=True)
class Case:
    """One scene and what is done in it."""

    policy: Policy
    choices: dict[str, Any]
    """Fields of GraspConfig; a density, timestep or friction is a factor on the shipped one."""
    limits: Limits = Limits()
    start: float | None = None
    """Where the object starts instead, m under the palm's point: deep inside the hand."""


LIGHT = Limits(overlap=0.06)  # squeezed, an object as light as a coin sinks into the fingers
CASES = {
    "random actions": Case(noise, {}),
    "bang-bang actions": Case(bang_bang, {}),
    "full squeeze": Case(squeeze, {}),
    "pressed down": Case(press, {}),
    "pressed down, mass x 10": Case(press, {"object_density": 10}),
    "mass x 100": Case(squeeze, {"object_density": 100}),
    "mass x 10": Case(squeeze, {"object_density": 10}),
    "mass x 0.1": Case(squeeze, {"object_density": 0.1}, LIGHT),
    "mass x 0.01": Case(squeeze, {"object_density": 0.01}, LIGHT),
    "friction 0.1": Case(squeeze, {"friction": 0.1}),
    "friction 3": Case(bang_bang, {"friction": 3}),
    "object of 1 cm": Case(bang_bang, {"object_size": 0.01}),
    "object of 2.5 cm": Case(bang_bang, {"object_size": 0.025}),
    "timestep x 4": Case(noise, {"timestep": 4}),
    "start in deep overlap": Case(squeeze, {}, start=0.0),
}
FACTORS = ("object_density", "friction", "timestep")


def run(hand: str, simulator: str, case: Case, steps: int) -> dict[str, Any]:
    """The worst of a case."""
    shipped = setup(hand, simulator=simulator)
    choices = {k: getattr(shipped, k) * v if k in FACTORS else v for k, v in case.choices.items()}
    if "timestep" in choices:
        whole = round(shipped.control_dt / choices["timestep"])
        choices["control_dt"] = whole * choices["timestep"]
    config = setup(hand, simulator=simulator, task="reach-goal", max_episode_steps=EPISODE, **choices)
    rng = np.random.default_rng(SEED)
    worst = {"diverged": 0, "overlap": 0.0, "speed": 0.0, "joint": 0.0}
    with closing(GraspEnv(hand, config)) as env:
        joints = env.hand.joints[3:]
        low, high = np.array([env.simulator.model.joint(joint).range for joint in joints]).T
        done, step = True, 0
        for _ in range(steps):
            if done:
                begin(env, int(rng.integers(2**31)), case.start)
                position, step = env.simulator.object_state().position, 0
            *_, done, info = env.step(case.policy(rng, step, env.action_space.shape[0]))
            step += 1
            if info.get("diverged"):
                worst["diverged"] += 1
                continue
            last, position = position, env.simulator.object_state().position
            angles = env.simulator.joint_state()[0][3:]
            beyond = np.maximum(low - angles, angles - high).max()
            seen = {
                "overlap": deepest(env),
                "speed": float(np.linalg.norm(position - last)) / config.control_dt,
                "joint": float(beyond),
            }
            worst |= {key: max(worst[key], value) for key, value in seen.items()}
    limits = {key: getattr(case.limits, key) for key in worst}
    return worst | {"limits": limits, "ok": all(worst[key] <= limits[key] for key in worst)}


def begin(env: GraspEnv, seed: int, start: float | None) -> None:
    """Reset; with `start`, once more with the object inside the hand."""
    env.reset(seed=seed)
    if start is not None:
        place = env.simulator.link_positions()[0] - [0.0, 0.0, start]
        env.simulator.reset(env.hand.start_positions(), place, 0.0)


def main() -> int:
    """All cases of every hand in every simulator, or of those asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hand", choices=("shadow", "mpl"), action="append")
    parser.add_argument("--simulator", choices=("mujoco", "pybullet"), action="append")
    parser.add_argument("--steps", type=int, default=1000, help="control steps of each case")
    parser.add_argument("--out", type=Path, help="write JSON here")
    options = parser.parse_args()
    result: dict[str, Any] = {"steps": options.steps}
    for hand in options.hand or ("shadow", "mpl"):
        for simulator in options.simulator or ("mujoco", "pybullet"):
            rows = {name: run(hand, simulator, case, options.steps) for name, case in CASES.items()}
            result[f"{hand} in {simulator}"] = rows
            show(f"{hand} in {simulator}, {options.steps} steps", rows)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    rows = [row for value in result.values() if isinstance(value, dict) for row in value.values()]
    return 0 if all(row["ok"] for row in rows) else 1


def show(title: str, rows: dict[str, dict[str, Any]]) -> None:
    """One table."""
    table = Table("case", title=title)
    for column in ("diverged", "overlap, mm", "object, m/s", "beyond a joint's range", ""):
        table.add_column(column, justify="right")
    for name, row in rows.items():
        table.add_row(
            *(name, str(row["diverged"]), f"{1e3 * row['overlap']:.1f}", f"{row['speed']:.2f}"),
            *(f"{row['joint']:.3f}", "ok" if row["ok"] else "LEFT ITS LIMITS"),
        )
    Console(width=110).print(table)


if __name__ == "__main__":
    sys.exit(main())
