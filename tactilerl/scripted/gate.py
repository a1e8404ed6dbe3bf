"""Measure what touch can win in a scene: scripted hands of each sense (reflexes), chosen fairly."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import Any

from .. import statistics
from ..envs import tasks, vector
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.observations import TaxelFaults
from . import reflexes

SEARCH = 1_000_000  # starts of the search are not those of the comparison
TELLS = 0.3  # what a scene must leave to win to tell anything
NO_FAULTS: dict[str, Any] = {
    **dataclasses.asdict(TaxelFaults()),
    "taxel_delay": 0,
    "taxel_threshold": None,
    "taxel_release": None,
}
SENSES = {
    "timed": ("time", "a fixed time has passed"),
    "joints": ("joints", "the joints or the hand have moved"),
    "active": ("active", "something blocks a test squeeze"),
    "sight": ("sight", "the object looks near in the scene"),
    "touch": ("touch", "enough taxels fire"),
    "sighted": ("sight", "the object is seen to be in place"),
}


BLIND = "timed", "joints", "active", "sight"


@dataclasses.dataclass(frozen=True)
class Found:
    """The best reflex of a sense and how often it succeeds."""

    name: str
    """One of SENSES."""
    reflex: reflexes.Reflex
    rate: float
    interval: Sequence[float]
    """Wilson's, 95 %."""
    episodes: int


def useful_senses(scene: GraspConfig) -> list[str]:
    """Return the senses that a scene has a use for."""
    is_seen = scene.object_seen not in ("hidden", "exact")  # exact: as the sighted hand
    is_handed_over = tasks.TASKS[scene.task].giver is not None
    of_some = {"sight": is_seen, "active": is_handed_over}
    return [name for name in SENSES if of_some.get(name, True)]


def examine(
    hand: str,
    scene: GraspConfig,
    starts: int,
    search: int,
    seed: int,
    workers: int,
    tick: Callable[[], None] = lambda: None,
    senses: Sequence[str] = tuple(SENSES),
) -> list[Found]:
    """Find the best reflex of each of these senses in a scene, `starts` starts each.

    Each sense has as many candidates, and each candidate the same `search` starts. `tick` is called
    after every one of the `n_played` episodes of a sense.
    """
    results, first = [], 2 * SEARCH * seed
    for name in useful_senses(scene):
        if name not in senses:
            continue
        sense, _ = SENSES[name]
        sensed = scene
        if sense != "touch":
            sensed = dataclasses.replace(scene, touch="absent", **NO_FAULTS)
        if name == "sighted":
            exact: Any = {
                "object_seen": "exact",
                "sight_noise": None,
                "sight_noise_kind": "white",
            }
            sensed = dataclasses.replace(sensed, **exact)
        make = partial(GraspEnv, hand, sensed)
        with closing(vector.start(make, workers)) as played_in:
            others = range(first + SEARCH, first + SEARCH + search)
            env: Any = played_in.env.unwrapped
            candidates = reflexes.candidates(env, sense)
            counts = [_n_won(played_in, reflex, others, tick) for reflex in candidates]
            best = candidates[counts.index(max(counts))]
            n_won = _n_won(played_in, best, range(first, first + starts), tick)
        interval = statistics.wilson_interval(n_won, starts)
        results.append(Found(name, best, n_won / starts, interval, starts))
    return results


def _n_won(
    workers: vector.Workers,
    reflex: reflexes.Reflex,
    starts: range,
    tick: Callable[[], None],
) -> int:
    """Return how many starts a reflex wins; `tick` is called after every one."""
    n_won = 0
    for is_won in workers.play(reflex.play, starts):
        n_won += is_won
        tick()
    return n_won


def n_played(starts: int, search: int) -> int:
    """Return how many episodes are played for a sense."""
    return reflexes.CANDIDATES * search + starts


def without_touch(results: list[Found]) -> Found:
    """Return the best hand that neither feels nor sees the object's exact place."""
    return max((one for one in results if one.name in BLIND), key=lambda one: one.rate)


def verdict(results: list[Found]) -> str:
    """Return one sentence about the scene."""
    rates, blind = {one.name: one.rate for one in results}, without_touch(results)
    room = rates["sighted"] - blind.rate
    if room < TELLS:
        return (
            f"This scene cannot tell: the best scripted hand without touch ({blind.name}) succeeds in "
            f"{blind.rate:.2f} of its starts, the sighted one in {rates['sighted']:.2f}."
        )
    gained = min(max(0.0, rates["touch"] - blind.rate), room)
    return (
        f"Touch closes {gained:.2f} of the {room:.2f} gap between the best scripted hand without touch "
        f"({blind.name}, {blind.rate:.2f}) and the sighted one ({rates['sighted']:.2f})."
    )


def where_it_stops(rates: Mapping[float, float], blind: float) -> str:
    """Return one sentence: at which threshold, N, does touch stop paying?

    `rates` are the successes of hands with touch by threshold, `blind` that of the best hand without.
    """
    for threshold, rate in sorted(rates.items()):
        if rate - blind < TELLS:
            return (
                f"Touch stops paying at a threshold of {threshold:g} N: touch succeeds in "
                f"{rate:.2f} of the starts, the best without in {blind:.2f}."
            )
    return f"Touch pays at every one of these thresholds, up to {max(rates):g} N."
