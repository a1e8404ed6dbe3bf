"""What do the physics settings cost, and what do they get wrong?

Scripted grasps of two cubes with perturbed starts, held for 5 s, under one setting at a time, for
each hand in each simulator, against a reference with small, well-solved steps, which is itself
compared with one of twice its step. Also what is lost where nothing should be (free_motion.py).
Prints tables and writes JSON:

    python -m benchmarks speed_vs_error --out docs/data/speed_vs_error.json
    python -m benchmarks speed_vs_error --hand mpl --simulator pybullet --grasps 3
"""

from __future__ import annotations

import importlib
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from benchmarks.command import count, earlier, parser, write
from benchmarks.physics.free_motion import BRICK, BULLET, fall, swing
from tactilerl.envs import hands, scripted
from tactilerl.envs.grasp import GraspEnv, setup

SECONDS = 5.0
SEED = 35_000  # starts of this benchmark; the doctor and the search used others
SIZES = {"shadow": (0.04, 0.05), "mpl": (0.045, 0.05)}  # of cubes, m
SHIPPED = "as shipped"
CLEARLY = 1.25


@dataclass(frozen=True)
class Setting:
    """What is different from the shipped scene."""

    timestep: float = 1.0
    """In units of the shipped one."""
    options: dict[str, Any] = field(default_factory=dict)
    """Fields of MuJoCo's options, or parameters of Bullet's engine."""
    constants: dict[str, Any] = field(default_factory=dict)
    """Of our PyBullet module."""
    added_inertia: float | None = None
    """kg m², instead of the hand's own."""
    self_contact: bool = False
    """Does the hand touch itself in Bullet?"""
    contact_time: float = 1.0
    """MuJoCo's time constant of the object's contacts, in units of the shipped one."""
    config: dict[str, Any] = field(default_factory=dict)
    """Fields of GraspConfig."""
    all_sensors: bool = False
    """MuJoCo's touch sensors in each substep, not only in the last of a control step."""


EXACT = {"iterations": 200, "tolerance": 1e-12}
MANY = {"numSolverIterations": 100}
LITTLE = 1e-5  # kg m², the reference's of both hands: a tenth of the smallest that is shipped
REFERENCES = {
    "mujoco": (Setting(1 / 8, EXACT), Setting(1 / 16, EXACT)),
    "pybullet": (
        Setting(1 / 4, MANY, added_inertia=LITTLE),
        Setting(1 / 8, MANY, added_inertia=LITTLE),
    ),
}
SOLVER, INTEGRATOR, CONE = mujoco.mjtSolver, mujoco.mjtIntegrator, mujoco.mjtCone
SETTINGS: dict[str, dict[str, Setting]] = {
    "mujoco": {
        SHIPPED: Setting(),
        "timestep / 4": Setting(1 / 4),
        "timestep / 2": Setting(1 / 2),
        "timestep x 2": Setting(2),
        "6 iterations": Setting(options={"iterations": 6}),
        "10 iterations": Setting(options={"iterations": 10}),
        "50 iterations": Setting(options={"iterations": 50}),
        "tolerance 1e-5": Setting(options={"tolerance": 1e-5}),
        "solver CG": Setting(options={"solver": SOLVER.mjSOL_CG}),
        "solver PGS": Setting(options={"solver": SOLVER.mjSOL_PGS}),
        "implicitfast": Setting(options={"integrator": INTEGRATOR.mjINT_IMPLICITFAST}),
        "RK4": Setting(options={"integrator": INTEGRATOR.mjINT_RK4}),
        "dense Jacobian": Setting(options={"jacobian": mujoco.mjtJacobian.mjJAC_DENSE}),
        "impratio 10": Setting(options={"impratio": 10.0}),
        "pyramidal, impratio 1": Setting(options={"cone": CONE.mjCONE_PYRAMIDAL, "impratio": 1.0}),
        "contacts / 2 as slow": Setting(contact_time=1 / 2),
        "contacts x 2 as slow": Setting(contact_time=2),
        "touch sensors": Setting(config={"touch": "contact"}),
        "touch sensors, each substep": Setting(config={"touch": "contact"}, all_sensors=True),
    },
    "pybullet": {
        SHIPPED: Setting(),
        "timestep / 2": Setting(1 / 2),
        "timestep x 2": Setting(2),
        "20 iterations": Setting(options={"numSolverIterations": 20}),
        "30 iterations": Setting(options={"numSolverIterations": 30}),
        "100 iterations": Setting(options={"numSolverIterations": 100}),
        "contact ERP 0.1": Setting(options={"contactERP": 0.1}),
        "contact ERP 0.4": Setting(options={"contactERP": 0.4}),
        "friction ERP 0.05": Setting(options={"frictionERP": 0.05}),
        "CFM 1e-5": Setting(options={"globalCFM": 1e-5}),
        "no friction anchors": Setting(constants={"FRICTION_ANCHOR": 0}),
        "no spinning friction": Setting(constants={"SPINNING_FRICTION": 0.0}),
        "added inertia 1e-5": Setting(added_inertia=1e-5),
        "added inertia 1e-4": Setting(added_inertia=1e-4),
        "added inertia 1e-3": Setting(added_inertia=1e-3),
        "hand touches itself": Setting(self_contact=True),
        "contact rule": Setting(config={"touch": "contact"}),
    },
}


@dataclass(frozen=True)
class Trace:
    """What several grasps of one cube did during their holds, in the palm's frame."""

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
    """Processor time of the physics."""


@contextmanager
def environment(hand: str, simulator: str, size: Any, setting: Setting) -> Iterator[GraspEnv]:
    """A scene under one setting."""
    timestep = setting.timestep * setup(hand).timestep
    choices = {"timestep": timestep, "control_dt": timestep, **setting.config}
    config = setup(hand, simulator=simulator, layout="1", object_size=size, **choices)
    change = _change_bullet if simulator == "pybullet" else _change_mujoco
    with ExitStack() as stack:
        yield change(stack, hand, config, setting)


def _change_mujoco(stack: ExitStack, hand: str, config: Any, setting: Setting) -> GraspEnv:
    env = stack.enter_context(closing(GraspEnv(hand, config)))
    simulator: Any = env.simulator
    for name, value in setting.options.items():
        setattr(simulator.model.opt, name, value)
    simulator.model.geom("object").solref[0] *= setting.contact_time
    if setting.all_sensors:  # the simulator takes care of them only when the scene has some
        simulator.scene = replace(simulator.scene, contact_taxels=None)
    return env


def _change_bullet(stack: ExitStack, hand: str, config: Any, setting: Setting) -> GraspEnv:
    module, shipped = importlib.import_module(BULLET), hands.get(hand)
    if setting.added_inertia is not None:
        changed = replace(shipped, added_inertia=setting.added_inertia)
        stack.enter_context(patch.object(hands, "get", lambda name: changed))
    stack.enter_context(patch.dict(module.ENGINE, setting.options))
    constants = setting.constants | ({"LOADING": self_contact()} if setting.self_contact else {})
    for name, value in constants.items():
        stack.enter_context(patch.object(module, name, value))
    return stack.enter_context(closing(GraspEnv(hand, config)))


def self_contact() -> int:
    """Flags under which Bullet loads a hand whose links touch each other, but not their parents."""
    module = importlib.import_module(BULLET)
    bullet = module.pybullet
    return int(
        module.LOADING
        | bullet.URDF_USE_SELF_COLLISION
        | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
    )


Traces = dict[float, Trace]
"""By the size of the cube, m."""


def record(hand: str, simulator: str, setting: Setting, grasps: int) -> Traces:
    """Perform so many grasps of each cube under one setting; a dropped one counts as it falls."""
    traces = {}
    for size in SIZES[hand]:
        with environment(hand, simulator, size, setting) as env:
            traces[size] = perform(env, grasps, scripted.period(setup(hand).timestep))
    return traces


def perform(env: GraspEnv, grasps: int, dt: float) -> Trace:
    """The grasps in one environment, with targets every `dt` s."""
    n = round(SECONDS / dt)
    positions, rotations = np.empty((grasps, n, 3)), np.empty((grasps, n, 3, 3))
    bits, held = np.empty((grasps, n, len(env.taxels)), bool), np.empty(grasps, bool)
    overlap = seconds = 0.0
    for index, start in enumerate(scripted.perturbed_starts(env, SEED, grasps)):
        hold = scripted.hold_steps(env, scripted.grasp_for(env), start, SECONDS, dt)
        for step in range(n):
            started = time.process_time()
            is_up = next(hold)
            seconds += time.process_time() - started  # looking does not count
            thing = env.simulator.object_state()
            (palm,), (frame,) = env.simulator.link_poses((env.hand.palm,))
            positions[index, step] = frame.T @ (thing.position - palm)
            rotations[index, step] = frame.T @ thing.rotation
            bits[index, step] = env.taxel_readings()
            overlap = max(overlap, deepest(env))
            held[index] = is_up
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


def compare(traces: Traces, references: Traces, shipped: Traces) -> dict[str, Any]:
    """Errors of one setting over the grasps of all cubes that hold in it and in the reference."""
    grasps = {size: _errors(trace, references[size]) for size, trace in traces.items()}
    row: dict[str, Any] = {
        "speed": _total("seconds", shipped) / _total("seconds", traces),
        "outcomes_changed": sum(
            int((trace.held != references[size].held).sum()) for size, trace in traces.items()
        ),
        "overlap_mm": 1e3 * max(trace.overlap for trace in traces.values()),
        "warnings": _total("warnings", traces),
    }
    of_all = {key: np.concatenate([g[key] for g in grasps.values()]) for key in ERRORS}
    if not of_all["mm"].size:
        return row
    return row | {
        "error_median_mm": float(np.median(of_all["mm"])),
        "error_worst_mm": float(of_all["mm"].max()),
        "angle_median_rad": float(np.median(of_all["rad"])),
        "slip_5s_mm": float(np.median(of_all["slip"])),
        "bits_wrong": float(of_all["bits"].mean()),
        "error_median_mm_of_cube": {
            f"{1e3 * size:g} mm": float(np.median(g["mm"]))
            for size, g in grasps.items()
            if g["mm"].size
        },
    }


ERRORS = ("mm", "rad", "slip", "bits")


def _errors(trace: Trace, reference: Trace) -> dict[str, np.ndarray]:
    """Of each grasp that holds in both: largest distance and angle, drift, mean of wrong bits."""
    both = trace.held & reference.held
    offset = trace.positions[both] - reference.positions[both]
    turned = np.swapaxes(trace.rotations[both], -1, -2) @ reference.rotations[both]
    angle = [Rotation.from_matrix(grasp).magnitude().max() for grasp in turned]
    drift = np.linalg.norm(trace.positions[both, -1] - trace.positions[both, 0], axis=-1)
    wrong = (trace.bits[both] != reference.bits[both]).sum(axis=-1).mean(axis=-1)
    largest = np.linalg.norm(offset, axis=-1).max(axis=1)
    return dict(zip(ERRORS, (1e3 * largest, np.array(angle), 1e3 * drift, wrong), strict=True))


def _total(name: str, traces: Traces) -> float:
    return sum(getattr(trace, name) for trace in traces.values())


def free_motion(hand: str, simulator: str, setting: Setting) -> dict[str, float]:
    """What the setting loses where nothing should be lost."""
    lost: dict[str, float] = {}
    for move in (fall, swing):
        with environment(hand, simulator, BRICK, setting) as env:
            lost |= move(env)
    return lost


def mark_front(rows: dict[str, dict[str, Any]]) -> None:
    """Which settings that hold something does no other beat: clearly faster, with less error and
    no more outcomes changed? Less than CLEARLY is within the noise of the machine, and where the
    error is the same to the last digit, so is the work."""
    for row in rows.values():
        row["on_front"] = "error_median_mm" in row and not any(
            other["speed"] > CLEARLY * row["speed"]
            and other.get("error_median_mm", np.inf) < row.get("error_median_mm", np.inf)
            and other["outcomes_changed"] <= row["outcomes_changed"]
            for other in rows.values()
        )


def measure(hand: str, simulator: str, grasps: int) -> dict[str, dict[str, Any]]:
    """A row for each setting, the first for the coarser reference."""
    coarse, fine = (record(hand, simulator, s, grasps) for s in REFERENCES[simulator])
    settings = SETTINGS[simulator]
    traces = {name: record(hand, simulator, s, grasps) for name, s in settings.items()}
    shipped = traces[SHIPPED]
    rows = {name: compare(trace, fine, shipped) for name, trace in traces.items()}
    mark_front(rows)
    for name, setting in settings.items():
        rows[name] |= free_motion(hand, simulator, setting)
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
    "swing_energy_error": "swing",
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
    flags = parser(__doc__)
    flags.add_argument("--hand", choices=sorted(SIZES), action="append")
    flags.add_argument("--simulator", choices=sorted(SETTINGS), action="append")
    flags.add_argument("--grasps", type=count, default=5, help="of each cube")
    flags.add_argument("--jobs", type=count, default=1, help="hands and simulators side by side")
    options = flags.parse_args()
    result = earlier(options.out)
    pairs = [
        (hand, simulator)
        for simulator in options.simulator or sorted(SETTINGS, reverse=True)  # the slower first
        for hand in options.hand or sorted(SIZES)
    ]
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        found = pool.map(partial(measure, grasps=options.grasps), *zip(*pairs, strict=True))
        for (hand, simulator), rows in zip(pairs, found, strict=True):
            title = f"{hand} in {simulator}"
            result[title] = {"grasps of each cube": options.grasps, "settings": rows}
            cubes = " and ".join(f"{1e3 * size:g}" for size in SIZES[hand])
            show(f"{title}, cubes of {cubes} mm, {options.grasps} grasps each, {SECONDS:.0f} s", rows)
            write(options.out, result)
