"""Turn records into numbers: groups of runs, comparisons and set-ups of a study."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import statistics
from ..statistics import N_RESAMPLES, Array
from ..style import NAMES
from .grid import Setup, Study
from .pairs import SEED, Verdict, judge, runs_of, scores, span
from .records import Record

MAX_POINTS = 500  # of a curve


@dataclass(frozen=True)
class Group:
    """The finished runs of one setting that share a value of the compared flag."""

    seeds: list[int]
    curves: Array
    """Success rates (runs, points) at the set-up's common steps."""
    iqm_curve: Array
    """Their interquartile mean (points,)."""
    iqm_bounds: Array
    """Its pointwise intervals (points, 2)."""
    scores: dict[str, Array]
    """Each score of `pairs.scores` (runs,), by its name."""
    counts: Array
    """Bootstrap resamples of these runs."""


@dataclass(frozen=True)
class SetupResult:
    """The numbers of one set-up."""

    setup: Setup
    steps: Array
    """Steps (points,) at which the curves are compared."""
    groups: dict[tuple[str, str], Group]
    """Groups by setting and value of the compared flag, in order of the grid."""
    verdicts: dict[str, Verdict]
    """Comparisons by setting, where both groups have finished runs."""
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
        named = ", ".join(NAMES.get(part, str(part)) for part in parts if part)
        return named or self.setup.name


@dataclass(frozen=True)
class Analysis:
    """The numbers of a whole study."""

    study: Study
    records: list[Record]
    setups: list[SetupResult]


def analyse(
    study: Study, records: list[Record], n_resamples: int = N_RESAMPLES
) -> Analysis:
    """Compute all numbers of a report."""
    setups = [
        _setup(study, setup, np.random.default_rng([SEED, index]), records, n_resamples)
        for index, setup in enumerate(study.setups)
    ]
    return Analysis(study, records, setups)


def _setup(
    study: Study,
    setup: Setup,
    rng: np.random.Generator,
    records: list[Record],
    n_resamples: int,
) -> SetupResult:
    records = [record for record in records if record.run.setup == setup.name]
    finished = [record for record in records if record.is_finished]
    first, last = span(finished)
    longest = max((len(record.curve[0]) for record in finished), default=0)
    n_points = min(longest, MAX_POINTS if first < last else 1)
    steps = np.linspace(last, first, n_points)[::-1]
    groups = {}
    for setting in setup.settings:
        runs = {
            group: runs_of(records, setup, setting, group) for group in setup.groups
        }
        common = span(itertools.chain(*runs.values()))
        for group, its_runs in runs.items():
            if its_runs:
                counts = statistics.resample(rng, len(its_runs), n_resamples)
                groups[setting, group] = _group(its_runs, steps, common, counts)
    verdicts = {
        setting: verdict
        for setting, verdict in judge(study, setup, records, n_resamples).items()
        if all((setting, group) in groups for group in setup.groups[:2])
    }
    return SetupResult(setup, steps, groups, verdicts, records)


def _group(
    runs: list[Record], steps: Array, common: tuple[float, float], counts: Array
) -> Group:
    curves = np.array([np.interp(steps, *record.curve) for record in runs])
    reached = [scores(record, *common) for record in runs]
    by_score = {name: np.array([one[name] for one in reached]) for name in reached[0]}
    seeds = [record.run.seed for record in runs]
    iqm_curve, bounds = statistics.sample_efficiency(curves, counts)
    return Group(seeds, curves, iqm_curve, bounds, by_score, counts)
