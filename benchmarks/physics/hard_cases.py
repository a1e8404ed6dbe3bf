r"""Does the physics survive what it was not made for?

Each case runs one scene for some steps and reports how often it diverged (which must be caught),
how often MuJoCo warned, the deepest overlap of hand and object, the fastest object and the worst
violation of a joint's range. Exits with 1 when a case leaves its limits. Writes JSON as it goes, into
what is there already:

    python -m benchmarks hard_cases --steps 100 --out docs/data/hard_cases.json
    python -m benchmarks hard_cases --hand mpl --simulator mujoco --case "random actions" \
        --steps 100000
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from tactilerl.envs.grasp import EJECTED, GraspConfig, GraspEnv, setup

from benchmarks.command import count, earlier, markdown, parser, write
from benchmarks.physics.contacts import deepest

HANDS, SIMULATORS = ("shadow", "mpl"), ("mujoco", "pybullet")
SEED = 50_000
EPISODE = 50  # steps
Policy = Callable[[np.random.Generator, int], np.ndarray]
"""(random numbers, number of actions) -> action."""


def noise(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return uniform actions."""
    return rng.uniform(-1, 1, n)


def bang_bang(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return actions at one end of the range or the other."""
    return rng.choice([-1.0, 1.0], n)


def squeeze(rng: np.random.Generator, n: int) -> np.ndarray:
    """Close all digits as hard as possible, where the hand is."""
    return np.array(3 * [0.0] + (n - 3) * [1.0])


def press(rng: np.random.Generator, n: int) -> np.ndarray:
    """Press down, on the object and into the ground."""
    return -np.eye(n)[2]


@dataclass(frozen=True)
class Limits:
    """What a case may do."""

    overlap: float = 0.025
    """m, of hand and object: half the shipped cube. From there on a contact pushes the other way."""
    speed: float = EJECTED
    """m/s, of the object during a control step."""
    joint: float = 0.25
    """rad beyond a joint's range."""
    diverged: float = 1e-4
    """Of all steps: those in which the physics broke, and said so."""
    warnings: int = 0
    """Of MuJoCo."""


@dataclass(frozen=True)
class Case:
    """One scene and what is done in it."""

    policy: Policy
    choices: dict[str, Any]
    """Fields of GraspConfig; a density, timestep or friction is a factor on the shipped one."""
    limits: Limits = Limits()
    episode: int = EPISODE
    """Steps."""
    start: float | None = None
    """Where the object starts instead, m under the palm's point: deep inside the hand."""


LIGHT = Limits(overlap=0.06)  # squeezed, an object as light as a coin sinks into the fingers
JERKED = Limits(joint=0.5)  # a joint's stop is soft, and a finger meets it at full speed
CASES = {
    "random actions": Case(noise, {}),
    "bang-bang actions": Case(bang_bang, {}, JERKED),
    "full squeeze": Case(squeeze, {}),
    "pressed down": Case(press, {}),
    "pressed down, mass x 10": Case(press, {"object_density": 10}),
    "mass x 100": Case(squeeze, {"object_density": 100}),
    "mass x 10": Case(squeeze, {"object_density": 10}),
    "mass x 0.1": Case(squeeze, {"object_density": 0.1}, LIGHT),
    "mass x 0.01": Case(squeeze, {"object_density": 0.01}, LIGHT),
    "friction 0.1": Case(squeeze, {"friction": 0.1}),
    "friction 3": Case(bang_bang, {"friction": 3}, JERKED),
    "object of 1 cm": Case(bang_bang, {"object_size": 0.01}, JERKED),
    "object of 2.5 cm": Case(bang_bang, {"object_size": 0.025}, JERKED),
    "cube of 8 cm": Case(bang_bang, {"object_size": 0.08}, JERKED),
    "sphere of 8 cm": Case(bang_bang, {"object": "sphere", "object_size": 0.08}, JERKED),
    "cylinder of 8 cm": Case(bang_bang, {"object": "cylinder", "object_size": 0.08}, JERKED),
    "cube of 8 cm, pressed down": Case(press, {"object_size": 0.08}),
    "timestep x 4": Case(noise, {"timestep": 4}),
    "start in deep overlap": Case(squeeze, {}, start=0.0),
    "squeezed without a reset": Case(squeeze, {}, episode=sys.maxsize),
}
FACTORS = ("object_density", "friction", "timestep")
COUNTS = ("diverged", "warnings")


def run(hand: str, simulator: str, case: Case, steps: int) -> dict[str, Any]:
    """Return the worst that a case did in so many steps."""
    rng = np.random.default_rng(SEED)
    worst: dict[str, float] = dict.fromkeys(vars(case.limits), 0)
    with closing(GraspEnv(hand, scene(hand, simulator, case))) as env:
        done = True
        for _ in range(steps):
            if done:
                begin(env, int(rng.integers(2**31)), case.start)
            done, seen = look(env, case.policy(rng, env.action_space.shape[0]))
            for key, value in seen.items():
                worst[key] = worst[key] + value if key in COUNTS else max(worst[key], value)
    allowed = vars(case.limits) | {"diverged": case.limits.diverged * steps}
    is_ok = all(worst[key] <= limit for key, limit in allowed.items())
    return {"steps": steps, **worst, "ok": is_ok}


def scene(hand: str, simulator: str, case: Case) -> GraspConfig:
    """Return the configuration of a case."""
    shipped = setup(hand, simulator=simulator)
    choices = {k: getattr(shipped, k) * v if k in FACTORS else v for k, v in case.choices.items()}
    if "timestep" in choices:
        whole = round(shipped.control_dt / choices["timestep"])
        choices["control_dt"] = whole * choices["timestep"]
    choices |= {"task": "reach-goal", "max_episode_steps": case.episode}
    return setup(hand, simulator=simulator, **choices)


def look(env: GraspEnv, action: np.ndarray) -> tuple[bool, dict[str, float]]:
    """Take one step; return whether the episode is over, and what was seen."""
    before = env.simulator.state().object_position.copy()
    *_, done, info = env.step(action)
    faults = {key: float(info.get(key, 0)) for key in COUNTS}
    if info.get("diverged"):
        return done, faults
    after = env.simulator.state()
    angles = after.joint_positions[3:]
    low, high = np.array([env.simulator.model.joint(j).range for j in env.hand.joints[3:]]).T
    return done, {
        **faults,
        "overlap": deepest(env),
        "speed": float(np.linalg.norm(after.object_position - before)) / env.config.control_dt,
        "joint": float(np.maximum(low - angles, angles - high).max()),
    }


def begin(env: GraspEnv, seed: int, start: float | None) -> None:
    """Reset the scene; with `start`, once more with the object inside the hand."""
    env.reset(seed=seed)
    if start is not None:
        place = env.simulator.state().palm - [0.0, 0.0, start]
        env.simulator.reset(env.hand.start_positions(), place, 0.0)


def main() -> int:
    """Play all cases of every hand in every simulator, or those that flags name."""
    flags = parser(__doc__)
    flags.add_argument("--hand", choices=HANDS, action="append")
    flags.add_argument("--simulator", choices=SIMULATORS, action="append")
    flags.add_argument("--case", choices=CASES, action="append")
    flags.add_argument("--steps", type=count, default=1000, help="control steps of each case")
    options = flags.parse_args()
    result = earlier(options.out)
    is_ok = True
    hands, simulators = options.hand or HANDS, options.simulator or SIMULATORS
    for hand, simulator, name in itertools.product(hands, simulators, options.case or CASES):
        pair = f"{hand} in {simulator}"
        row = run(hand, simulator, CASES[name], options.steps)
        result.setdefault(pair, {})[name] = row
        write(options.out, result)
        if not row["ok"]:
            is_ok = False
            print(f"{pair}, {name}: left its limits")
    show(result)
    return 0 if is_ok else 1


def show(results: dict[str, dict[str, dict[str, Any]]]) -> None:
    """Print overlap, speed and joint in a column for each pair."""

    def short(row: dict[str, Any]) -> str:
        return f"{1e3 * row['overlap']:.1f} / {row['speed']:.1f} / {row['joint']:.2f}"

    rows = ((name, *(short(of[name]) for of in results.values() if name in of)) for name in CASES)
    markdown(f"| case | {' | '.join(results)} |", rows)
