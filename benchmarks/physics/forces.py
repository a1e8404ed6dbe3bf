"""How near is the force that a taxel reads to MuJoCo's sensor on that taxel alone?

Some taxels of 8 mm are put on the hand one at a time, as cylinders that stand 0.5 mm proud of the skin
with one of MuJoCo's touch sensors. The same starts are played without them, read by rule "force":

    python -m benchmarks forces --out docs/data/forces.json
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any
from unittest import mock

import mujoco
import numpy as np
from tactilerl.envs import layouts, scenes, touch
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.layouts import Taxels
from tactilerl.envs.simulators import mujoco as simulator
from tactilerl.placement import candidates

from benchmarks.command import markdown, measure_missing, parser, progress

HANDS, SCENES = ("mpl", "shadow", "allegro"), ("handover", "handover_anywhere")
STARTS, TAXELS = 10, 12
RADIUS, PROUD, HEIGHT = 4e-3, 5e-4, 4e-3  # m
THRESHOLDS = 0.1, 0.2
PRESSED = range(3, 10)  # actions after the giver has set off


def environment(hand: str, scene: str, layout: str, rule: str) -> GraspEnv:
    """Return a scene with this layout and touch rule."""
    choices = {**scenes.load(scene).on(hand), "layout": layout, "touch_rule": rule}
    return GraspEnv(hand, setup(hand, **choices))


def largest(env: GraspEnv, seed: int, read: Callable[[], Any]) -> Any:
    """Return the largest readings while the giver presses and the hand waits."""
    env.reset(seed=seed)
    readings, is_over = [], False
    while not is_over:
        *_, terminated, truncated, _ = env.step_to(env.hand.start_targets())
        is_over = terminated or truncated
        if env.task._step + 1 - env.task.sets_off in PRESSED:
            readings.append(read())
    return np.max(readings, axis=0)


def proud(normal: Any) -> Callable[..., None]:
    """Return what puts a sensor and its cylinder on a link, where a scene has a sensor."""

    def add(spec: mujoco.MjSpec, name: str, sensor: Any) -> None:
        body, quaternion = spec.body(sensor.link), np.zeros(4)
        mujoco.mju_quatZ2Vec(quaternion, normal)
        geom = body.geoms[0]
        body.add_geom(
            name=f"{name} geom", type=mujoco.mjtGeom.mjGEOM_CYLINDER, mass=0, quat=quaternion,
            size=[sensor.radius, HEIGHT / 2, 0], pos=sensor.centre + (PROUD - HEIGHT / 2) * normal,
            contype=geom.contype, conaffinity=geom.conaffinity,
        )  # fmt: skip
        body.add_site(name=name, size=[sensor.radius + PROUD] * 3, pos=sensor.centre)
        site, kind = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor.mjSENS_TOUCH
        spec.add_sensor(name=name, type=kind, objtype=site, objname=name)

    return add


def compare(hand: str, scene: str) -> dict[str, Any]:
    """Return readings by the rule and by MuJoCo's sensors, N (starts, taxels)."""
    env = environment(hand, scene, "1", "skin")
    skin = candidates.skin("6mm", env.hand)
    skin = replace(skin, points=tuple(point._replace(radius=RADIUS) for point in skin.points))
    rule = touch.ForceRule(skin, env.hand)
    ruled = np.array(
        [largest(env, seed, lambda: rule.read(env.simulator.state())) for seed in range(STARTS)]
    )
    felt = np.flatnonzero((ruled > 0).sum(axis=0) >= 2)
    chosen = np.sort(np.random.default_rng(0).permutation(felt)[:TAXELS]).tolist()
    columns = [alone(hand, scene, skin.take([index])) for index in progress(chosen, f"{hand}, {scene}")]
    return {"rule": ruled[:, chosen].tolist(), "mujoco": np.transpose(columns).tolist()}


def alone(hand: str, scene: str, taxel: Taxels) -> list[float]:
    """Return what MuJoCo's sensor on a single taxel reads in each start, N."""
    layout = layouts.Layout("", "", (), taxel.points).toml()
    with mock.patch.object(simulator, "_add_touch_sensor", proud(taxel.normals[0])):
        env = environment(hand, scene, layout, "contact")
        sensor = env.simulator.data
        return [float(largest(env, seed, sensor.sensordata.copy)[0]) for seed in range(STARTS)]


def show(known: dict[str, dict[str, Any]]) -> None:
    """Print the errors, and how often both are above a force, where either of the two reads any."""
    rows = []
    for key, row in known.items():
        rule, sensor = np.array(row["rule"]), np.array(row["mujoco"])
        felt = (rule > 0) | (sensor > 0)
        rule, sensor = rule[felt], sensor[felt]
        error = rule - sensor
        alike = [f"{((rule >= t) == (sensor >= t)).mean():.2f}" for t in THRESHOLDS]
        figures = sensor.mean(), np.abs(error).mean(), error.mean()
        rows.append((key, len(error), *(f"{figure:.2f}" for figure in figures), *alike))
    above = " | ".join(f"same side of {threshold:g} N" for threshold in THRESHOLDS)
    head = "readings | MuJoCo's sensor, mean, N | mean absolute error, N | mean error, N"
    markdown(f"| | {head} | {above} |", rows)


def main() -> None:
    """Play what is missing, then print the table."""
    pairs = itertools.product(HANDS, SCENES)
    measures = {f"{hand}, {scene}": partial(compare, hand, scene) for hand, scene in pairs}
    show(measure_missing(parser(__doc__).parse_args().out, measures))
