"""Sensors as data: a file says what a taxel can do, what is unknown of it, and what it costs.

`load` reads a sensor of the library, or a file of one's own; `choose` puts its numbers into the fields
`taxel_...` of a configuration, which say what each means (`observations.SensorConfig`).
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
T = TypeVar("T")


@dataclass(frozen=True)
class Cost:
    """Price of sensors, in whatever currency; a board reads up to `channels` of them (None: any)."""

    each: Money
    board: Money = 0.0
    channels: Annotated[int, "[1, 100000]"] | None = None


@dataclass(frozen=True)
class _Numbers:
    """Table [sensor] of a file; what is not in it is unknown."""

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
    """Hold what is known of a sensor, in SI units; None: unknown."""

    name: str
    about: str
    source: str
    radius: float | None
    """Radius of what feels, m."""
    threshold: float | None
    """Force from which it fires, N."""
    release: float | None
    """Force below which it stops, N."""
    threshold_spread: float | None
    """Standard deviation of the threshold from sensor to sensor, relative."""
    delay: float | None
    """Time until a reading arrives, s."""
    dead: float | None
    """Share of sensors that never fire."""
    false_on: float | None
    """Probability per control step that an untouched sensor reads on."""
    false_off: float | None
    """Probability per control step that a touched sensor reads off."""
    saturates: float | None
    """Largest force that it can tell, N."""
    noise: float | None
    """Standard deviation of the noise of a reading, N."""
    gain_spread: float | None
    """Standard deviation of the gain from sensor to sensor, relative."""
    drift: float | None
    """Drift of the zero, N/min."""
    cost: Cost | None

    def fields(self, config: Any) -> dict[str, Any]:
        """Return fields of `config`, a `grasp.GraspConfig`, with which its taxels are this sensor.

        What is unknown, or does nothing with its touch rule, is as usual.
        """
        usual = _usual(config)
        known = {
            f"taxel_{name}": value
            for name, value in vars(self).items()
            if f"taxel_{name}" in usual.keys() - config.idle() and value is not None
        }
        if self.delay is not None:  # control steps
            known["taxel_delay"] = round(self.delay / config.control_dt)
        return usual | known


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
        if "sensor" not in data:
            raise ValueError("table [sensor] is missing")
        file = validation.fill(_File, data)
        numbers = file.sensor
        release, highest = numbers.release_N or 0.0, numbers.threshold_N or 0.0
        if release > highest:
            raise ValueError(
                f"sensor.release_N: found {release}, allowed up to threshold_N, {highest}"
            )
    values: dict[str, Any] = {}
    for key, value in asdict(numbers).items():
        field, _, unit = re.fullmatch("(.+?)(_(mm|ms|N|N_per_min))?", key).groups()  # type: ignore[union-attr]
        is_milli = unit in ("mm", "ms") and value is not None
        values[field] = 1e-3 * value if is_milli else value
    return SensorFile(path.stem, file.about, file.source, **values, cost=file.cost)


def choose(config: T, choices: Mapping[str, Any]) -> T:
    """Return a copy of a `grasp.GraspConfig` with some fields chosen otherwise.

    A sensor brings its numbers, which the other choices overrule; without touch, or with the sensor "",
    there are none. Raise ValueError naming what is wrong with the sensor, and FileNotFoundError.
    """
    changed: Any = validation.replace(config, choices)
    numbers: dict[str, Any] = {}
    if choices.get("sensor") == "" or (changed.sensor and changed.touch != "on"):
        numbers = _usual(config)
    elif "sensor" in choices:
        validation.require(type(changed), vars(changed))
        numbers = load(changed.sensor).fields(changed)
    return validation.replace(config, {**numbers, **choices})


def _usual(config: Any) -> dict[str, Any]:
    """Return the defaults of all fields of taxels."""
    fields = dataclasses.fields(config)
    return {f.name: f.default for f in fields if f.name.startswith("taxel_")}
