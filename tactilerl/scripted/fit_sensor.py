"""Fit the file of a sensor to logs in which it is pressed and released: `tactilerl env --fit-sensor`.

A sensor fires when its reading is further from that at rest than its noise goes. If it fires from the
force T up and its readings are late by d, then the force at that moment is T + d · v, where v is how
fast the force rises; likewise when it stops. Slow and fast presses together tell T from d.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from ..envs import validation
from ..envs.state import Array

COLUMNS = "time,force_N,reading"
FORCES = -1.0, 100.0  # N, of a load cell whose zero is about right
LONGEST_STEP = 0.05  # s, between two lines
PRESSED = 0.05, 0.1  # N and share of the largest force: from both on it is a press
REST = 0.5  # s without touch that a log has before its first press at least, and as long again
SIGMAS = 5.0  # of the noise at rest: further away, a reading tells of a press
WINDOW = 0.05  # s before an event, in which the force is taken for a line
MIN_PRESSES = 3
MIN_SPECIMENS = 5  # from which an interval of their spread says anything
RESAMPLES, PERCENT = 999, (2.5, 97.5)
MIN_RATIO = 2.0  # of the speeds of the fastest and the slowest press


class _Log(NamedTuple):
    """Hold what a log says of one sensor."""

    presses: Array
    """(n, 4): force, N, and its rate, N/s, at the moment when it fires, and when it stops."""
    rest: Array
    """Readings at rest."""
    fired: Array
    """(2, m): time and reading wherever it fires."""
    force: Array
    """(2, l): time and force."""


def fit(paths: Sequence[Path]) -> str:
    """Return the text of a sensor's file, with 95 % intervals, from a log for each of its specimens.

    Raise ValueError naming what is wrong with a log, and FileNotFoundError.
    """
    if len({path.resolve() for path in paths}) < len(paths):
        raise ValueError(
            "fit_sensor: found a file twice, allowed one for each specimen"
        )
    logs = [_read(path) for path in paths]
    presses = [log.presses for log in logs]
    found, bounds = _estimate(presses), _bounds(presses)
    delay = found[2]
    lines = [
        _line("threshold_N", found[0], *bounds[0]),
        _line("release_N", found[1], *bounds[1]),
        _line("delay_ms", 1e3 * delay, *1e3 * bounds[2]),
    ]
    if len(logs) >= MIN_SPECIMENS:
        lines.append(_line("threshold_spread", found[3], *bounds[3]))
    elif len(logs) > 1:
        lines.append(f"threshold_spread = {found[3]:.3g}")
    noise = [
        (log.rest - log.rest.mean()) / _gain(log, delay)
        for log in logs
        if len(np.unique(log.fired[1])) > 2
    ]
    if noise:
        every = np.concatenate(noise)
        lines.append(_line("noise_N", every.std(), *_noise_bounds(every)))
    about = f"Fitted to {sum(map(len, presses))} presses"
    names = ", ".join(path.name for path in paths)
    head = [
        f"about = {validation.quoted(about)}",
        f"source = {validation.quoted(names)}",
    ]
    return "\n".join([*head, "", "[sensor]", *lines, ""])


def _line(key: str, value: float, low: float, high: float) -> str:
    return f"{key} = {value:.3g}  # 95 %: {low:.3g} to {high:.3g}"


def _bounds(presses: Sequence[Array]) -> Array:
    """Return 95 % intervals (4, 2) by bootstrap over the specimens, then the presses of each."""
    rng, n = np.random.default_rng(0), len(presses)
    resampled = (
        [rng.choice(presses[one], len(presses[one])) for one in rng.choice(n, n)]
        for _ in range(RESAMPLES)
    )
    with np.errstate(invalid="ignore"):  # all presses of a sample may be the same one
        found = [_estimate(sample) for sample in resampled]
    return np.asarray(np.nanpercentile(found, PERCENT, axis=0).T)


def _noise_bounds(readings: Array) -> Array:
    """Return a 95 % interval of the standard deviation of readings by bootstrap."""
    rng = np.random.default_rng(0)
    found = [rng.choice(readings, len(readings)).std() for _ in range(RESAMPLES)]
    return np.percentile(found, PERCENT)


def _estimate(presses: Sequence[Array]) -> Array:
    """Return threshold and release, N, delay, s, and the relative spread of the threshold.

    They are the means of specimens, each of which has presses (n, 4).
    """
    means = np.array([each.mean(axis=0) for each in presses])
    around = np.concatenate([each - each.mean(axis=0) for each in presses])
    forces, rates = around[:, 0::2], around[:, 1::2]
    delay = np.maximum((forces * rates).sum() / (rates**2).sum(), 0.0)
    levels = (means[:, 0::2] - delay * means[:, 1::2]).clip(0.0)
    threshold, release = levels.mean(axis=0)
    spread = np.std(levels[:, 0], ddof=min(1, len(presses) - 1)) / threshold
    return np.array([threshold, min(release, threshold), delay, spread])


def _gain(log: _Log, delay: float) -> float:
    """Return by how much the reading changes with the force, per N."""
    times, readings = log.fired
    return abs(float(np.polyfit(np.interp(times - delay, *log.force), readings, 1)[0]))


def _read(path: Path) -> _Log:
    """Return what a log says; ValueError naming what is wrong with it, and FileNotFoundError."""
    with validation.blamed(f"log {path}"):
        text = validation.read_text(path, "log")
        header = text.partition("\n")[0].replace(" ", "").strip()
        if header != COLUMNS:
            raise ValueError(
                f"columns: found {header[:50]!r}, allowed {COLUMNS} (s, N, any unit)"
            )
        rows = []
        for number, line in enumerate(text.rstrip().splitlines()[1:], 2):
            try:
                time, force, reading = map(float, line.split(","))
            except ValueError:
                raise ValueError(
                    f"line {number}: found {line[:50]!r}, allowed three numbers"
                ) from None
            rows.append((time, force, reading))
        if len(rows) < 3:
            raise ValueError(f"lines: found {len(rows)}, allowed some seconds of them")
        _require_units(np.array(rows))
        return _pressed(*np.array(rows).T)


def _require_units(rows: Array) -> None:
    """Raise ValueError for what is no number, or not in s and N."""
    if not np.isfinite(rows).all():
        raise ValueError("found NaN or an infinity, allowed numbers")
    steps, force = np.diff(rows[:, 0]), rows[:, 1]
    if not (steps.min() > 0 and np.median(steps) <= LONGEST_STEP):
        found = f"found steps of {steps.min():g} s and more, {np.median(steps):g} s in the middle"
        raise ValueError(f"time: {found}, allowed above 0 and up to {LONGEST_STEP} s")
    if force.min() < FORCES[0] or force.max() > FORCES[1]:
        found = f"found {force.min():g} to {force.max():g} N"
        raise ValueError(f"force_N: {found}, allowed {FORCES[0]:g} to {FORCES[1]:g} N")


def _pressed(time: Array, force: Array, reading: Array) -> _Log:
    """Return where a sensor fires and stops; ValueError where a log does not tell."""
    step = float(np.median(np.diff(time)))
    smooth = uniform_filter1d(force, max(1, round(WINDOW / step)))
    first = smooth[: round(REST / step)]
    if abs(first.mean()) > PRESSED[0] > np.ptp(first):
        raise ValueError(f"the force at rest is {first.mean():.3g} N: tare it")
    pressed = smooth > max(PRESSED[0], PRESSED[1] * smooth.max())
    edges = np.flatnonzero(np.diff(pressed.astype(int), prepend=0, append=0))
    begins, ends = edges[0::2], edges[1::2]
    asked = "allowed a log as the guide to sensors describes"
    if not len(begins):
        raise ValueError(f"found no press of {PRESSED[0]} N, {asked}")
    rest = reading[time < time[begins[0]] - REST]
    if len(rest) * step < REST:
        raise ValueError(
            f"found less than {2 * REST:g} s of rest before the first press, {asked}"
        )
    sign = np.sign(np.mean((force - force.mean()) * (reading - reading.mean())))
    fires = sign * (reading - rest.mean()) > SIGMAS * rest.std()
    if not fires.any():
        raise ValueError(f"the reading never leaves its rest, {asked}")
    cuts = [0, *((ends[:-1] + begins[1:]) // 2), len(time) - 1]
    presses = []
    for begin, end in pairwise(cuts):
        firing = begin + np.flatnonzero(fires[begin:end])
        if len(firing) and not (fires[begin] or fires[end]):
            events = firing[0], firing[-1] + 1
            presses.append(
                [x for event in events for x in _line_before(time, force, event)]
            )
    if len(presses) < MIN_PRESSES:
        found = (
            f"found {len(presses)} presses after which the reading is again as at rest"
        )
        raise ValueError(f"{found}, allowed from {MIN_PRESSES}")
    rates = np.abs(np.array(presses)[:, 1])
    if rates.max() < MIN_RATIO * rates.min():
        raise ValueError(
            f"found presses of {rates.min():.3g} to {rates.max():.3g} N/s, allowed slow and fast ones"
        )
    return _Log(
        np.array(presses),
        rest,
        np.array([time, reading])[:, fires],
        np.array([time, force]),
    )


def _line_before(time: Array, force: Array, event: int) -> tuple[float, float]:
    """Return the force, N, just before a line of a log, and its rate, N/s."""
    moment = (time[event - 1] + time[event]) / 2
    near = (time > moment - WINDOW) & (time < moment)
    near[event - 2 : event] = True
    rate, at_event = np.polyfit(time[near] - moment, force[near], 1)
    return float(at_event), float(rate)
