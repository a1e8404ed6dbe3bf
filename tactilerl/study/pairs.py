"""Pairs of runs of the same seed: what each run reached, and what treatments add to controls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from .. import statistics
from ..runs.config import FINAL_TEST
from ..statistics import N_RESAMPLES, Array, Estimate
from .grid import Setup, Study
from .records import Record

SEED = 20_210_830  # of all resampling: the same records give the same report
ALPHA = 0.05
BySeed = dict[int, float]
"""A score by seed."""


@dataclass(frozen=True)
class Pairs:
    """One score of two groups in runs of the same seed."""

    seeds: list[int]
    treatment: Array
    control: Array
    """Scores (pairs,), as those of `treatment`."""
    difference: Estimate
    """Mean of treatment minus control, with its interval over pairs."""
    p_value: float
    """The p-value of a sign-flip test."""

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.seeds)


@dataclass(frozen=True)
class Verdict:
    """The primary comparison of one setting."""

    setting: str
    pairs: Pairs
    n_seeds: int
    """The number of pairs when all runs are done."""
    p_holm: float = math.nan
    """The p-value corrected for the other settings of the set-up."""

    @property
    def is_difference(self) -> bool:
        """True if a difference was detected, after Holm's correction."""
        return self.p_holm <= ALPHA


def runs_of(
    records: Iterable[Record], setup: Setup, setting: str, group: str
) -> list[Record]:
    """Return the finished runs of one group, in order of the seeds."""
    place = setup.name, setting, group
    return [one for one in records if one.run.place == place and one.is_finished]


def span(records: Iterable[Record]) -> tuple[float, float]:
    """Return the first and the last step at which all of the runs have a rate.

    The first is behind the last where there is none.
    """
    steps = [record.curve[0] for record in records]
    first = max((one[0] for one in steps), default=0)
    last = min((one[-1] for one in steps), default=0)
    return float(first), float(last)


def within(record: Record, first: float, last: float) -> tuple[Array, Array]:
    """Return the steps and rates of a finished run from the `first` to the `last` step."""
    steps, rates = record.curve
    at = np.unique([min(first, last), *steps[(steps > first) & (steps < last)], last])
    return at, np.interp(at, steps, rates)


def scores(record: Record, first: float, last: float) -> dict[str, float]:
    """Return what a finished run reached from the `first` to the `last` step.

    The names are those of `grid.Score`; `test` is NaN where the run was not tested at its end.
    """
    at, rates = within(record, first, last)
    return {
        "area": statistics.area_under_curve(at, rates),
        "last": statistics.end_rate(rates),
        "converged": statistics.converged_rate(rates),
        "test": float(record.column(FINAL_TEST)[-1]),
    }


def scored(score: str, *groups: Sequence[Record]) -> list[BySeed]:
    """Return a score of each run that has it, of several groups, over the steps that all have."""
    common = span(itertools.chain(*groups))
    reached = [
        {one.run.seed: scores(one, *common)[score] for one in group} for group in groups
    ]
    return [
        {seed: value for seed, value in one.items() if not math.isnan(value)}
        for one in reached
    ]


@cache
def resamples(n: int, n_resamples: int = N_RESAMPLES) -> Array:
    """Return bootstrap counts of `n` pairs (n, n_resamples), the same for the same number."""
    return statistics.resample(np.random.default_rng([SEED, n]), n, n_resamples)


def in_pairs(groups: Sequence[BySeed], n_resamples: int = N_RESAMPLES) -> Pairs:
    """Return the pairs of treatment and control, in the order of the treatment's seeds."""
    treatment, control = groups
    seeds = [seed for seed in treatment if seed in control]
    a, b = (np.array([group[seed] for seed in seeds]) for group in groups)
    rng = np.random.default_rng([SEED, len(seeds)])
    p_value = statistics.sign_flip_p(a - b, rng, n_resamples)
    difference = statistics.mean(a - b, resamples(len(seeds), n_resamples))
    return Pairs(seeds, a, b, difference, p_value)


def both_groups(
    records: Sequence[Record], setup: Setup, setting: str, score: str
) -> list[BySeed]:
    """Return the scores of treatment and control in a setting."""
    groups = (runs_of(records, setup, setting, group) for group in setup.groups[:2])
    return scored(score, *groups)


def judge(
    study: Study,
    setup: Setup,
    records: Sequence[Record],
    n_resamples: int = N_RESAMPLES,
) -> dict[str, Verdict]:
    """Return the primary comparison of every setting."""
    verdicts = []
    for setting in setup.settings if setup.compare else ():
        groups = both_groups(records, setup, setting, study.primary.score)
        pairs = in_pairs(groups, n_resamples)
        verdicts.append(Verdict(setting, pairs, len(setup.seeds)))
    corrected = statistics.holm([one.pairs.p_value for one in verdicts])
    return {
        one.setting: replace(one, p_holm=float(p))
        for one, p in zip(verdicts, corrected, strict=True)
    }
