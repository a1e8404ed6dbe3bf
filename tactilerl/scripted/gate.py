"""Measure what touch can win in a scene: scripted hands of each sense (reflexes), chosen fairly."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

from .. import statistics
from ..envs import sensors, tasks, vector
from ..envs.grasp import GraspConfig, GraspEnv
from . import reflexes

COMPARISON, SEARCH = 0, 1_000_000
"""Numbers of the first starts to compare in and to search in, with seed 0; `design` has
others."""
MIN_GAIN = (
    0.3  # difference of success rates from which touch, or a scene, says anything
)
USABLE = 0.9  # success of the sighted hand from which a scene is worth training in
ENOUGH = 40  # starts; of fewer, an interval is wider than MIN_GAIN
NO_TOUCH: dict[str, Any] = {"touch": "absent", "sensor": ""}
"""Choices with which a scene has no taxels, and no numbers of theirs."""
SENSES = {
    "timed": ("time", "a fixed time has passed"),
    "joints": ("joints", "the joints or the hand have moved"),
    "active": ("active", "something blocks a test squeeze"),
    "sight": ("sight", "the object looks near in the scene"),
    "touch": ("touch", "enough taxels fire"),
    "sighted": ("sight", "the object is seen to be in place"),
}
"""Sense of `reflexes.SENSES` by which each scripted hand goes, and when it goes
over."""
BLIND = "timed", "joints", "active", "sight"
"""Scripted hands that neither feel nor see the object's exact place."""


@dataclasses.dataclass(frozen=True)
class HandResult:
    """The best reflex of a scripted hand and how often it succeeds."""

    name: str
    """One of SENSES."""
    reflex: reflexes.Reflex
    rate: float
    """Share of the starts in which it succeeds."""
    interval: Sequence[float]
    """Wilson's interval of the rate, 95 %."""
    episodes: int
    """Number of starts."""


def useful_senses(scene: GraspConfig) -> list[str]:
    """Return the names of the scripted hands that a scene has a use for."""
    useless = set()
    if scene.object_seen in ("hidden", "exact"):  # exact: as the sighted hand
        useless.add("sight")
    if tasks.TASKS[scene.task].giver is None:
        useless.add("active")
    return [name for name in SENSES if name not in useless]


def numbers(seed: int, n: int, first: int = COMPARISON) -> range:
    """Return the numbers of `n` starts, of those that begin with `first`."""
    first += 2 * SEARCH * seed
    return range(first, first + n)


def examine(
    hand: str,
    scene: GraspConfig,
    searched: range,
    compared: range,
    workers: int,
    tick: Callable[[], None] = lambda: None,
    senses: Sequence[str] = tuple(SENSES),
) -> list[HandResult]:
    """Find the best reflex of each of these senses in a scene, and say how often it succeeds.

    Each sense has as many candidates, and each candidate the same starts `searched`;
    the best of them plays those `compared`. `tick` is called after every one of the
    `n_played` episodes of a sense.
    """
    results = []
    for name in useful_senses(scene):
        if name not in senses:
            continue
        sense, _ = SENSES[name]
        changes: dict[str, Any] = {}
        if sense != "touch":
            changes = {**NO_TOUCH}
        if name == "sighted":
            changes |= {
                "object_seen": "exact",
                "sight_noise": None,
                "sight_noise_kind": "white",
            }
        make = partial(GraspEnv, hand, sensors.choose(scene, changes))
        with closing(vector.start(make, workers)) as played_in:
            env: Any = played_in.env.unwrapped
            candidates = reflexes.candidates(env, sense)
            counts = [
                _n_won(played_in, reflex, searched, tick) for reflex in candidates
            ]
            best = candidates[counts.index(max(counts))]
            n_won = _n_won(played_in, best, compared, tick)
        n = len(compared)
        interval = statistics.wilson_interval(n_won, n)
        results.append(HandResult(name, best, n_won / n, interval, n))
    return results


def _n_won(
    workers: vector.Workers,
    reflex: reflexes.Reflex,
    starts: range,
    tick: Callable[[], None],
) -> int:
    """Return the number of starts that a reflex wins; `tick` is called after every one."""
    n_won = 0
    for is_won in workers.play(reflex.play, starts):
        n_won += is_won
        tick()
    return n_won


def n_played(starts: int, search: int) -> int:
    """Return the number of episodes that are played for a sense."""
    return reflexes.CANDIDATES * search + starts


def without_touch(results: Sequence[HandResult]) -> HandResult:
    """Return the best hand that neither feels nor sees the object's exact place."""
    blind = [result for result in results if result.name in BLIND]
    return max(blind, key=lambda result: result.rate)


def pays(touch: float, blind: float) -> bool:
    """Tell whether a success rate is enough above that of the best hand without touch."""
    return round(touch - blind, 9) >= MIN_GAIN


def few(starts: int) -> list[str]:
    """Return a sentence for a verdict from so few starts that it may be chance."""
    if starts >= ENOUGH:
        return []
    told = f"they cannot tell a difference of {MIN_GAIN}"
    return [f"Few starts were judged ({starts}): {told}; play {ENOUGH} or more."]


def sentences(scene: GraspConfig, results: Sequence[HandResult]) -> list[str]:
    """Say what touch can win, and where it does not, what to try."""
    rates = {one.name: one.rate for one in results}
    blind, touch, sighted = without_touch(results), rates["touch"], rates["sighted"]
    if not pays(sighted, blind.rate):
        return [
            f"This scene cannot tell: the best scripted hand without touch ({blind.name}) succeeds "
            f"in {blind.rate:.2f} of its starts, the sighted one in {sighted:.2f}.",
            *few(blind.episodes),
        ]
    room, is_worth_it = sighted - blind.rate, pays(touch, blind.rate)
    gained = min(max(0.0, touch - blind.rate), room)
    said = [
        f"Touch {'pays' if is_worth_it else 'does not pay'}: it closes {gained:.2f} of the "
        f"{room:.2f} gap between the best scripted hand without touch ({blind.name}, "
        f"{blind.rate:.2f}) and the sighted one ({sighted:.2f}).",
        *few(blind.episodes),
    ]
    if not is_worth_it:
        said.append(_what_to_try(scene))
    if sighted < USABLE:
        said.append(
            "Even with sight the hand often fails: improve the hand or the scene before you train."
        )
    return said


def _what_to_try(scene: GraspConfig) -> str:
    """Return one sentence for a scene in which touch could pay, and with these taxels does not."""
    if tasks.TASKS[scene.task].giver is None:
        return "Try other layouts (--layout)."
    flags = ""
    if scene.taxel_threshold is not None:
        flags += f" --taxel-threshold {scene.taxel_threshold:g}"
    if scene.sensor:
        flags += f" --sensor {scene.sensor}"
    return f"Try tactilerl design{flags}, which looks for places where it pays."
