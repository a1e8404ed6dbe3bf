"""Taxels for scenes where the question is not when to close but whether a grasp will hold: those that
tell most of that beyond the joint angles."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..envs import hands, vector
from . import analysis, estimators, metrics, selection
from .candidates import Design, DesignFlags, Pool, Scene
from .grasps import Scenes, play, stack
from .options import AnalysisFlags, GraspFlags
from .readings import Grasps


def design(
    flags: DesignFlags, env: str, scene: Scene, workers: int, show: Callable[[int, int], None]
) -> Design:
    """Choose taxels by scripted grasps; ValueError where the hand has none, or they have too few of one
    outcome."""
    hand, numbers = hands.get(env), list(flags.numbers)
    pool = Pool.of(flags, hand)
    usual = GraspFlags.of_scene(scene.name)
    own: dict[str, Any] = {"env": env, "simulator": scene.config.simulator, "seed": flags.seed}
    playing = replace(usual, **own, grasps=flags.n_starts(is_timing=False))
    playing.validate()
    records = []
    with closing(vector.start(partial(Scenes, playing), workers)) as played_in:
        for record in played_in.play(play, range(playing.grasps)):
            records.append(record)
            show(len(records), playing.grasps)
    grasps = Grasps(hand, stack([record for record in records if not record["broken"]]))
    felt = grasps.feel(pool.skin.taxels)
    readings = {name: felt[:, pool.skin.columns(taxels)] for name, taxels in pool.beside.items()}
    has, skin = np.split(felt[:, pool.columns], [pool.n_kept], axis=1)
    probe = analysis.Probe(grasps, readings, AnalysisFlags(), flags.seed, workers)
    with estimators.expected_warnings():
        path, best, told = selection.select(probe, skin, numbers, has)
        worth = selection.bits(probe, skin)
    rows = [_row(name, readings[name].shape[1], gains) for name, gains in told.items()]
    first = max(rows, key=lambda row: row["gain"], default=None)
    for n, gains in best.items():
        row = _row("chosen", n, gains)
        if first is not None:
            more = metrics.gain(gains - told[first["layout"]])
            row["difference"] = {"gain": [more["gain"], *more["gain_interval"]]}
        rows.append(row)
    chosen = {n: [pool.n_kept + taxel for taxel in path[:n]] for n in numbers}
    about = {"question": "information", "beside": first and first["layout"], "rows": rows}
    worth = np.concatenate([np.zeros(pool.n_kept), worth])
    return pool.design(env, chosen, worth, [scene], about)


def _row(layout: str, n: int, gains: Any) -> dict[str, Any]:
    return {"layout": layout, "taxels": n, **metrics.gain(gains)}
