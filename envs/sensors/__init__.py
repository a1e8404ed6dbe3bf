"""Sensors as data: a file says what a taxel can do, what is unknown of it, and what it costs.

`load` reads a sensor of the library, or a file of one's own; `choose` puts its numbers
into the fields `taxel_...` of a configuration, which say what each means
(`observations.SensorConfig`).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from .. import validation
from ..validation import Fraction, Newtons

FOLDER = Path(__file__).parent
SUFFIX = ".toml"
Money = Annotated[float, "[0, 1e9)"]
OF_FIRING = "taxel_threshold", "taxel_release", "taxel_threshold_spread"
OF_FORCE = "taxel_saturates", "taxel_noise", "taxel_gain_spread", "taxel_drift"
OF_BITS = "taxel_false_on", "taxel_stuck"
DECIDING = "touch", "touch_rule", "control_dt"  # what `SensorFile.fields` reads
UNIT = re.compile("_(mm|ms|N|N_per_min)$")
T = TypeVar("T")


@dataclass(frozen=True)
class Cost:
    """Price of sensors, in whatever currency; a board reads up to `channels` of them (None: any)."""

    each: Money
    board: Money = 0.0
    channels: Annotated[int, "[1, 100000]"] | None = None


@dataclass(frozen=True)
class _Numbers:
    """Table [sensor] of a file; what is not in it is unknown.

    docs/guides/sensors.md says what each is.
    """

    radius_mm: Annotated[float, "[0.1, 20]"] | None = None
    threshold_N: Newtons | None = None
    release_N: Newtons | None = None
    threshold_spread: Fraction | None = None
    delay_ms: Annotated[float, "[0, 100000]"] | None = None
    dead: Fraction | None = None
    false_on: Fraction | None = None
    false_off: Fraction | None = None
    saturates_N: Annotated[float, "(0, 1000]"] | None = None
    noise_N: Newtons | None = None
    gain_spread: Fraction | None = None
    drift_N_per_min: Newtons | None = None


@dataclass(frozen=True)
class _File:
    """Content of a file."""

    sensor: _Numbers
    about: str = ""
    source: str = ""
    cost: Cost | None = None


@dataclass(frozen=True)
class SensorFile:
    """Hold what is known of a sensor."""

    name: str
    about: str
    source: str
    numbers: dict[str, float]
    """What is known, in SI units (the drift in N/min), by the fields `taxel_...` that
    it is for."""
    cost: Cost | None

    def fields(self, config: Any) -> dict[str, Any]:
        """Return fields of `config`, a `grasp.GraspConfig`, with which its taxels are this sensor.

        What is unknown, or does nothing with its touch rule, is as usual.
        """
        known: dict[str, Any] = dict(self.numbers)
        if "taxel_delay" in known:  # control steps
            known["taxel_delay"] = round(known["taxel_delay"] / config.control_dt)
        idle = config.idle()
        return _usual(config) | {k: x for k, x in known.items() if k not in idle}


def names() -> tuple[str, ...]:
    """Return the names of the library's sensors."""
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}")))


def load(name: str | Path) -> SensorFile:
    """Return a sensor by name, or from a .toml file.

    Raise ValueError naming what is wrong, and FileNotFoundError.
    """
    path = Path(name)
    if path.suffix != SUFFIX:
        if str(name) not in names():
            raise ValueError(
                f"sensor: found {str(name)!r}, {validation.nearest(str(name), names())}"
                f"allowed: {', '.join(names())}, FILE{SUFFIX}"
            )
        path = FOLDER / f"{name}{SUFFIX}"
    data = validation.read(path, "sensor file")
    with validation.blamed(f"sensor file {path}"):
        file = validation.fill(_File, data)
        numbers = file.sensor
        release, highest = numbers.release_N or 0.0, numbers.threshold_N or 0.0
        if release > highest:
            raise ValueError(
                f"sensor.release_N: found {release}, allowed up to threshold_N, {highest}"
            )
    known = {}
    for key, value in asdict(numbers).items():
        if value is not None:
            scale = 1e-3 if key.endswith(("_mm", "_ms")) else 1.0
            known[UNIT.sub("", f"taxel_{key}")] = scale * value
    return SensorFile(path.stem, file.about, file.source, known, file.cost)


def choose(config: T, choices: Mapping[str, Any]) -> T:
    """Return a copy of a `grasp.GraspConfig` with some fields chosen otherwise.

    A sensor brings its numbers, which the other choices overrule; without touch, or
    with the sensor "", there are none. Where a choice changes what the numbers of the
    sensor of `config` are, they follow, but for those that had been chosen otherwise.
    Raise ValueError naming what is wrong with the sensor, and FileNotFoundError.
    """
    changed: Any = validation.replace(config, choices)
    numbers: dict[str, Any] = {}
    other = any(getattr(changed, name) != getattr(config, name) for name in DECIDING)
    if "sensor" in choices or (changed.sensor and other):
        validation.require(type(changed), vars(changed))
        numbers = _numbers(changed)
        if "sensor" not in choices and changed.touch == "on":
            before = _numbers(config)
            kept = {k for k, x in before.items() if getattr(config, k) != x}
            numbers = {k: x for k, x in numbers.items() if k not in kept}
    return validation.replace(config, {**numbers, **choices})


def _numbers(config: Any) -> dict[str, Any]:
    """Return what all fields of taxels are with the sensor of a configuration."""
    if config.sensor and config.touch == "on":
        return load(config.sensor).fields(config)
    return _usual(config)


def _usual(config: Any) -> dict[str, Any]:
    """Return the defaults of all fields of taxels."""
    fields = dataclasses.fields(config)
    return {f.name: f.default for f in fields if f.name.startswith("taxel_")}
