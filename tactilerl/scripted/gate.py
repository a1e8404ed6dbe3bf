"""Measure what touch can win in a scene: scripted hands of each sense (reflexes), chosen fairly."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np

from .. import statistics
from ..envs import vector
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
    """Find the best reflex of each sense in a scene, `starts` starts each.

    Each sense has as many candidates, and each candidate the same `search` starts. `tick` is called
    after every candidate.
    """
    found, first = [], 2 * SEARCH * seed
    for name in senses:
        sense, _ = SENSES[name]
        if name == "sight" and scene.object_seen in ("hidden", "exact"):
            continue  # nothing to go by, or what "sighted" is
        own = (
            scene
            if sense == "touch"
            else dataclasses.replace(scene, touch="absent", **NO_FAULTS)
        )
        if name == "sighted":
            exact: Any = {
                "object_seen": "exact",
                "sight_noise": None,
                "sight_noise_kind": "white",
            }
            own = dataclasses.replace(own, **exact)
        make = partial(GraspEnv, hand, own)
        with closing(make()) as example:
            candidates = reflexes.candidates(example, sense)
        if not candidates:
            continue
        with closing(vector.start(make, workers)) as played_in:
            rates = []
            for reflex in candidates:
                rates.append(_play(played_in, reflex, first + SEARCH, search).mean())
                tick()
            best = candidates[int(np.argmax(rates))]
            n_won = int(_play(played_in, best, first, starts).sum())
            interval = statistics.wilson_interval(n_won, starts)
            found.append(Found(name, best, n_won / starts, interval, starts))
    return found


def _play(
    workers: vector.Workers, reflex: reflexes.Reflex, first: int, n: int
) -> np.ndarray:
    """Tell which starts succeed, bool (n,)."""
    return np.array(list(workers.play(reflex.play, range(first, first + n))))


def verdict(found: list[Found]) -> str:
    """Return one sentence about the scene."""
    rates = {each.name: each.rate for each in found}
    best = max(
        (name for name in rates if name not in ("touch", "sighted")),
        key=rates.__getitem__,
    )
    without, room = rates[best], rates["sighted"] - rates[best]
    if room < TELLS:
        return (
            f"This scene cannot tell: the best scripted hand without touch ({best}) succeeds in "
            f"{without:.2f} of its starts, the sighted one in {rates['sighted']:.2f}."
        )
    won = min(max(0.0, rates["touch"] - without), room)
    return (
        f"Touch closes {won:.2f} of the {room:.2f} gap between the best scripted hand without touch "
        f"({best}, {without:.2f}) and the sighted one ({rates['sighted']:.2f})."
    )
