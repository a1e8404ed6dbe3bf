"""Turn records into numbers: what runs reached, and what treatments add to controls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_args

import numpy as np

from .. import statistics
from ..runs.config import FINAL_TEST
from ..statistics import N_RESAMPLES, Array, Estimate
from ..style import NAMES
from .grid import Score, Setup, Study
from .records import Record

SEED = 20_210_830  # of all resampling: the same records give the same report
ALPHA = 0.05
N_POINTS = 200  # of a curve
BySeed = dict[int, float]
"""A score by seed."""


# -- runs ------------------------------------------------------------------------------------


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

    The names are those of `grid.Score`; `test` is NaN where the run was not tested at
    its end.
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
    by_group = []
    for group in groups:
        reached = {one.run.seed: scores(one, *common)[score] for one in group}
        by_group.append({k: x for k, x in reached.items() if not math.isnan(x)})
    return by_group


# -- pairs -----------------------------------------------------------------------------------


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
    p_holm: float = math.nan
    """The same, corrected for the other settings of the set-up."""

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.seeds)


@cache
def resamples(n: int) -> Array:
    """Return bootstrap counts of `n` pairs (n, N_RESAMPLES), the same for the same number."""
    return statistics.resample(np.random.default_rng([SEED, n]), n, N_RESAMPLES)


def in_pairs(groups: Sequence[BySeed]) -> Pairs:
    """Return the pairs of treatment and control, in the order of the treatment's seeds."""
    treatment, control = groups
    seeds = [seed for seed in treatment if seed in control]
    a, b = (np.array([group[seed] for seed in seeds]) for group in groups)
    rng = np.random.default_rng([SEED, len(seeds)])
    p_value = statistics.sign_flip_p(a - b, rng, N_RESAMPLES)
    difference = statistics.mean(a - b, resamples(len(seeds)))
    return Pairs(seeds, a, b, difference, p_value)


# -- a whole study ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """The finished runs of one setting that share a value of the compared flag."""

    reached: dict[int, dict[str, float]]
    """What each run reached, as `scores` has it, by its seed."""
    curves: Array
    """Success rates (runs, points) at the set-up's common steps."""
    mean_curve: Array
    """Their mean (points,)."""
    bounds: Array
    """Its pointwise intervals (points, 2)."""
    means: dict[str, Estimate]
    """Means of the scores over the runs, with intervals."""


@dataclass(frozen=True)
class SetupResult:
    """The numbers of one set-up."""

    setup: Setup
    steps: Array
    """Steps (points,) at which the curves are compared."""
    groups: dict[tuple[str, str], Group]
    """Groups by setting and value of the compared flag, in order of the grid."""
    pairs: dict[str, Pairs]
    """Comparisons by setting."""
    records: list[Record]

    @property
    def config(self) -> dict[str, Any]:
        """The first config.json among the runs; empty where there is none."""
        return next((record.config for record in self.records if record.config), {})

    @property
    def subject(self) -> str:
        """The hand, simulator and learner: `MPL hand, MuJoCo, PPO`."""
        run, scene = self.config.get("run", {}), self.config.get("scene") or {}
        parts = run.get("env"), scene.get("simulator"), run.get("algo")
        named = ", ".join(NAMES.get(part, part) for part in parts if part)
        return named or self.setup.name


@dataclass(frozen=True)
class Analysis:
    """The numbers of a whole study."""

    study: Study
    records: list[Record]
    setups: list[SetupResult]


def analyse(study: Study, records: list[Record]) -> Analysis:
    """Compute all numbers of a report."""
    setups = []
    for index, setup in enumerate(study.setups):
        rng = np.random.default_rng([SEED, index])
        its_own = [record for record in records if record.run.setup == setup.name]
        setups.append(_setup(setup, its_own, study.score, rng))
    return Analysis(study, records, setups)


def _setup(
    setup: Setup,
    records: list[Record],
    score: str,
    rng: np.random.Generator,
) -> SetupResult:
    first, last = span(record for record in records if record.is_finished)
    steps = np.linspace(min(first, last), last, N_POINTS)
    groups, pairs = {}, dict[str, Pairs]()
    for setting in setup.settings:
        runs = {name: runs_of(records, setup, setting, name) for name in setup.groups}
        common = span(itertools.chain(*runs.values()))
        for name, its_runs in runs.items():
            if its_runs:
                counts = statistics.resample(rng, len(its_runs), N_RESAMPLES)
                groups[setting, name] = _group(its_runs, steps, common, counts)
        if setup.compare:
            treatment, control, *_ = runs.values()
            pairs[setting] = in_pairs(scored(score, treatment, control))
    corrected = statistics.holm([one.p_value for one in pairs.values()])
    for setting, p in zip(pairs, corrected, strict=True):
        pairs[setting] = replace(pairs[setting], p_holm=float(p))
    return SetupResult(setup, steps, groups, pairs, records)


def _group(
    runs: list[Record], steps: Array, common: tuple[float, float], counts: Array
) -> Group:
    curves = np.array([np.interp(steps, *record.curve) for record in runs])
    reached = {record.run.seed: scores(record, *common) for record in runs}
    means = {
        score: statistics.mean(
            np.array([one[score] for one in reached.values()]), counts
        )
        for score in get_args(Score)
    }
    return Group(reached, curves, *statistics.mean_curve(curves, counts), means)
