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

SEARCH = 1_000_000  # starts of the search are not those of the comparison
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
"""Sense of `reflexes.SENSES` by which each scripted hand goes, and when it goes over."""
BLIND = "timed", "joints", "active", "sight"
"""Scripted hands that neither feel nor see the object's exact place."""


@dataclasses.dataclass(frozen=True)
class HandResult:
    """The best reflex of a scripted hand and how often it succeeds."""

    name: str
    """One of SENSES."""
    layout: str
    """The hand's taxels."""
    taxel_threshold: float | None
    """Force from which they fire, N; None for any touch."""
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


def numbers(seed: int, starts: int, search: int) -> tuple[range, range]:
    """Return the numbers of the starts to search in, and of those to compare in."""
    first = 2 * SEARCH * seed
    return range(first + SEARCH, first + SEARCH + search), range(first, first + starts)


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

    Each sense has as many candidates, and each candidate the same starts `searched`; the best of them
    plays those `compared`. `tick` is called after every one of the `n_played` episodes of a sense.
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
        taxels = scene.layout, scene.taxel_threshold
        results.append(HandResult(name, *taxels, best, n_won / n, interval, n))
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


def compare(
    hand: str,
    variants: Sequence[GraspConfig],
    starts: int,
    search: int,
    seed: int,
    workers: int,
    tick: Callable[[], None] = lambda: None,
) -> list[HandResult]:
    """Play all scripted hands in the first variant of a scene, and the one that feels in each.

    `tick` is called after every one of the `n_compared` episodes.
    """
    senses, results = tuple(SENSES), list[HandResult]()
    for variant in variants:
        played = *numbers(seed, starts, search), workers, tick, senses
        results += examine(hand, variant, *played)
        senses = ("touch",)
    return sorted(results, key=lambda one: [*SENSES].index(one.name))


def n_compared(variants: Sequence[GraspConfig], starts: int, search: int) -> int:
    """Return the number of episodes that `compare` plays."""
    n_senses = len(useful_senses(variants[0])) + len(variants) - 1
    return n_senses * n_played(starts, search)


def which(result: HandResult, results: Sequence[HandResult]) -> str:
    """Return what tells a hand that feels from the others: layout and threshold, or nothing."""
    parts = []
    if len({one.layout for one in results}) > 1:
        parts.append(f"layout {result.layout}")
    if len({one.taxel_threshold for one in results}) > 1:
        parts.append(f"{result.taxel_threshold:g} N")
    return ", ".join(parts) if result.name == "touch" else ""


def sentences(scene: GraspConfig, results: Sequence[HandResult]) -> list[str]:
    """Say what touch can win with each layout and threshold, and where it does not, what to try."""
    blind, touching = without_touch(results), [r for r in results if r.name == "touch"]
    sighted = next(one.rate for one in results if one.name == "sighted")
    room, said = sighted - blind.rate, list[str]()
    if not pays(sighted, blind.rate):
        return [
            f"This scene cannot tell: the best scripted hand without touch ({blind.name}) succeeds "
            f"in {blind.rate:.2f} of its starts, the sighted one in {sighted:.2f}.",
            *few(blind.episodes),
        ]
    for one in touching:
        told = which(one, results)
        where = f" ({told})" if told else ""
        gained = min(max(0.0, one.rate - blind.rate), room)
        verdict = "pays" if pays(one.rate, blind.rate) else "does not pay"
        said.append(
            f"Touch {verdict}{where}: it closes {gained:.2f} of the "
            f"{room:.2f} gap between the best scripted hand without touch ({blind.name}, "
            f"{blind.rate:.2f}) and the sighted one ({sighted:.2f})."
        )
    said += few(blind.episodes)
    best = max(touching, key=lambda one: one.rate)
    if not pays(best.rate, blind.rate):
        said.append(_what_to_try(scene, best.taxel_threshold))
    if sighted < USABLE:
        said.append(
            "Even with sight the hand often fails: improve the hand or the scene before you train."
        )
    return said


def _what_to_try(scene: GraspConfig, threshold: float | None) -> str:
    """Return one sentence for a scene in which touch could pay, and with these taxels does not."""
    if tasks.TASKS[scene.task].giver is None:
        return "Try other layouts (--layout)."
    flag = "" if threshold is None else f" --taxel-threshold {threshold:g}"
    if scene.sensor:
        flag += f" --sensor {scene.sensor}"
    return f"Try tactilerl design{flag}, which looks for places where it pays."
