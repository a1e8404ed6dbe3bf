"""A trained policy under other sensors than it was trained with: one flag, several values."""

from __future__ import annotations

import dataclasses
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..envs.observations import SensorConfig
from ..errors import InputError, input_errors
from .config import RunConfig

PICTURES = (".png", ".svg", ".pdf")
# The flags with one value each.
NAMES = [
    field.name
    for field in dataclasses.fields(SensorConfig)
    if isinstance(field.default, str | float | int)
]


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
        raise InputError(f"--sweep {sweep[0]}: found no values, expected some")
    kind = type(getattr(SensorConfig, name))
    try:
        values = [kind(text) for text in texts]
    except ValueError as error:
        raise InputError(f"--sweep {sweep[0]}: {error}") from None
    runs = [
        dataclasses.replace(run, scene=dataclasses.replace(run.scene, **{name: value}))
        for value in values
    ]
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
    if find_spec("matplotlib") is None:
        raise InputError("--out: found no matplotlib; install it: pip install 'tactilerl[plots]'")


def draw(name: str, values: list[Any], rows: list[dict[str, Any]], out: Path) -> None:
    """Write a picture of the success rate, with its intervals, against the values."""
    from matplotlib.figure import Figure  # takes a while

    rates = [row["success_rate"] for row in rows]
    intervals = [row["success_rate_ci"] for row in rows]
    below = [rate - low for rate, (low, _) in zip(rates, intervals, strict=True)]
    above = [high - rate for rate, (_, high) in zip(rates, intervals, strict=True)]
    figure = Figure(figsize=(5, 3.5), layout="constrained")
    axes = figure.add_subplot()
    axes.errorbar(values, rates, yerr=[below, above], marker="o", capsize=3)
    axes.set(xlabel=name.replace("_", " "), ylabel="success rate", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    figure.savefig(out, dpi=150)
