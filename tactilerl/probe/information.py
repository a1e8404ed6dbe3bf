"""Taxels for scenes where the question is not when to close but whether a grasp will hold: those that
tell most of that beyond the joint angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from . import analysis, estimators, files, metrics, selection
from .candidates import Design, Pool
from .options import AnalysisFlags, GraspFlags
from .readings import Grasps


def design(pool: Pool, workers: int, show: Callable[[int, int], None]) -> Design:
    """Choose taxels by scripted grasps; ValueError where the hand has none, or they have too few of one
    outcome."""
    flags, (scene,), numbers = pool.flags, pool.scenes, list(pool.flags.numbers)
    own: dict[str, Any] = {
        "env": pool.env,
        "simulator": scene.config.simulator,
        "seed": flags.seed,
    }
    playing = replace(GraspFlags.of_scene(scene.name), **own, grasps=pool.n_starts)
    playing.validate()
    played = files.play(None, playing, workers, lambda done: show(done, playing.grasps))
    grasps = Grasps.whole(pool.hand, played.records)
    felt = grasps.feel(pool.skin.taxels)
    readings = {
        name: felt[:, pool.skin.columns(taxels)] for name, taxels in pool.beside.items()
    }
    has, skin = np.split(felt[:, pool.columns], [pool.n_kept], axis=1)
    probe = analysis.Probe(grasps, readings, AnalysisFlags(), flags.seed, workers)
    with estimators.expected_warnings():
        try:
            path, best, told = selection.select(probe, skin, numbers, has, pool.overlap)
        except ValueError as error:  # names what `design` has no flag for
            raise ValueError(
                f"starts: found {pool.n_starts}, allowed more ({error})"
            ) from error
        worth = selection.bits(probe, skin)
    if len(path) < numbers[-1]:
        room = "" if pool.overlap is None else " and have room"
        allowed = f"allowed up to the {len(path)} candidates that tell anything{room}"
        raise ValueError(f"taxels: found {numbers[-1]}, {allowed}")
    rows = [_row(name, readings[name].shape[1], gains) for name, gains in told.items()]
    first = max(rows, key=lambda row: row["gain"], default=None)
    for n, gains in best.items():
        row = _row("chosen", n, gains)
        if first is not None:
            more = metrics.gain(gains - told[first["layout"]])
            row["difference"] = {"gain": [more["gain"], *more["gain_interval"]]}
        rows.append(row)
    chosen = {n: [pool.n_kept + taxel for taxel in path[:n]] for n in numbers}
    about = {
        "question": "information",
        "beside": first and first["layout"],
        "rows": rows,
    }
    worth = np.concatenate([np.zeros(pool.n_kept), worth])
    return pool.design(chosen, worth, about)


def _row(layout: str, n: int, gains: Any) -> dict[str, Any]:
    return {"layout": layout, "taxels": n, **metrics.gain(gains)}
