"""A trained policy under other sensors than it was trained with: one flag, several values."""

from __future__ import annotations

import dataclasses
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..envs.observations import SensorConfig
from ..errors import InputError, input_errors
from .config import RunConfig
from .files import MAKER, is_picture, replacing, require_ours

PICTURES = (".png", ".svg", ".pdf")
USUAL = {**vars(SensorConfig()), "touch": "on"}
NAMES = [name for name, value in USUAL.items() if isinstance(value, str | float | int)]


def vary(run: RunConfig, sweep: tuple[str, ...]) -> tuple[str, list[Any], list[RunConfig]]:
    """(field, its values, `run` with each of them) of a flag's name and texts of its values.

    InputError naming what is not a flag of the sensors or not a value of it.
    """
    name, texts = sweep[0].removeprefix("--").replace("-", "_"), sweep[1:]
    if run.scene is None:
        raise InputError(f"--sweep: found a run on {run.run.env!r}, allowed one of a grasping scene")
    if name not in NAMES:
        allowed = ", ".join(name.replace("_", "-") for name in NAMES)
        raise InputError(f"--sweep: found {sweep[0]!r}, allowed: {allowed}")
    if not texts:
        raise InputError(f"--sweep {sweep[0]}: found no values, expected one or more")
    with input_errors(f"--sweep {sweep[0]}"):
        values = [type(USUAL[name])(text) for text in texts]
    scenes = [dataclasses.replace(run.scene, **{name: value}) for value in values]
    runs = [dataclasses.replace(run, scene=scene) for scene in scenes]
    with input_errors("--sweep"):
        for each in runs:
            each.validate()
    return name, values, runs


def require_drawable(out: Path) -> None:
    """InputError unless a picture can be written there."""
    if out.suffix not in PICTURES:
        raise InputError(
            f"--out: found {str(out)!r}, allowed a name that ends in {', '.join(PICTURES)}"
        )
    if not out.parent.is_dir():
        raise InputError(f"--out: the folder {str(out.parent)!r} does not exist")
    require_ours(out, is_picture)
    if find_spec("matplotlib") is None:
        raise InputError("--out: found no matplotlib; install it: pip install 'tactilerl[plots]'")


def draw(name: str, values: list[Any], rows: list[dict[str, Any]], out: Path) -> None:
    """Write a picture of the success rate, with its intervals, against the values."""
    from matplotlib.figure import Figure  # takes a while

    rates = np.array([row["success_rate"] for row in rows])
    low, high = np.array([row["success_rate_ci"] for row in rows]).T
    figure = Figure(figsize=(5, 3.5), layout="constrained")
    axes = figure.add_subplot()
    axes.errorbar(values, rates, yerr=[rates - low, high - rates], marker="o", capsize=3)
    axes.set(xlabel=name.replace("_", " "), ylabel="success rate", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    made_by = {"Software" if out.suffix == ".png" else "Creator": MAKER}
    with replacing(out, is_picture) as file:
        figure.savefig(file, format=out.suffix[1:], dpi=150, metadata=made_by)
