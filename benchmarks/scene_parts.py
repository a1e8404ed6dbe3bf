"""What does a scene need? Parts taken out or put back, one at a time, in MuJoCo.

Five perturbed scripted grasps each, held for 2 s: microseconds of `mj_step` while holding, time to
compile, size of the model, and what changes in the grasp against the shipped scene. Prints tables
and writes JSON:

    python benchmarks/scene_parts.py --out docs/data/scene_parts.json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from tactilerl.envs import scripted
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.hands import shadow
from tactilerl.envs.simulators import mujoco as simulator

SECONDS, GRASPS, SEED = 2.0, 5, 60_000
SHIPPED = "as shipped"
Edit = Callable[[mujoco.MjSpec], None]


def nothing(spec: mujoco.MjSpec) -> None:
    """The shipped scene."""


def without_pairs(spec: mujoco.MjSpec) -> None:
    """No contact of the hand with itself."""
    for pair in list(spec.pairs):
        spec.delete(pair)


def without_palm(spec: mujoco.MjSpec) -> None:
    """Palm boxes touch nothing."""
    for geom in spec.geoms:
        if geom.parent.name in ("palm", f"{shadow.PREFIX}palm"):
            geom.contype = geom.conaffinity = 0


def without_couplings(spec: mujoco.MjSpec) -> None:
    """No tendons."""
    for tendon in list(spec.tendons):
        spec.delete(tendon)


drop_as_shipped = shadow._drop_what_the_scene_does_not_need


def drop_but_tendons(spec: mujoco.MjSpec, visual: bool) -> None:
    """Keeps all tendons."""
    with patch.object(shadow, "NEEDED_TENDONS", ""):
        drop_as_shipped(spec, visual)


def drop_but(*names: str) -> Callable[[mujoco.MjSpec, bool], None]:
    """Keeps geoms that are dropped as shipped."""

    def drop(spec: mujoco.MjSpec, visual: bool) -> None:
        kept = [name for name in shadow.UNNEEDED_GEOMS if name not in names]
        with patch.object(shadow, "UNNEEDED_GEOMS", kept):
            drop_as_shipped(spec, visual or any(name.startswith("V_") for name in names))

    return drop


Variant = tuple[dict[str, Any], Edit, Callable[[mujoco.MjSpec, bool], None], bool]
"""(fields of GraspConfig, edit of the scene, what is dropped of the model, with visual meshes?)"""
BASE: Variant = ({}, nothing, drop_as_shipped, False)
VARIANTS: dict[str, dict[str, Variant]] = {
    "shadow": {
        SHIPPED: BASE,
        "with visual meshes": ({}, nothing, drop_as_shipped, True),
        "with the model's other tendons": ({}, nothing, drop_but_tendons, False),
        "with the forearm's collision mesh": ({}, nothing, drop_but("C_forearm"), False),
        "with the thumb's 1 mm boxes": ({}, nothing, drop_but("V_thbase", "V_thhub"), False),
        "with 139 touch sensors": ({"touch": "contact"}, nothing, drop_as_shipped, False),
        "without hand-hand pairs": ({}, without_pairs, drop_as_shipped, False),
        "without palm boxes": ({}, without_palm, drop_as_shipped, False),
        "without coupling tendons": ({}, without_couplings, drop_as_shipped, False),
    },
    "mpl": {
        SHIPPED: BASE,
        "with 139 touch sensors": ({"touch": "contact"}, nothing, drop_as_shipped, False),
        "without palm boxes": ({}, without_palm, drop_as_shipped, False),
    },
}


def measure(hand: str, variant: Variant) -> dict[str, Any]:
    """One variant."""
    choices, edit, drop, visual = variant
    build_spec = simulator.build_spec

    def edited(scene: Any) -> mujoco.MjSpec:
        spec = build_spec(scene)
        edit(spec)
        return spec

    config = setup(hand, simulator="mujoco", layout="1", **choices)
    with (
        patch.object(simulator, "build_spec", edited),
        patch.object(shadow, "_drop_what_the_scene_does_not_need", drop),
    ):
        env = GraspEnv(hand, config, render_mode="rgb_array" if visual else None)
        spec = edited(env.simulator.scene)
        started = time.perf_counter()
        spec.compile()
        compiling = time.perf_counter() - started
    with closing(env):
        return perform(env) | {"compile_ms": 1e3 * compiling, "model_mb": model_size(env) / 1e6}


def model_size(env: GraspEnv) -> int:
    """Bytes of the compiled model."""
    return int(mujoco.mj_sizeModel(env.simulator.model))


def perform(env: GraspEnv) -> dict[str, Any]:
    """The grasps; where the object ends in the palm's frame, and how long a step takes there."""
    ends, held, seconds = [], [], []
    model, data = env.simulator.model, env.simulator.data
    for start in scripted.perturbed_starts(env, SEED, GRASPS):
        up = list(scripted.hold_steps(env, scripted.grasp_for(env), start, SECONDS))
        (palm,), (frame,) = env.simulator.link_poses((env.hand.palm,))
        ends.append(frame.T @ (env.simulator.object_state().position - palm))
        held.append(up[-1])
        started = time.perf_counter()
        mujoco.mj_step(model, data, 500)
        seconds.append((time.perf_counter() - started) / 500)
    return {"us_per_step": 1e6 * float(np.median(seconds)), "held": int(sum(held)), "ends": ends}


def main() -> None:
    """Both hands."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="write JSON here")
    options = parser.parse_args()
    result: dict[str, Any] = {"grasps": GRASPS, "seconds": SECONDS}
    for hand, variants in VARIANTS.items():
        rows = {name: measure(hand, variant) for name, variant in variants.items()}
        ends = {name: np.array(row.pop("ends")) for name, row in rows.items()}
        for name, row in rows.items():
            row["moved_mm"] = 1e3 * float(np.linalg.norm(ends[name] - ends[SHIPPED], axis=1).max())
        result[hand] = rows
        table = Table("variant", title=f"{hand} in mujoco")
        for column in ("µs/step", "compile, ms", "model, MB", f"held of {GRASPS}", "object moved, mm"):
            table.add_column(column, justify="right")
        for name, row in rows.items():
            table.add_row(
                *(name, f"{row['us_per_step']:.0f}", f"{row['compile_ms']:.1f}"),
                *(f"{row['model_mb']:.2f}", str(row["held"]), f"{row['moved_mm']:.2f}"),
            )
        Console(width=130).print(table)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
