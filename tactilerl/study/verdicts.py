"""What a study says of its primary comparisons: pairs of runs of the same seed, at each look."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from .. import statistics
from ..statistics import Array, Estimate
from .grid import Looks, Setup, Study
from .records import Record

SEED = 20_210_830  # of all resampling: the same records give the same report
SIGHT = ("object_seen", "sight_noise", "sight_noise_kind")
THRESHOLDS = (0.5, 0.9)
LEAST_ROOM = 0.3  # between the blind and the sighted control, for a scene to tell what touch is worth
BySeed = dict[int, float]
"""A score by seed."""
Ending = Literal["", "difference", "no difference", "last look"]


@dataclass(frozen=True)
class Pairs:
    """One score of two arms in runs of the same seed."""

    seeds: list[int]
    treatment: Array
    control: Array
    """Both (pairs,)."""
    difference: Estimate
    """Mean of treatment minus control, with its interval over pairs."""
    p_value: float
    """Sign-flip test."""

    def __len__(self) -> int:
        return len(self.seeds)


@dataclass(frozen=True)
class Stage:
    """How far a study with looks has come in one comparison."""

    look: int
    """The last one there was, from 1; 0 before the first."""
    of: int
    ending: Ending
    """What ended the comparison; "" while it goes on."""


@dataclass(frozen=True)
class Verdict:
    """The primary comparison of one cell."""

    cell: str
    pairs: Pairs
    n_seeds: int
    """Pairs there will be when all runs are done."""
    stage: Stage | None = None
    """None in a study without looks."""
    p_holm: float = math.nan
    """Corrected for the other cells of the set-up, and the other looks."""
    alpha: float = 0.05

    @property
    def valid_p(self) -> float:
        """1 where a look has not ended the comparison yet, or has for want of a difference: who could
        stop whenever p is small would find too much."""
        is_valid = self.stage is None or self.stage.ending in ("difference", "last look")
        return self.pairs.p_value if is_valid else 1.0

    @property
    def is_difference(self) -> bool:
        """Was one detected?"""
        return self.p_holm <= self.alpha


@dataclass(frozen=True)
class Headroom:
    """What touch gives of what sight would give."""

    n: int
    """Seeds that all three arms have."""
    room: Estimate
    """Sighted control minus blind control."""
    share: Estimate
    """(treatment - control) / (sighted - control)"""

    @property
    def is_enough(self) -> bool:
        """Can the scene tell what touch is worth?"""
        return self.room.value >= LEAST_ROOM


def is_finished(record: Record, measure: str) -> bool:
    """Is it done, and has it a curve?"""
    return record.state == "done" and len(record.curve(measure)[0]) > 0


def scores(record: Record, measure: str, until: float = math.inf) -> dict[str, float]:
    """What a finished run reached, or had `until` so many steps, by the names in `primary.SCORES`; and
    its steps to `THRESHOLDS`."""
    steps, rates = record.curve(measure)
    steps, rates = steps[steps <= until], rates[steps <= until]
    found = {
        "area": statistics.area_under_curve(steps, rates[None]),
        "final": statistics.final_rate(rates[None]),
        "converged": statistics.converged_rate(rates[None]),
    }
    for threshold in THRESHOLDS:
        found[f"steps to {threshold:g}"] = statistics.steps_to_threshold(steps, rates[None], threshold)
    return {name: float(value[0]) for name, value in found.items()}


@cache
def resamples(n: int, n_resamples: int = statistics.N_RESAMPLES) -> Array:
    """Of `n` pairs: the same ones wherever the same number is looked at."""
    return statistics.resample(np.random.default_rng([SEED, n]), n, n_resamples)


def in_pairs(treatment: BySeed, control: BySeed, n_resamples: int = statistics.N_RESAMPLES) -> Pairs:
    """The seeds that both have, in the treatment's order."""
    seeds = [seed for seed in treatment if seed in control]
    a, b = (np.array([arm[seed] for seed in seeds]) for arm in (treatment, control))
    p_value = statistics.sign_flip_p(a - b, np.random.default_rng([SEED, len(seeds)]), n_resamples)
    return Pairs(seeds, a, b, statistics.mean(a - b, resamples(len(seeds), n_resamples)), p_value)


def judge(
    study: Study, setup: Setup, records: Sequence[Record], n_resamples: int = statistics.N_RESAMPLES
) -> dict[str, Verdict]:
    """The primary comparison of every cell that has runs of both arms."""
    found = []
    for cell in setup.cells if setup.compare else ():
        arms = both_arms(records, setup, cell, study.primary.score)
        if study.looks is not None:
            found.append(_at_looks(study.looks, setup, cell, records, arms))
        else:
            found.append(Verdict(cell, in_pairs(*arms, n_resamples), len(setup.seeds)))
    corrected = statistics.holm([one.valid_p for one in found])
    return {one.cell: replace(one, p_holm=float(p)) for one, p in zip(found, corrected, strict=True)}


def by_seed(records: Iterable[Record], setup: Setup, cell: str, arm: str, score: str) -> BySeed:
    """A score of the finished runs of one arm, in order of the seeds."""
    return {
        r.run.seed: scores(r, setup.measure)[score]
        for r in records
        if _is_in(r, setup, cell) and r.run.arm == arm and is_finished(r, setup.measure)
    }


def both_arms(records: Sequence[Record], setup: Setup, cell: str, score: str) -> tuple[BySeed, BySeed]:
    """The scores of treatment and control."""
    treatment, control = (by_seed(records, setup, cell, arm, score) for arm in setup.arms[:2])
    return treatment, control


def _is_in(record: Record, setup: Setup, cell: str) -> bool:
    return (record.run.setup, record.run.cell) == (setup.name, cell)


def _at_looks(
    looks: Looks, setup: Setup, cell: str, records: Sequence[Record], arms: tuple[BySeed, BySeed]
) -> Verdict:
    """As it stands at the last look whose runs have all ended. Runs beyond the look that ended the
    comparison do not count."""
    own = (r for r in records if _is_in(r, setup, cell) and r.run.arm in setup.arms[:2])
    is_open = {r.run.seed for r in own if not r.has_ended}
    n_ended = next((i for i, seed in enumerate(setup.seeds) if seed in is_open), len(setup.seeds))
    whole = in_pairs(*arms)
    at_hand = [sum(s in whole.seeds for s in setup.seeds[:n]) for n in looks.pairs if n <= n_ended]
    taken = take(looks, whole.treatment - whole.control, at_hand, len(setup.cells))
    n, gap, p_value, ending = taken[-1] if taken else Taken(len(whole), whole.difference, math.nan, "")
    seen = Pairs(whole.seeds[:n], whole.treatment[:n], whole.control[:n], gap, p_value)
    stage = Stage(len(taken), len(looks.pairs), ending)
    return Verdict(cell, seen, len(setup.seeds), stage, alpha=looks.alpha)


class Taken(NamedTuple):
    """One look at one comparison."""

    n: int
    """Pairs at hand."""
    difference: Estimate
    p_value: float
    ending: Ending


def take(
    looks: Looks, differences: Array, at_hand: Sequence[int], n_comparisons: int = 1
) -> list[Taken]:
    """Look at differences (pairs,) each time that so many are `at_hand`, until a look ends it."""
    spent = looks.spent(n_comparisons)
    tested = statistics.sequential_sign_flips(
        differences[: max(at_hand, default=0)], list(zip(at_hand, spent, strict=False)),
        looks.pairs[-1], np.random.default_rng([SEED, looks.pairs[-1]]),
    )  # fmt: skip
    taken: list[Taken] = []
    for n, error, look in zip(at_hand, spent, tested, strict=False):
        found = statistics.mean(differences[:n], resamples(n), 1 - look.level)
        ending: Ending = "last look" if len(taken) == len(spent) - 1 else ""
        if look.p_value <= error + 1e-12:
            ending = "difference"
        elif found.low < found.high and max(-found.low, found.high) < looks.effect:
            ending = "no difference"
        taken.append(Taken(n, found, look.p_value, ending))
        if ending:
            break
    return taken


# -- the worth of touch as a share of what sight is worth ---------------------------------------


def headroom(
    study: Study, setup: Setup, cell: str, records: Sequence[Record], n_resamples: int
) -> Headroom | None:
    """With the runs that differ from a cell's controls in seeing the object exactly, and in nothing
    else, wherever in the study they are; None where there are none."""
    own = (r for r in records if _is_in(r, setup, cell) and r.run.arm == setup.arms[1])
    blind = next((r.config for r in own if r.config), None)
    if blind is None or _sight(blind) == "exact":
        return None
    score, measure, alike = study.primary.score, setup.measure, _but_sight(blind)
    seen = {
        r.run.seed: scores(r, measure)[score]
        for r in records
        if r.config and _sight(r.config) == "exact" and _but_sight(r.config) == alike
        if is_finished(r, measure)
    }
    touch, control = both_arms(records, setup, cell, score)
    seeds = [seed for seed in touch if seed in control and seed in seen]
    if not seeds:
        return None
    best, main, least = (np.array([arm[s] for s in seeds]) for arm in (seen, touch, control))
    drawn = resamples(len(seeds), n_resamples)
    return Headroom(
        len(seeds),
        statistics.mean(best - least, drawn),
        statistics.share(main - least, best - least, drawn),
    )


def _sight(config: Mapping[str, Any]) -> str:
    return (config.get("scene") or {}).get("object_seen", "exact")


def _but_sight(config: Mapping[str, Any]) -> dict[str, Any]:
    """All that makes a run, but its seed and how the object is seen."""
    parts = {name: dict(config.get(name) or {}) for name in ("run", "scene", "learner")}
    parts["run"].pop("seed", None)
    for name in SIGHT:
        parts["scene"].pop(name, None)
    return parts
