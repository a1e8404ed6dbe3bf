"""What do the physics settings cost, and what do they get wrong?

Scripted grasps of two cubes with perturbed starts, held for 5 s, under one setting at a time, for
each hand in each simulator, against a reference with small, well-solved steps, which is itself
compared with one of twice its step.
Prints tables and writes JSON:

    python -m benchmarks speed_vs_error --out docs/data/speed_vs_error.json
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

import mujoco
import numpy as np
from tactilerl.envs import hands, scripted
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.style import NAMES

from benchmarks.command import count, markdown, parser, processes, write
from benchmarks.physics.contacts import deepest, self_contact

SECONDS = 5.0
SEED = 35_000  # starts of this benchmark; the check of taxels and the search used others
SIZES = {"shadow": (0.04, 0.05), "mpl": (0.045, 0.05)}  # of cubes, m
SHIPPED = "as shipped"


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
INERTIAS = "1e-5", "1e-4", "1e-3"
LITTLE = 1e-5  # kg m², the reference's of both hands: a tenth of the smallest that is shipped
REFERENCES = {
    "mujoco": [Setting(part, EXACT) for part in (1 / 8, 1 / 16)],
    "pybullet": [Setting(part, MANY, added_inertia=LITTLE) for part in (1 / 4, 1 / 8)],
}
SOLVER, INTEGRATOR, CONE = mujoco.mjtSolver, mujoco.mjtIntegrator, mujoco.mjtCone
SETTINGS: dict[str, dict[str, Setting]] = {
    "mujoco": {
        SHIPPED: Setting(),
        "timestep / 4": Setting(1 / 4),
        "timestep / 2": Setting(1 / 2),
        "timestep x 2": Setting(2),
        **{f"{n} iterations": Setting(options={"iterations": n}) for n in (6, 10, 50)},
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
        "touch sensors": Setting(config={"touch_rule": "contact"}),
        "touch sensors, each substep": Setting(config={"touch_rule": "contact"}, all_sensors=True),
    },
    "pybullet": {
        SHIPPED: Setting(),
        "timestep / 2": Setting(1 / 2),
        "timestep x 2": Setting(2),
        **{f"{n} iterations": Setting(options={"numSolverIterations": n}) for n in (20, 30, 100)},
        **{f"contact ERP {rate}": Setting(options={"contactERP": rate}) for rate in (0.1, 0.4)},
        "friction ERP 0.05": Setting(options={"frictionERP": 0.05}),
        "CFM 1e-5": Setting(options={"globalCFM": 1e-5}),
        "no friction anchors": Setting(constants={"FRICTION_ANCHOR": 0}),
        "no spinning friction": Setting(constants={"SPINNING_FRICTION": 0.0}),
        **{f"added inertia {size}": Setting(added_inertia=float(size)) for size in INERTIAS},
        "hand touches itself": Setting(self_contact=True),
        "contact rule": Setting(config={"touch_rule": "contact"}),
    },
}


class Trace(NamedTuple):
    """What grasps did during their holds, in the palm's frame, one cube after the other."""

    positions: np.ndarray
    """(grasps, steps, 3) of the object, m."""
    bits: np.ndarray
    """(grasps, steps, taxels)"""
    held: np.ndarray
    """bool (grasps,)"""
    overlaps: np.ndarray
    """(grasps,) of the deepest contact of the hand with the object, m."""
    seconds: np.ndarray
    """(grasps,) of processor time of the physics."""
    warnings: np.ndarray
    """(grasps,) of MuJoCo."""


@contextmanager
def environment(hand: str, simulator: str, size: Any, setting: Setting) -> Iterator[GraspEnv]:
    """Make a scene under one setting, and close it afterwards."""
    timestep = setting.timestep * setup(hand).timestep
    choices = {"timestep": timestep, "control_dt": timestep, **setting.config}
    config = setup(hand, simulator=simulator, layout="1", object_size=size, **choices)
    with ExitStack() as stack:
        if simulator == "pybullet":
            _change_bullet(stack, hand, setting)
        env = stack.enter_context(closing(GraspEnv(hand, config)))
        if simulator == "mujoco":
            _change_mujoco(env.simulator, setting)
        yield env


def _change_mujoco(simulator: Any, setting: Setting) -> None:
    for name, value in setting.options.items():
        setattr(simulator.model.opt, name, value)
    simulator.model.geom("object").solref[0] *= setting.contact_time
    if setting.all_sensors:  # the simulator takes care of them only when the scene has some
        simulator.scene = replace(simulator.scene, sensors=())


def _change_bullet(stack: ExitStack, hand: str, setting: Setting) -> None:
    """Change what is loaded until the stack ends."""
    from tactilerl.envs.simulators import pybullet

    if setting.added_inertia is not None:
        usual = hands.get(hand)
        changed = replace(usual, file=replace(usual.file, added_inertia=setting.added_inertia))
        stack.enter_context(patch.object(hands, "get", lambda name: changed))
    stack.enter_context(patch.dict(pybullet.ENGINE, setting.options))
    constants = setting.constants | ({"LOADING": self_contact()} if setting.self_contact else {})
    for name, value in constants.items():
        stack.enter_context(patch.object(pybullet, name, value))


def record(hand: str, simulator: str, setting: Setting, grasps: int) -> Trace:
    """Perform so many grasps of each cube under one setting; a dropped one counts as it falls."""
    rows, dt = [], scripted.period(setup(hand).timestep)
    for size in SIZES[hand]:
        with environment(hand, simulator, size, setting) as env:
            for number in range(grasps):
                start = scripted.perturbed_start(env, SEED, number)
                hold = scripted.hold_steps(env, scripted.grasp_for(env), start, SECONDS, dt)
                before = env.simulator.warnings
                *seen, held, overlaps, seconds = zip(*_watched(env, hold), strict=True)
                of_physics = max(overlaps), sum(seconds), env.simulator.warnings - before
                rows.append((*map(np.array, seen), held[-1], *of_physics))
    return Trace(*map(np.array, zip(*rows, strict=True)))


def _watched(env: GraspEnv, hold: Iterator[bool]) -> Iterator[tuple[Any, ...]]:
    """Yield position, taxels, whether the object is up, overlap and seconds of each step."""
    started = time.process_time()
    for is_up in hold:
        seconds = time.process_time() - started  # looking does not count
        state = env.simulator.state()
        (palm,), (frame,) = state.poses((env.hand.palm,))
        place = frame.T @ (state.object_position - palm)
        yield place, env.taxel_readings(), is_up, deepest(env), seconds
        started = time.process_time()


def compare(trace: Trace, reference: Trace, shipped: Trace) -> dict[str, Any]:
    """Return errors of one setting over the grasps that hold in it and in the reference."""
    row: dict[str, Any] = {
        "speed": float(shipped.seconds.sum() / trace.seconds.sum()),
        "outcomes_changed": int((trace.held != reference.held).sum()),
        "overlap_mm": 1e3 * float(trace.overlaps.max()),
        "warnings": int(trace.warnings.sum()),
    }
    both = trace.held & reference.held
    if not both.any():
        return row
    (at, bits), (right_at, right_bits) = (
        [part[both] for part in one[:2]] for one in (trace, reference)
    )
    errors = 1e3 * np.linalg.norm(at - right_at, axis=-1).max(axis=1)  # mm, the largest of each grasp
    return row | {
        "error_median_mm": float(np.median(errors)),
        "error_worst_mm": float(errors.max()),
        "slip_5s_mm": 1e3 * float(np.median(np.linalg.norm(at[:, -1] - at[:, 0], axis=-1))),
        "bits_wrong": float((bits != right_bits).sum(axis=-1).mean()),
    }


def measure(hand: str, simulator: str, grasps: int) -> dict[str, dict[str, Any]]:
    """Return a row for each setting, the first for the coarser reference."""
    coarse, fine = (record(hand, simulator, s, grasps) for s in REFERENCES[simulator])
    settings = SETTINGS[simulator]
    traces = {name: record(hand, simulator, s, grasps) for name, s in settings.items()}
    shipped = traces[SHIPPED]
    rows = {name: compare(trace, fine, shipped) for name, trace in traces.items()}
    return {"reference, twice the step": compare(coarse, fine, shipped), **rows}


FORMATS = {
    "speed": ".2f",
    "error_median_mm": ".2f",
    "error_worst_mm": ".2f",
    "slip_5s_mm": ".2f",
    "overlap_mm": "z.1f",
    "bits_wrong": ".1f",
    "outcomes_changed": "d",
}
"""The formats of the columns of `show`."""


def show(rows: dict[str, dict[str, Any]]) -> None:
    """Print one table."""
    head = "setting | speed | error, median mm | worst mm | slip, mm | overlap, mm | taxels wrong"
    cells = []
    for name, row in rows.items():
        words = f"**{name}**" if name == SHIPPED else name
        cells.append((words, *(_number(row, key, form) for key, form in FORMATS.items())))
    markdown(f"| {head} | outcomes changed |", cells)


def _number(row: dict[str, Any], key: str, form: str = ".2f") -> str:
    return f"{row[key]:{form}}" if key in row else "–"


def show_shipped(results: dict[str, Any]) -> None:
    """Print what is shipped, beside half its timestep."""
    rows = []
    for title, result in sorted(results.items(), key=lambda item: item[0].split()[::-1]):
        hand, _, simulator = title.split()
        shipped, finer = (result["settings"][name] for name in (SHIPPED, "timestep / 2"))
        keys = ("error_median_mm", "error_worst_mm", "slip_5s_mm", "bits_wrong", "outcomes_changed")
        cells = [_number(shipped, key, FORMATS[key]) for key in keys]
        cells += [_number(finer, key) for key in ("speed", "error_median_mm")]
        timestep = f"{1e3 * setup(hand, simulator=simulator).timestep:.3g} ms"
        rows.append((f"{NAMES[hand]} in {NAMES[simulator]}", timestep, *cells))
    head = (
        "| as shipped | timestep | error, median mm | worst mm | slip in 5 s, mm | taxels wrong "
        "| outcomes changed | speed at half the timestep | error at half the timestep, median mm |"
    )
    markdown(head, rows)


def main() -> None:
    """Measure every hand in every simulator; write after each."""
    flags = parser(__doc__)
    flags.add_argument("--grasps", type=count, default=5, help="of each cube")
    flags.add_argument("--jobs", type=count, default=1, help="hands and simulators side by side")
    options = flags.parse_args()
    result: dict[str, Any] = {}
    pairs = [(hand, simulator) for simulator in ("pybullet", "mujoco") for hand in SIZES]
    with processes(options.jobs) as pool:
        tables = pool.map(partial(measure, grasps=options.grasps), *zip(*pairs, strict=True))
        for (hand, simulator), rows in zip(pairs, tables, strict=True):
            title = f"{hand} in {simulator}"
            result[title] = {"grasps of each cube": options.grasps, "settings": rows}
            print(title)
            show(rows)
            write(options.out, result)
