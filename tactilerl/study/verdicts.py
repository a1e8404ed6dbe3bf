"""What a study says of its primary comparisons: pairs of runs of the same seed, at each look."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from .. import statistics
from ..statistics import Array, Estimate
from .grid import Looks, Setup, Study
from .records import Record, settings

SEED = 20_210_830  # of all resampling: the same records give the same report
SIGHT = ("object_seen", "sight_noise", "sight_noise_kind")
THRESHOLDS = (0.5, 0.9)
LEAST_ROOM = (
    0.3  # between the controls without and with sight, to tell what touch is worth
)
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
        is_valid = self.stage is None or self.stage.ending in (
            "difference",
            "last look",
        )
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
    """Control with sight minus control without."""
    share: Estimate
    """(treatment - control) / (sighted - control)"""

    @property
    def is_enough(self) -> bool:
        """Can the scene tell what touch is worth?"""
        return self.room.value >= LEAST_ROOM


def runs_of(
    records: Iterable[Record], setup: Setup, cell: str, arm: str
) -> list[Record]:
    """The finished runs of one arm, in order of the seeds."""
    place = setup.name, cell, arm
    return [one for one in records if one.run.combination == place and one.is_finished]


def span(records: Iterable[Record]) -> tuple[float, float]:
    """The first and the last step at which all of the runs have a rate; the first is behind the last
    where there is none."""
    steps = [record.curve[0] for record in records]
    first, last = (
        max((one[0] for one in steps), default=0),
        min((one[-1] for one in steps), default=0),
    )
    return float(first), float(last)


def scores(record: Record, first: float, last: float) -> dict[str, float]:
    """What a finished run reached from the `first` to the `last` step, by the names of `grid.Score`;
    and its steps to `THRESHOLDS`."""
    steps, rates = record.curve
    at = np.unique([min(first, last), *steps[(steps > first) & (steps < last)], last])
    rates = np.interp(at, steps, rates)[None]
    found = {
        "area": statistics.area_under_curve(at, rates),
        "final": statistics.final_rate(rates),
        "converged": statistics.converged_rate(rates),
    }
    for threshold in THRESHOLDS:
        found[f"steps to {threshold:g}"] = statistics.steps_to_threshold(
            at, rates, threshold
        )
    return {name: float(value[0]) for name, value in found.items()}


def scored(score: str, *groups: Sequence[Record]) -> list[BySeed]:
    """A score of each run of several groups, over the steps that all of them have."""
    common = span(itertools.chain(*groups))
    return [
        {one.run.seed: scores(one, *common)[score] for one in group} for group in groups
    ]


@cache
def resamples(n: int, n_resamples: int = statistics.N_RESAMPLES) -> Array:
    """Of `n` pairs: the same ones wherever the same number is looked at."""
    return statistics.resample(np.random.default_rng([SEED, n]), n, n_resamples)


def in_pairs(
    arms: Sequence[BySeed], n_resamples: int = statistics.N_RESAMPLES
) -> Pairs:
    """The seeds that treatment and control have, in the treatment's order."""
    treatment, control = arms
    seeds = [seed for seed in treatment if seed in control]
    a, b = (np.array([arm[seed] for seed in seeds]) for arm in arms)
    p_value = statistics.sign_flip_p(
        a - b, np.random.default_rng([SEED, len(seeds)]), n_resamples
    )
    return Pairs(
        seeds, a, b, statistics.mean(a - b, resamples(len(seeds), n_resamples)), p_value
    )


def judge(
    study: Study,
    setup: Setup,
    records: Sequence[Record],
    n_resamples: int = statistics.N_RESAMPLES,
) -> dict[str, Verdict]:
    """The primary comparison of every cell that has runs of both arms."""
    found = []
    for cell in setup.cells if setup.compare else ():
        arms = both_arms(records, setup, cell, study.primary.score)
        if study.looks is not None:
            found.append(_at_looks(study.looks, setup, cell, records, arms))
        else:
            found.append(Verdict(cell, in_pairs(arms, n_resamples), len(setup.seeds)))
    corrected = statistics.holm([one.valid_p for one in found])
    return {
        one.cell: replace(one, p_holm=float(p))
        for one, p in zip(found, corrected, strict=True)
    }


def both_arms(
    records: Sequence[Record], setup: Setup, cell: str, score: str
) -> list[BySeed]:
    """The scores of treatment and control."""
    return scored(
        score, *(runs_of(records, setup, cell, arm) for arm in setup.arms[:2])
    )


def _at_looks(
    looks: Looks,
    setup: Setup,
    cell: str,
    records: Sequence[Record],
    arms: Sequence[BySeed],
) -> Verdict:
    """As it stands at the last look whose runs have all ended. Runs beyond the look that ended the
    comparison do not count."""
    own = [(setup.name, cell, arm) for arm in setup.arms[:2]]
    is_open = {
        r.run.seed for r in records if r.run.combination in own and not r.has_ended
    }
    n_ended = next(
        (i for i, seed in enumerate(setup.seeds) if seed in is_open), len(setup.seeds)
    )
    whole = in_pairs(arms)
    at_hand = [
        sum(s in whole.seeds for s in setup.seeds[:n])
        for n in looks.pairs
        if n <= n_ended
    ]
    taken = take(looks, whole.treatment - whole.control, at_hand, len(setup.cells))
    n, gap, p_value, ending = (
        taken[-1] if taken else Taken(len(whole), whole.difference, math.nan, "")
    )
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
    touch, control = (runs_of(records, setup, cell, arm) for arm in setup.arms[:2])
    made = [_but_sight(one.config or {}) for one in control[:1]]
    if not made or made[0][1] == "exact":
        return None
    alike = (made[0][0], "exact")
    seen = [
        one
        for one in records
        if one.is_finished and _but_sight(one.config or {}) == alike
    ]
    arms = scored(study.primary.score, seen, touch, control)
    seeds = [seed for seed in arms[1] if seed in arms[0] and seed in arms[2]]
    if not seeds:
        return None
    best, main, least = (np.array([arm[seed] for seed in seeds]) for arm in arms)
    drawn = resamples(len(seeds), n_resamples)
    share = statistics.share(main - least, best - least, drawn)
    return Headroom(len(seeds), statistics.mean(best - least, drawn), share)


def _but_sight(config: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """All that makes a run, but its seed and how the object is seen; and that."""
    made = settings(config)
    made.pop("seed", None)
    seen, *_ = (made.pop(name, "exact") for name in SIGHT)
    return made, str(seen)
