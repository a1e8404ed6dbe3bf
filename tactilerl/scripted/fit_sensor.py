"""Fit the file of a sensor to logs in which it is pressed and released: `tactilerl env --fit-sensor`.

A sensor fires when its reading is further from that at rest than its noise goes. If it
fires from the force T up and its readings are late by d, then the force at that moment
is T + d · v, where v is how fast the force rises; likewise when it stops. Slow and fast
presses together tell T from d.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from ..envs import validation
from ..envs.state import Array

COLUMNS = "time,force_N,reading"
LONGEST_STEP = 0.05  # s, between two lines
LARGEST_FORCE = 100.0  # N; more is probably in another unit
PRESSED = 0.05, 0.1  # N and share of the largest force: from both on it is a press
REST = 0.5  # s without touch that a log has before its first press at least, and as long again
SIGMAS = 5.0  # of the noise at rest: further away, a reading tells of a press
WINDOW = 0.05  # s before an event, in which the force is taken for a line
MIN_PRESSES = 3
MIN_SPECIMENS = 5  # from which their spread is told
RESAMPLES, PERCENT = 999, (2.5, 97.5)
RECENT, STILL = 1.0, 0.1  # s, and a share of the fastest speed in that time
MIN_RATIO = 2.0  # of the speeds of the fastest and the slowest press
ASKED = "allowed a log as the guide to sensors describes"


def fit(paths: Sequence[Path]) -> str:
    """Return the text of a sensor's file, with 95 % intervals, from a log for each of its specimens.

    Raise ValueError naming what is wrong with a log, and FileNotFoundError.
    """
    presses, noises = zip(*map(_read, paths), strict=True)
    found, bounds = _estimate(presses), _bounds(presses)
    keys = ["threshold_N", "release_N", "delay_ms"]
    if len(paths) >= MIN_SPECIMENS:
        keys.append("threshold_spread")
    about = f"Fitted to {sum(map(len, presses))} presses"
    lines = [
        f"about = {validation.quoted(about)}",
        f"source = {validation.quoted(', '.join(path.name for path in paths))}",
        "\n[sensor]",
    ]
    for key, value, (low, high) in zip(keys, found, bounds, strict=False):
        lines.append(f"{key} = {value:.3g}  # 95 %: {low:.3g} to {high:.3g}")
    if (noise := float(np.mean(noises))) > 0:
        lines.append(f"noise_N = {noise:.3g}")
    return "\n".join([*lines, ""])


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


def _estimate(presses: Sequence[Array]) -> Array:
    """Return threshold and release, N, delay, ms, and the relative spread of the threshold.

    They are the means of specimens, each of which has presses (n, 4).
    """
    means = np.array([each.mean(axis=0) for each in presses])
    around = np.concatenate([each - each.mean(axis=0) for each in presses])
    forces, rates = around[:, 0::2], around[:, 1::2]
    delay = np.maximum((forces * rates).sum() / (rates**2).sum(), 0.0)
    levels = (means[:, 0::2] - delay * means[:, 1::2]).clip(0.0)
    threshold, release = levels.mean(axis=0)
    spread = np.std(levels[:, 0], ddof=min(1, len(presses) - 1)) / threshold
    return np.array([threshold, min(release, threshold), 1e3 * delay, spread])


def _read(path: Path) -> tuple[Array, float]:
    """Return a log's presses and noise (`_pressed`); ValueError naming what is wrong with it."""
    with (
        validation.blamed(f"log {path}"),
        path.open(encoding="utf-8-sig") as file,
    ):
        header = file.readline().replace(" ", "").strip()
        if header != COLUMNS:
            raise ValueError(
                f"columns: found {header[:50]!r}, allowed {COLUMNS} (s, N, any unit)"
            )
        lines = file.readlines()
        if len(lines) < 3:
            raise ValueError(f"lines: found {len(lines)}, allowed some seconds of them")
        rows = np.loadtxt(lines, delimiter=",", ndmin=2)
        if not np.isfinite(rows).all():
            raise ValueError("found NaN or an infinity, allowed numbers")
        time, force, reading = rows.T
        steps = np.diff(time)
        if not (steps.min() > 0 and np.median(steps) <= LONGEST_STEP):
            found = f"found steps of {steps.min():g} s and more, {np.median(steps):g} s in the middle"
            raise ValueError(
                f"time: {found}, allowed above 0 and up to {LONGEST_STEP} s"
            )
        if np.abs(force).max() > LARGEST_FORCE:
            found = f"found {force.min():g} to {force.max():g} N"
            raise ValueError(f"force_N: {found}, allowed up to {LARGEST_FORCE:g} N")
        return _pressed(time, force, reading)


def _pressed(time: Array, force: Array, reading: Array) -> tuple[Array, float]:
    """Return presses (n, 4): force, N, and its rate, N/s, when the sensor fires and when it stops.

    The second value is the noise of its reading at rest, N; 0 where it is one bit.
    Raise ValueError where a log does not tell.
    """
    step = float(np.median(np.diff(time)))
    smooth = uniform_filter1d(force, max(1, round(WINDOW / step)))
    first = smooth[: round(REST / step)]
    if abs(first.mean()) > PRESSED[0] > np.ptp(first):
        raise ValueError(f"the force at rest is {first.mean():.3g} N: tare it")
    pressed = smooth > max(PRESSED[0], PRESSED[1] * smooth.max())
    edges = np.flatnonzero(np.diff(pressed.astype(int), prepend=0, append=0))
    begins, ends = edges[0::2], edges[1::2]
    if not len(begins):
        raise ValueError(f"found no press of {PRESSED[0]} N, {ASKED}")
    rest = reading[time < time[begins[0]] - REST]
    if len(rest) * step < REST:
        raise ValueError(
            f"found less than {2 * REST:g} s of rest before the first press, {ASKED}"
        )
    sign = np.sign(np.mean((force - force.mean()) * (reading - reading.mean())))
    fires = sign * (reading - rest.mean()) > SIGMAS * rest.std()
    if not fires.any():
        raise ValueError(f"the reading never leaves its rest, {ASKED}")
    cuts = [0, *((ends[:-1] + begins[1:]) // 2), len(time) - 1]
    presses, speed = [], np.gradient(smooth, time)
    for begin, end in pairwise(cuts):
        firing = begin + np.flatnonzero(fires[begin:end])
        if len(firing) and not (fires[begin] or fires[end]):
            fired, stopped = firing[0], firing[-1] + 1
            _require_moving(time, speed, fired)
            _require_moving(time, -speed, stopped)
            line = (
                *_line_before(time, force, fired),
                *_line_before(time, force, stopped),
            )
            presses.append(line)
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
    if len(np.unique(reading[fires])) <= 2:
        return np.array(presses), 0.0
    gain, _ = np.polyfit(force[fires], reading[fires], 1)
    return np.array(presses), float(rest.std() / abs(gain))


def _require_moving(time: Array, speed: Array, event: int) -> None:
    """Raise ValueError where the force had stopped before the reading followed.

    `speed` (n,), N/s, is above 0 where it moves the way that changes the reading. The
    delay is estimated from the speed at the change, so the force must still move then.
    """
    recent = speed[(time > time[event] - RECENT) & (time < time[event])]
    if recent[-1] < STILL * recent.max():
        raise ValueError(
            f"at {time[event]:.2f} s the reading changes after the force has come to rest, allowed "
            "presses and releases slow enough to go on until it does"
        )


def _line_before(time: Array, force: Array, event: int) -> tuple[float, float]:
    """Return the force, N, just before a line of a log, and its rate, N/s."""
    moment = (time[event - 1] + time[event]) / 2
    near = (time > moment - WINDOW) & (time < moment)
    near[event - 2 : event] = True
    rate, at_event = np.polyfit(time[near] - moment, force[near], 1)
    return float(at_event), float(rate)
