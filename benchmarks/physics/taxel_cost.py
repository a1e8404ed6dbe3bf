"""What do many taxels cost? Their share of a control step, and the probe's minutes.

Step: the time of reading 139, 500 and 1,000 taxels in a held scripted grasp, against that of the
control step's physics, on hands of capsules and of boxes and meshes. Probe: what one layout with as
many taxels takes to be asked of the same grasps, on one core. Prints tables and writes JSON:

    python -m benchmarks taxel_cost --out docs/data/taxel_cost.json
"""

from __future__ import annotations

import itertools
import statistics
import tempfile
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from tactilerl.envs import hands, layouts, scripted
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.pictures import places
from tactilerl.probe import files, run
from tactilerl.probe.options import AnalysisFlags, GraspFlags, Options

from benchmarks.command import ROOT, run_parts
from benchmarks.printing import markdown

GRIPPER = str(ROOT / "tests" / "hands" / "gripper.toml")
HANDS = {"shadow (capsules)": "shadow", "gripper (boxes and meshes)": GRIPPER}
NUMBERS = (139, 500, 1_000)
GRASPS = 500
STEPS = 30


def layout_of(hand: hands.Hand, n: int, folder: Path) -> str:
    """A layout file with `n` taxels, evenly taken from a dense skin."""
    skin = places.dense_skin(hand, 7e-4 if len(hand.digits) < 5 else 1e-3).place(hand)
    chosen = np.linspace(0, len(skin) - 1, n).round().astype(int).tolist()
    path = folder / f"{n}.toml"
    path.write_text(layouts.of_taxels(skin.take(chosen), hand, f"{n} taxels").toml(), encoding="utf-8")
    return str(path)


def steps() -> dict[str, Any]:
    """Milliseconds of a control step's physics, and of reading the taxels after it."""
    result: dict[str, Any] = {name: {} for name in HANDS}
    with tempfile.TemporaryDirectory() as folder:
        for (name, hand), n in itertools.product(HANDS.items(), NUMBERS):
            layout = layout_of(hands.get(hand), n, Path(folder))
            with closing(GraspEnv(hand, setup(hand, layout=layout))) as env:
                result[name][str(n)] = measure(env)
    return result


def measure(env: GraspEnv) -> dict[str, float]:
    """Medians over control steps of a held grasp."""
    grasp = scripted.grasp_for(env)
    start = scripted.Offsets()
    *_, targets = scripted.ramps(env, grasp, scripted.period(env.config.timestep))
    on = sum(1 for _ in scripted.hold_steps(env, grasp, start, 0.2))
    assert on
    physics, touch = [], []
    for _ in range(STEPS):
        began = time.process_time()
        env.simulator.step(targets, env.config.n_substeps)
        between = time.process_time()
        felt = env.taxel_readings()
        touch.append(time.process_time() - between)
        physics.append(between - began)
    return {
        "physics_ms": 1e3 * statistics.median(physics),
        "touch_ms": 1e3 * statistics.median(touch),
        "on": int(felt.sum()),
    }


def probe() -> dict[str, Any]:
    """Seconds of one core to play grasps, and to ask one layout of them at one joint noise."""
    flags = GraspFlags(env=GRIPPER, start_offset=0.005, grasps=GRASPS)
    result: dict[str, Any] = {"grasps": GRASPS}
    with tempfile.TemporaryDirectory() as folder, patch.object(run, "free_cores", lambda: 1):
        out, began = Path(folder), time.process_time()
        played = files.play(out / "grasps.npz", flags, 1, lambda n: None)
        result["play_s"] = time.process_time() - began
        for n in NUMBERS:
            layout = layout_of(hands.get(GRIPPER), n, out)
            asked = AnalysisFlags(layout=(layout,), joint_noise=(0.05,))
            began = time.process_time()
            run.analyse(replace(Options(), analysis=asked), played, out)
            result[str(n)] = time.process_time() - began
    return result


def show_steps(result: dict[str, Any]) -> None:
    """Share of touch in a control step."""
    rows = []
    for hand, by_number in result.items():
        for n, row in by_number.items():
            physics, touch = row["physics_ms"], row["touch_ms"]
            share = f"{100 * touch / (touch + physics):.1f} %"
            rows.append((hand, n, row["on"], f"{physics:.2f}", f"{touch:.3f}", share))
    markdown("| hand | taxels | on | physics, ms | touch, ms | share |", rows)


def show_probe(result: dict[str, Any]) -> None:
    """Minutes of one core."""
    seconds = {"playing them": result["play_s"]} | {str(n): result[str(n)] for n in NUMBERS}
    rows = [(name, f"{value / 60:.1f}") for name, value in seconds.items()]
    markdown(f"| {result['grasps']} grasps, one core, one layout: taxels | minutes |", rows)


def main() -> None:
    """Both parts."""
    run_parts(__doc__, {"steps": (steps, show_steps), "probe": (probe, show_probe)}, "mujoco")
