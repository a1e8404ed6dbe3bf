"""What does a scene need? Parts taken out or put back, one at a time, in each simulator.

Five perturbed scripted grasps each, held for 2 s: microseconds of a physics step while holding,
taxels read after each control step; time and memory to load a scene; what changes in the grasp
against the shipped scene. Prints tables and writes JSON:

    python -m benchmarks scene_parts --out docs/data/scene_parts.json
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import psutil
from tactilerl.envs import scripted
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.simulators import Scene

from benchmarks.command import markdown, parser, write
from benchmarks.physics.contacts import self_contact
from benchmarks.physics.speed_vs_error import SHIPPED

SECONDS, GRASPS, SEED = 2.0, 5, 60_000
STEPS = 20  # of control, timed after each grasp
COPIES = 8  # of a scene, loaded at once to weigh one


def without(kind: str, spec: mujoco.MjSpec) -> None:
    """No contact of the hand with itself ("pairs"), or no couplings ("tendons")."""
    for each in list(getattr(spec, kind)):
        spec.delete(each)


def without_palm(spec: mujoco.MjSpec) -> None:
    """Palm boxes touch nothing."""
    boxes = [g for g in spec.geoms if g.parent.name in ("palm", "robot0:palm")]
    for geom in boxes:
        geom.contype = geom.conaffinity = 0
    names = {geom.name for geom in boxes}
    for pair in list(spec.pairs):
        if names & {pair.geomname1, pair.geomname2}:
            spec.delete(pair)


@dataclass(frozen=True)
class Variant:
    """What is different from the shipped scene."""

    edit: Callable[[mujoco.MjSpec], None] = lambda spec: None
    """Of the hand's model."""
    keeps: tuple[str, ...] = ()
    """What is kept of the names that are left out of the Shadow Hand's files as shipped."""
    visual: bool = False
    self_contact: bool = False
    """In Bullet."""
    config: dict[str, Any] = field(default_factory=dict)
    """Fields of GraspConfig."""


WITH_SENSORS = Variant(config={"touch_rule": "contact"})
IN_BULLET = {
    SHIPPED: Variant(),
    "with 139 taxels by the contact rule": WITH_SENSORS,
    "with hand-hand pairs": Variant(self_contact=True),
    "without palm boxes": Variant(without_palm),
}
VARIANTS: dict[tuple[str, str], dict[str, Variant]] = {
    ("shadow", "mujoco"): {
        SHIPPED: Variant(),
        "with visual meshes": Variant(visual=True),
        "with the model's other tendons": Variant(keeps=("robot0:T_*[!c]", "robot0:T_THJ4c")),
        "with the forearm's collision mesh": Variant(keeps=("robot0:C_forearm",)),
        "with the thumb's 1 mm boxes": Variant(keeps=("robot0:V_thbase", "robot0:V_thhub")),
        "with 139 touch sensors": WITH_SENSORS,
        "without hand-hand pairs": Variant(partial(without, "pairs")),
        "without palm boxes": Variant(without_palm),
        "without coupling tendons": Variant(partial(without, "tendons")),
    },
    ("mpl", "mujoco"): {
        SHIPPED: Variant(),
        "with 139 touch sensors": WITH_SENSORS,
        "without palm boxes": Variant(without_palm),
    },
    ("shadow", "pybullet"): IN_BULLET,
    ("mpl", "pybullet"): IN_BULLET,
}


@contextmanager
def changed(variant: Variant) -> Iterator[None]:
    """Scenes made meanwhile are of this variant."""
    build_hand = Scene.build_hand

    def edited(scene: Scene, visual: bool) -> mujoco.MjSpec:
        mount = scene.hand.build
        drop = tuple(name for name in mount.drop if name not in variant.keeps)
        hand = replace(scene.hand, build=replace(mount, drop=drop))
        spec = build_hand(replace(scene, hand=hand), visual)
        variant.edit(spec)
        return spec

    with ExitStack() as stack:
        stack.enter_context(patch.object(Scene, "build_hand", edited))
        if variant.self_contact:
            loading = "tactilerl.envs.simulators.pybullet.LOADING"
            stack.enter_context(patch(loading, self_contact()))
        yield


def measure(hand: str, simulator: str, variant: Variant) -> dict[str, Any]:
    """One variant."""
    config = setup(hand, simulator=simulator, layout="1", **variant.config)
    mode = "rgb_array" if variant.visual else None
    with changed(variant):
        row = load(lambda: GraspEnv(hand, config, render_mode=mode))
        with closing(GraspEnv(hand, config, render_mode=mode)) as env:
            return row | perform(env)


def load(make: Callable[[], GraspEnv]) -> dict[str, float]:
    """Milliseconds and resident megabytes of one environment, ready to step; of the median and of
    the mean of COPIES."""
    make().close()  # files are read once
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc only
        trim(0)  # so that what is loaded next shows in the process's size
    before, seconds, made = psutil.Process().memory_info().rss, [], []
    for _ in range(COPIES):
        started = time.process_time()
        made.append(make())
        made[-1].reset(seed=0)
        seconds.append(time.process_time() - started)
    taken = psutil.Process().memory_info().rss - before
    for env in made:
        env.close()
    return {"load_ms": 1e3 * float(np.median(seconds)), "rss_mb": taken / COPIES / 1e6}


def perform(env: GraspEnv) -> dict[str, Any]:
    """The grasps; where the object ends in the palm's frame, and how long a step takes there."""
    ends, held, seconds = [], [], []
    grasp = scripted.grasp_for(env)
    *_, targets = scripted.ramps(env, grasp, scripted.period(env.config.timestep))
    for start in scripted.perturbed_starts(env, SEED, GRASPS):
        up = list(scripted.hold_steps(env, grasp, start, SECONDS))
        state = env.simulator.state()
        (palm,), (frame,) = state.poses((env.hand.palm,))
        ends.append(frame.T @ (state.object_position - palm))
        held.append(up[-1])
        started = time.process_time()
        for _ in range(STEPS):
            env.simulator.step(targets, env.config.n_substeps)
            env.taxel_readings()
        seconds.append((time.process_time() - started) / STEPS / env.config.n_substeps)
    return {"us_per_step": 1e6 * float(np.median(seconds)), "held": int(sum(held)), "ends": ends}


FORMATS = {"us_per_step": ".0f", "load_ms": ".0f", "rss_mb": ".2f", "held": "d", "moved_mm": ".2f"}


def show(pairs: dict[str, dict[str, dict[str, Any]]]) -> None:
    """One table."""
    rows = [
        (f"{title}: {name}", *(f"{row[key]:{form}}" for key, form in FORMATS.items()))
        for title, variants in pairs.items()
        for name, row in variants.items()
    ]
    head = f"| variant | µs per step, holding | load, ms | memory, MB | held of {GRASPS} | moved, mm |"
    markdown(head, rows)


def main() -> None:
    """Both hands in both simulators."""
    options = parser(__doc__).parse_args()
    pairs = {}
    for (hand, simulator), variants in VARIANTS.items():
        rows = {name: measure(hand, simulator, variant) for name, variant in variants.items()}
        ends = {name: np.array(row.pop("ends")) for name, row in rows.items()}
        for name, row in rows.items():
            row["moved_mm"] = 1e3 * float(np.linalg.norm(ends[name] - ends[SHIPPED], axis=1).max())
        pairs[f"{hand} in {simulator}"] = rows
    show(pairs)
    write(options.out, {"grasps": GRASPS, "seconds": SECONDS, "pairs": pairs})
