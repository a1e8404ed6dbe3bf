"""What do the physics settings cost, and what do they get wrong?

Scripted grasps with perturbed starts, held for 5 s, under one setting at a time, against a
reference of 0.5 ms steps solved to 1e-12, which is itself compared with one of 0.25 ms.
Prints a table and writes JSON:

    python benchmarks/speed_vs_error.py --out docs/data/speed_vs_error.json
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tactilerl.envs import scripted
from tactilerl.envs.grasp import GraspConfig, GraspEnv

SECONDS = 5.0
SEED = 30_000  # starts of this benchmark; the doctor and the search used others
EXACT = {"iterations": 200, "tolerance": 1e-12}
SETTINGS: dict[str, tuple[float, dict[str, Any]]] = {
    "1 ms": (0.001, {}),
    "2 ms": (0.002, {}),
    "4 ms (shipped)": (0.004, {}),
    "5 ms": (0.005, {}),
    "8 ms": (0.008, {}),
    "4 ms, 10 iterations": (0.004, {"iterations": 10}),
    "4 ms, 6 iterations": (0.004, {"iterations": 6}),
    "4 ms, 50 iterations": (0.004, {"iterations": 50}),
    "4 ms, dense Jacobian": (0.004, {"jacobian": 0}),
    "4 ms, impratio 10": (0.004, {"impratio": 10.0}),
    "4 ms, pyramidal, impratio 1": (0.004, {"cone": 0, "impratio": 1.0}),
}


@dataclass(frozen=True)
class Trace:
    """What several grasps did during their holds."""

    positions: np.ndarray
    """(grasps, steps, 3) of the object relative to the palm, m."""
    bits: np.ndarray
    """(grasps, steps, taxels)"""
    seconds: float
    """Processor time."""


def record(timestep: float, options: dict[str, Any], grasps: int, size: float) -> Trace:
    """Perform the grasps under one setting; a dropped object keeps its last entries."""
    env = GraspEnv("shadow", GraspConfig(layout="1", timestep=timestep, object_size=size))
    for name, value in options.items():
        setattr(env.simulator.model.opt, name, value)
    n = round(SECONDS / scripted.CONTROL_DT)
    positions = np.empty((grasps, n, 3))
    bits = np.empty((grasps, n, len(env.taxels)), bool)
    started = time.process_time()
    for index in range(grasps):
        start = scripted.perturbed_start(np.random.default_rng([SEED, index]), len(env.hand.joints))
        hold = scripted.hold_steps(env, scripted.grasp_for(env), start, SECONDS)
        for step, _ in enumerate(hold):
            position = env.simulator.object_state().position
            positions[index, step] = position - env.simulator.link_positions()[0]
            bits[index, step] = env.taxel_readings()
    return Trace(positions, bits, time.process_time() - started)


def compare(trace: Trace, reference: Trace, shipped_seconds: float) -> dict[str, float]:
    """Errors of one setting; lengths in mm."""
    error = 1e3 * np.linalg.norm(trace.positions - reference.positions, axis=-1).max(axis=1)
    drift = 1e3 * np.linalg.norm(trace.positions[:, -1] - trace.positions[:, 0], axis=-1)
    return {
        "speed": shipped_seconds / trace.seconds,
        "error_median_mm": float(np.median(error)),
        "error_worst_mm": float(error.max()),
        "slip_per_s_mm": float(np.median(drift)) / SECONDS,
        "bits_wrong": float((trace.bits != reference.bits).sum(axis=-1).mean()),
        "dropped": int((error > 100).sum()),
    }


def main() -> None:
    """Measure all settings for each cube."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--grasps", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write JSON here")
    options = parser.parse_args()
    result: dict[str, Any] = {"grasps": options.grasps, "seconds": SECONDS}
    for size in (0.04, 0.05):
        reference = record(5e-4, EXACT, options.grasps, size)
        finer = record(2.5e-4, EXACT, options.grasps, size)
        traces = {
            name: record(timestep, opt, options.grasps, size)
            for name, (timestep, opt) in SETTINGS.items()
        }
        shipped = traces["4 ms (shipped)"].seconds
        rows = {"0.25 ms, 1e-12": compare(finer, reference, shipped)}
        rows |= {name: compare(trace, reference, shipped) for name, trace in traces.items()}
        result[f"cube {size}"] = rows
        show(f"{1e3 * size:.0f} mm cube, {options.grasps} grasps, hold of {SECONDS:.0f} s", rows)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def show(title: str, rows: dict[str, dict[str, float]]) -> None:
    """One table."""
    table = Table("setting", title=title)
    columns = ("speed", "error, mm", "worst, mm", "slip, mm/s", "bits wrong of 139", "dropped")
    for column in columns:
        table.add_column(column, justify="right")
    for name, row in rows.items():
        values = list(row.values())
        table.add_row(name, *(f"{value:.2f}" for value in values[:-1]), str(values[-1]))
    Console().print(table)


if __name__ == "__main__":
    main()
