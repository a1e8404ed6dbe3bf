"""Does a soft skin give way as a silicone pad does, and do grasps with it hold?

A sphere of a fingertip's radius is pressed into the MPL hand's palm, and thrown at it; the scripted
grasps are held for 5 s. Depths are compared with Long et al.'s finite elements for a pad on a rigid
base. Moduli are neo-Hookean fits up to a strain of 0.5 to tensile tests of the Soft Robotics Materials
Database (Marechal et al., 2020, doi.org/10.1089/soro.2019.0115):

    python -m benchmarks softness --out docs/data/softness.json
"""

from __future__ import annotations

import itertools
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import brentq
from tactilerl.envs import scripted
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.skin import RADIUS

from benchmarks.command import markdown, measure_missing, parser
from benchmarks.physics.contacts import deepest

SKINS: dict[str, dict[str, float]] = {
    "none": {},
    "Ecoflex 00-30, 3 mm": {"skin_thickness": 0.003, "skin_modulus": 46_000.0},
    "Dragon Skin 10, 2 mm": {"skin_thickness": 0.002, "skin_modulus": 140_000.0},
    "Dragon Skin 10, 3 mm": {"skin_thickness": 0.003, "skin_modulus": 140_000.0},
}
FORCES = 0.1, 0.3, 1.0, 3.0  # N
MASSES = 0.005, 0.02, 0.1  # kg
TIMESTEPS = 1, 4  # times the shipped one
SPEED = 0.5  # m/s
STARTS, SECONDS = 10, 5.0


def law(depth: float, skin_thickness: float, skin_modulus: float) -> float:
    """Return the force on a fingertip `depth` deep in a pad, N."""
    omega = (RADIUS * depth / skin_thickness**2) ** 1.5
    hertz = 16 / 9 * skin_modulus * RADIUS**0.5 * depth**1.5
    return hertz * (1 + 1.15 * omega ** (1 / 3) + 9.5 * omega + 4.212 * omega**2) / (1 + 2.3 * omega)


def depth(force: float, **skin: float) -> float:
    """Return how deep a force presses a fingertip into a pad, m."""
    return float(brentq(lambda x: law(x, **skin) - force, 1e-9, 0.1))


def sphere(mass: float, timestep: float = 1, **skin: float) -> GraspEnv:
    """Return the MPL hand without gravity beside a sphere of a fingertip's radius."""
    shipped, density = setup("mpl", simulator="mujoco"), mass / (4 / 3 * np.pi * RADIUS**3)
    times = {name: timestep * getattr(shipped, name) for name in ("timestep", "control_dt")}
    thing = {"object": "sphere", "object_size": 2 * RADIUS, "object_density": density}
    env = GraspEnv("mpl", setup("mpl", simulator="mujoco", **thing, **times, **skin))
    env.simulator.model.opt.gravity[:] = 0.0
    return env


def below(env: GraspEnv, force: float, speed: float) -> Any:
    """Put the sphere just below the palm, pushed up with `force`, N, or moving up at `speed`, m/s."""
    sim: Any = env.simulator
    place = env.palm_skin - [0.0, 0.0, RADIUS + 1e-3]
    sim.reset(env.hand.start_positions(), place, 0.0)
    sim.data.xfrc_applied[sim._object_body, 2] = force
    sim.data.qvel[sim._object_qvel + 2] = speed
    return sim


def pressed(mass: float, **skin: float) -> list[float]:
    """Return the depths at rest under all forces, m."""
    depths = []
    with closing(sphere(mass, **skin)) as env:
        for force in FORCES:
            below(env, force, 0.0).step(env.hand.start_targets(), 2000)
            depths.append(deepest(env))
    return depths


def rebound(mass: float, timestep: float, **skin: float) -> float:
    """Return the sphere's speed when it leaves the palm, as a share of that before."""
    with closing(sphere(mass, timestep, **skin)) as env:
        sim = below(env, 0.0, SPEED)
        sim.step(env.hand.start_targets(), 100)
        return float(np.linalg.norm(sim.state().object_velocity)) / SPEED


def held(hand: str, **skin: float) -> dict[str, Any]:
    """Return how often the scripted grasp holds, and medians of slip and deepest contact, m."""
    holds, slips, depths = 0, [], []
    with closing(GraspEnv(hand, setup(hand, simulator="mujoco", **skin))) as env:
        grasp = scripted.grasp_for(env)
        for number in range(STARTS):
            start, places = scripted.perturbed_start(env, 0, number), []
            for is_held in scripted.hold_steps(env, grasp, start, SECONDS):
                state, is_up = env.simulator.state(), is_held
                places.append(state.object_position - state.palm)
            holds += is_up
            slips.append(float(np.linalg.norm(places[-1] - places[0])))
            depths.append(deepest(env))
    return {"holds": holds, "slip": float(np.median(slips)), "depth": float(np.median(depths))}


def measure(skin: dict[str, float]) -> dict[str, Any]:
    """Return all that is measured of a skin."""
    steps = itertools.product(MASSES, TIMESTEPS)
    return {
        "law": [depth(force, **skin) for force in FORCES] if skin else None,
        "depths": {str(mass): pressed(mass, **skin) for mass in MASSES},
        "rebound": {f"{mass}, {step}": rebound(mass, step, **skin) for mass, step in steps},
        "grasps": {hand: held(hand, **skin) for hand in ("mpl", "shadow")},
    }


def main() -> None:
    """Measure what is missing, then print the tables."""
    out = parser(__doc__).parse_args().out
    result = measure_missing(out, {name: partial(measure, skin) for name, skin in SKINS.items()})
    show(result)
    show_grasps(result)


def show(result: dict[str, Any]) -> None:
    """Print depths by the law and in MuJoCo."""
    rows = []
    for name, row in result.items():
        if row["law"]:
            rows.append((name, "law", *_mm(row["law"])))
        for mass, depths in row["depths"].items():
            rows.append((name, f"{1e3 * float(mass):g} g", *_mm(depths)))
    markdown(f"| skin | sphere | {' | '.join(f'{force:g} N' for force in FORCES)} |", rows)


def show_grasps(result: dict[str, Any]) -> None:
    """Print what becomes of scripted grasps."""
    rows = []
    for name, row in result.items():
        cells = [
            f"{one['holds']} of {STARTS} | {1e3 * one['slip']:.1f} | {1e3 * one['depth']:.1f}"
            for one in row["grasps"].values()
        ]
        rows.append((name, *cells, f"{max(row['rebound'].values()):.2f}"))
    head = " | ".join(f"{hand}: held | slip, mm | deepest, mm" for hand in ("MPL", "Shadow"))
    markdown(f"| skin | {head} | speed after / before |", rows)


def _mm(depths: list[float]) -> list[str]:
    return [f"{1e3 * one:.2f}" for one in depths]
