"""What do the physics settings cost, and what do they get wrong?

Scripted grasps with perturbed starts, held for 5 s, under one setting at a time, for each hand in
each simulator, against a reference with small, well-solved steps, which is itself compared with
one of half its step. Also what a spinning brick in free fall loses. Prints tables and writes JSON:

    python benchmarks/speed_vs_error.py --out docs/data/speed_vs_error.json
    python benchmarks/speed_vs_error.py --hand mpl --simulator pybullet --grasps 3
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from tactilerl.envs import scripted
from tactilerl.envs.grasp import GraspEnv, setup

SECONDS = 5.0
SEED = 30_000  # starts of this benchmark; the doctor and the search used others
SIZES = {"shadow": (0.04, 0.05), "mpl": (0.045, 0.05)}  # of cubes, m
SHIPPED = "as shipped"
CLEARLY = 1.15
BULLET = "tactilerl.envs.simulators.pybullet"
Setting = tuple[float, dict[str, Any]]
"""(timestep in units of the shipped one; fields of MuJoCo's options, or constants of our PyBullet
module)."""

EXACT = {"iterations": 200, "tolerance": 1e-12}
REFERENCES: dict[str, tuple[Setting, Setting]] = {
    "mujoco": ((1 / 8, EXACT), (1 / 16, EXACT)),
    "pybullet": ((1 / 4, {"SOLVER_ITERATIONS": 100}), (1 / 8, {"SOLVER_ITERATIONS": 100})),
}
SETTINGS: dict[str, dict[str, Setting]] = {
    "mujoco": {
        SHIPPED: (1, {}),
        "timestep / 4": (1 / 4, {}),
        "timestep / 2": (1 / 2, {}),
        "timestep x 2": (2, {}),
        "6 iterations": (1, {"iterations": 6}),
        "10 iterations": (1, {"iterations": 10}),
        "50 iterations": (1, {"iterations": 50}),
        "implicitfast": (1, {"integrator": 3}),
        "dense Jacobian": (1, {"jacobian": 0}),
        "impratio 10": (1, {"impratio": 10.0}),
        "pyramidal, impratio 1": (1, {"cone": 0, "impratio": 1.0}),
    },
    "pybullet": {
        SHIPPED: (1, {}),
        "timestep / 2": (1 / 2, {}),
        "timestep x 2": (2, {}),
        "20 iterations": (1, {"SOLVER_ITERATIONS": 20}),
        "30 iterations": (1, {"SOLVER_ITERATIONS": 30}),
        "100 iterations": (1, {"SOLVER_ITERATIONS": 100}),
        "no friction anchors": (1, {"FRICTION_ANCHOR": 0}),
        "no spinning friction": (1, {"SPINNING_FRICTION": 0.0}),
        "added inertia 1e-5": (1, {"ADDED_INERTIA": 1e-5}),
        "added inertia 1e-3": (1, {"ADDED_INERTIA": 1e-3}),
    },
}


@dataclass(frozen=True)
class Trace:
    """What several grasps did during their holds, in the palm's frame."""

    positions: np.ndarray
    """(grasps, steps, 3) of the object, m."""
    rotations: np.ndarray
    """(grasps, steps, 3, 3) of the object."""
    bits: np.ndarray
    """(grasps, steps, taxels)"""
    held: np.ndarray
    """bool (grasps,)"""
    overlap: float
    """Deepest contact of the hand with the object, m."""
    warnings: int
    """Of MuJoCo."""
    seconds: float
    """Processor time."""


@contextmanager
def environment(hand: str, simulator: str, size: Any, setting: Setting) -> Iterator[GraspEnv]:
    """A scene under one setting."""
    factor, options = setting
    timestep = factor * setup(hand).timestep
    choices = {"timestep": timestep, "control_dt": timestep}
    config = setup(hand, simulator=simulator, layout="1", object_size=size, **choices)
    with ExitStack() as stack:
        if simulator == "pybullet":
            module = importlib.import_module(BULLET)
            for name, value in options.items():
                stack.enter_context(patch.object(module, name, value))
        env = stack.enter_context(closing(GraspEnv(hand, config)))
        if simulator == "mujoco":
            for name, value in options.items():
                setattr(env.simulator.model.opt, name, value)
        yield env


def record(hand: str, simulator: str, size: float, setting: Setting, grasps: int) -> Trace:
    """Perform the grasps under one setting; a dropped object counts as it falls."""
    with environment(hand, simulator, size, setting) as env:
        return perform(env, grasps, scripted.period(setup(hand).timestep))


def perform(env: GraspEnv, grasps: int, dt: float) -> Trace:
    """The grasps in one environment, with targets every `dt` s."""
    n = round(SECONDS / dt)
    positions, rotations = np.empty((grasps, n, 3)), np.empty((grasps, n, 3, 3))
    bits, held = np.empty((grasps, n, len(env.taxels)), bool), np.empty(grasps, bool)
    overlap = 0.0
    started = time.process_time()
    for index, start in enumerate(scripted.perturbed_starts(env, SEED, grasps)):
        hold = scripted.hold_steps(env, scripted.grasp_for(env), start, SECONDS, dt)
        for step, is_up in enumerate(hold):
            thing = env.simulator.object_state()
            (palm,), (frame,) = env.simulator.link_poses((env.hand.palm,))
            positions[index, step] = frame.T @ (thing.position - palm)
            rotations[index, step] = frame.T @ thing.rotation
            bits[index, step] = env.taxel_readings()
            overlap = max(overlap, deepest(env))
            held[index] = is_up
    seconds = time.process_time() - started
    return Trace(positions, rotations, bits, held, overlap, env.simulator.warnings, seconds)


def deepest(env: GraspEnv) -> float:
    """How far hand and object overlap now, m."""
    simulator: Any = env.simulator
    if env.config.simulator == "pybullet":
        bullet = importlib.import_module(BULLET).pybullet
        points = bullet.getContactPoints(
            simulator.hand, simulator.object, physicsClientId=simulator.client
        )
        return -min([point[8] for point in points], default=0.0)
    thing, ground = simulator.model.geom("object").id, simulator.model.geom("ground").id
    depths = [
        contact.dist
        for contact in simulator.data.contact
        if thing in contact.geom and ground not in contact.geom
    ]
    return -min(depths, default=0.0)


def compare(trace: Trace, reference: Trace, shipped_seconds: float) -> dict[str, float]:
    """Errors of one setting over the grasps that hold in it and in the reference."""
    both = trace.held & reference.held
    row: dict[str, float] = {
        "speed": shipped_seconds / trace.seconds,
        "outcomes_changed": int((trace.held != reference.held).sum()),
        "overlap_mm": 1e3 * trace.overlap,
        "warnings": trace.warnings,
    }
    if not both.any():
        return row
    offset = trace.positions[both] - reference.positions[both]
    error = 1e3 * np.linalg.norm(offset, axis=-1).max(axis=1)
    turned = np.swapaxes(trace.rotations[both], -1, -2) @ reference.rotations[both]
    angle = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude().reshape(both.sum(), -1)
    drift = 1e3 * np.linalg.norm(trace.positions[both, -1] - trace.positions[both, 0], axis=-1)
    return row | {
        "error_median_mm": float(np.median(error)),
        "error_worst_mm": float(error.max()),
        "angle_median_rad": float(np.median(angle.max(axis=1))),
        "slip_5s_mm": float(np.median(drift)),
        "bits_wrong": float((trace.bits[both] != reference.bits[both]).sum(axis=-1).mean()),
    }


def free_flight(hand: str, simulator: str, setting: Setting) -> dict[str, float]:
    """What a spinning brick in free fall loses in 0.3 s: relative error of the height fallen, and
    of the rotational energy."""
    with environment(hand, simulator, (0.02, 0.03, 0.05), setting) as env:
        sim, n = env.simulator, round(0.3 / env.config.timestep)
        sim.reset(env.hand.start_positions(), np.array([0.5, 0.5, 1.0]), 0.0)
        spin(env, np.array([3.0, 2.0, 1.0]))
        before = rotational_energy(env)
        sim.step(env.hand.start_targets(), n)
        fallen = 1.0 - sim.object_state().position[2]
        wanted = 0.5 * 9.81 * (n * env.config.timestep) ** 2
        return {
            "fall_error": abs(fallen / wanted - 1.0),
            "spin_energy_error": abs(rotational_energy(env) / before - 1.0),
        }


def spin(env: GraspEnv, velocity: np.ndarray) -> None:
    """Give the object an angular velocity, rad/s, world frame."""
    simulator: Any = env.simulator
    if env.config.simulator == "pybullet":
        bullet = importlib.import_module(BULLET).pybullet
        bullet.resetBaseVelocity(
            simulator.object, angularVelocity=velocity.tolist(), physicsClientId=simulator.client
        )
    else:
        simulator.data.joint("object").qvel[3:] = velocity  # the object is not turned yet


def rotational_energy(env: GraspEnv) -> float:
    """Of the object, J."""
    simulator: Any = env.simulator
    edges = 2 * np.array(env.shape.half_size)
    inertia = simulator.scene.mass / 12 * (np.square(edges).sum() - np.square(edges))
    if env.config.simulator == "pybullet":
        bullet = importlib.import_module(BULLET).pybullet
        _, velocity = bullet.getBaseVelocity(simulator.object, physicsClientId=simulator.client)
        local = simulator.object_state().rotation.T @ np.array(velocity)
    else:
        local = simulator.data.joint("object").qvel[3:]
    return float(0.5 * (inertia * np.square(local)).sum())


def mark_front(rows: dict[str, dict[str, Any]]) -> None:
    """Which settings that hold something does no other beat: clearly faster, with no more error and
    no more outcomes changed? Less than CLEARLY is within the noise of the machine."""
    for row in rows.values():
        row["on_front"] = "error_median_mm" in row and not any(
            other["speed"] > CLEARLY * row["speed"]
            and other.get("error_median_mm", np.inf) <= row.get("error_median_mm", np.inf)
            and other["outcomes_changed"] <= row["outcomes_changed"]
            for other in rows.values()
        )


def measure(hand: str, simulator: str, size: float, grasps: int) -> dict[str, dict[str, Any]]:
    """A row for each setting, the first for the finer reference."""
    coarse, fine = (record(hand, simulator, size, s, grasps) for s in REFERENCES[simulator])
    settings = SETTINGS[simulator]
    traces = {name: record(hand, simulator, size, s, grasps) for name, s in settings.items()}
    shipped = traces[SHIPPED].seconds
    rows = {name: compare(trace, fine, shipped) for name, trace in traces.items()}
    mark_front(rows)
    for name, setting in settings.items():
        rows[name] |= free_flight(hand, simulator, setting)
    return {"reference, twice the step": compare(coarse, fine, shipped), **rows}


COLUMNS = {
    "speed": "speed",
    "error_median_mm": "error, mm",
    "error_worst_mm": "worst, mm",
    "angle_median_rad": "rad",
    "slip_5s_mm": "slip, mm",
    "overlap_mm": "overlap, mm",
    "bits_wrong": "bits wrong",
    "outcomes_changed": "outcomes changed",
    "fall_error": "fall",
    "spin_energy_error": "spin",
    "warnings": "warnings",
}


def show(title: str, rows: dict[str, dict[str, Any]]) -> None:
    """One table; settings on the front have a star."""
    table = Table("setting", title=title)
    for column in COLUMNS.values():
        table.add_column(column, justify="right")
    for name, row in rows.items():
        cells = (f"{row[key]:.3g}" if key in row else "" for key in COLUMNS)
        table.add_row(f"{name} *" if row.get("on_front") else name, *cells)
    Console(width=170).print(table)


def main() -> None:
    """Measure every hand in every simulator, or those asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hand", choices=sorted(SIZES), action="append")
    parser.add_argument("--simulator", choices=sorted(SETTINGS), action="append")
    parser.add_argument("--grasps", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write JSON here; cases already in it are kept")
    options = parser.parse_args()
    result: dict[str, Any] = {}
    if options.out and options.out.exists():
        result = json.loads(options.out.read_text(encoding="utf-8"))
    result |= {"grasps": options.grasps, "seconds": SECONDS}
    for hand in options.hand or sorted(SIZES):
        for simulator in options.simulator or sorted(SETTINGS):
            for size in SIZES[hand]:
                rows = measure(hand, simulator, size, options.grasps)
                title = f"{hand} in {simulator}, {1e3 * size:.0f} mm cube"
                result[title] = rows
                show(f"{title}, {options.grasps} grasps, hold of {SECONDS:.0f} s", rows)
                if options.out:
                    options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
