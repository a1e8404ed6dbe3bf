"""A trained policy under other sensors than it was trained with: one flag, several values."""

from __future__ import annotations

from typing import Any

from ..envs.observations import SensorConfig
from ..errors import InputError, input_errors
from .config import RunConfig

USUAL = {**vars(SensorConfig()), "touch": "on"}
NAMES = [name for name, value in USUAL.items() if isinstance(value, str | float | int)]


def vary(
    run: RunConfig, sweep: tuple[str, ...]
) -> tuple[str, list[Any], list[RunConfig]]:
    """(field, its values, `run` with each of them) of a flag's name and texts of its values.

    InputError naming what is not a flag of the sensors or not a value of it.
    """
    name, texts = sweep[0].removeprefix("--").replace("-", "_"), sweep[1:]
    if run.scene is None:
        raise InputError(
            f"--sweep: found a run on {run.run.env!r}, allowed one of a grasping scene"
        )
    if name not in NAMES:
        allowed = ", ".join(name.replace("_", "-") for name in NAMES)
        raise InputError(f"--sweep: found {sweep[0]!r}, allowed: {allowed}")
    if not texts:
        raise InputError(f"--sweep {sweep[0]}: found no values, expected one or more")
    with input_errors(f"--sweep {sweep[0]}"):
        values = [type(USUAL[name])(text) for text in texts]
    runs = [run.choose({name: value}) for value in values]
    with input_errors("--sweep"):
        for each in runs:
            each.validate()
    return name, values, runs
