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
MIN_GAIN = (
    0.3  # difference of success rates from which touch, or a scene, says anything
)
USABLE = 0.9  # success of the sighted hand from which a scene is worth training in
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
"""Sense of `reflexes.SENSES` by which each scripted hand goes, and when it goes over."""
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


def examine(
    hand: str,
    scene: GraspConfig,
    starts: int,
    search: int,
    seed: int,
    workers: int,
    tick: Callable[[], None] = lambda: None,
    senses: Sequence[str] = tuple(SENSES),
) -> list[HandResult]:
    """Find the best reflex of each of these senses in a scene, `starts` starts each.

    Each sense has as many candidates, and each candidate the same `search` starts. `tick` is called
    after every one of the `n_played` episodes of a sense.
    """
    first = 2 * SEARCH * seed
    compared = range(first, first + starts)
    searched = range(first + SEARCH, first + SEARCH + search)
    results = []
    for name in useful_senses(scene):
        if name not in senses:
            continue
        sense, _ = SENSES[name]
        changes: dict[str, Any] = {}
        if sense != "touch":
            changes = {"touch": "absent", **NO_FAULTS}
        if name == "sighted":
            changes |= {
                "object_seen": "exact",
                "sight_noise": None,
                "sight_noise_kind": "white",
            }
        make = partial(GraspEnv, hand, dataclasses.replace(scene, **changes))
        with closing(vector.start(make, workers)) as played_in:
            env: Any = played_in.env.unwrapped
            candidates = reflexes.candidates(env, sense)
            counts = [
                _n_won(played_in, reflex, searched, tick) for reflex in candidates
            ]
            best = candidates[counts.index(max(counts))]
            n_won = _n_won(played_in, best, compared, tick)
        interval = statistics.wilson_interval(n_won, starts)
        results.append(HandResult(name, best, n_won / starts, interval, starts))
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


def without_touch(results: list[HandResult]) -> HandResult:
    """Return the best hand that neither feels nor sees the object's exact place."""
    blind = [result for result in results if result.name in BLIND]
    return max(blind, key=lambda result: result.rate)


def verdict(results: list[HandResult]) -> str:
    """Return one sentence about what touch can win in the scene."""
    rates, blind = {one.name: one.rate for one in results}, without_touch(results)
    room = rates["sighted"] - blind.rate
    if not pays(rates["sighted"], blind.rate):
        return (
            f"This scene cannot tell: the best scripted hand without touch ({blind.name}) succeeds in "
            f"{blind.rate:.2f} of its starts, the sighted one in {rates['sighted']:.2f}."
        )
    gained = min(max(0.0, rates["touch"] - blind.rate), room)
    caution = (
        " Even with sight the hand often fails: improve the hand or the scene before you train."
        if rates["sighted"] < USABLE
        else ""
    )
    return (
        f"Touch closes {gained:.2f} of the {room:.2f} gap between the best scripted hand without touch "
        f"({blind.name}, {blind.rate:.2f}) and the sighted one ({rates['sighted']:.2f}).{caution}"
    )


def pays(touch: float, blind: float) -> bool:
    """Tell whether a success rate is enough above that of the best hand without touch."""
    return round(touch - blind, 9) >= MIN_GAIN


def where_touch_stops(rates: Mapping[float, tuple[float, float]]) -> str:
    """Return one sentence about the threshold, N, at which touch stops paying.

    `rates` are success rates by threshold: that of a hand with touch, and that of the best without.
    """
    for threshold, (touch, blind) in sorted(rates.items()):
        if not pays(touch, blind):
            return (
                f"Touch stops paying at a threshold of {threshold:g} N: touch succeeds in "
                f"{touch:.2f} of the starts, the best hand without in {blind:.2f}."
            )
    return (
        f"Touch pays at every one of these thresholds, up to {max(rates):g} N: it succeeds in at "
        f"least {MIN_GAIN:g} more of the starts than the best hand without."
    )
