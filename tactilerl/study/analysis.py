"""From records to numbers: every group of runs, every comparison, every set-up of a study."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import statistics
from ..statistics import Array
from . import verdicts
from .grid import SCORES, Setup, Study
from .records import Record
from .verdicts import SEED, Headroom, Pairs, Verdict

MOST_POINTS = 500  # of a curve


@dataclass(frozen=True)
class Group:
    """The finished runs of one cell and arm."""

    seeds: list[int]
    curves: Array
    """(runs, points) at the set-up's common steps."""
    iqm_curve: Array
    """(points,)"""
    iqm_bounds: Array
    """(points, 2): its pointwise intervals."""
    scores: dict[str, Array]
    """By name as in `verdicts.scores`, (runs,)."""
    counts: Array
    """Bootstrap resamples of these runs."""

    def __len__(self) -> int:
        return len(self.seeds)


@dataclass(frozen=True)
class Comparison:
    """Treatment against control in one cell."""

    verdict: Verdict
    """By the primary score."""
    secondary: dict[str, Pairs]
    """By every other score."""
    headroom: Headroom | None


@dataclass(frozen=True)
class SetupResult:
    """One set-up."""

    setup: Setup
    steps: Array
    """(points,) at which the curves are compared."""
    groups: dict[tuple[str, str], Group]
    """By cell and arm, in order of the grid."""
    comparisons: dict[str, Comparison]
    records: list[Record]

    @property
    def config(self) -> dict[str, Any]:
        """The first config.json among the runs; empty where there is none."""
        return next((record.config for record in self.records if record.config), {})

    @property
    def cells(self) -> list[str]:
        """Those with finished runs, in order of the grid."""
        return list(dict.fromkeys(cell for cell, _ in self.groups))


@dataclass(frozen=True)
class Analysis:
    """A whole study."""

    study: Study
    records: list[Record]
    setups: list[SetupResult]


def analyse(
    study: Study, records: list[Record], n_resamples: int = statistics.N_RESAMPLES
) -> Analysis:
    """All numbers of a report."""
    setups = []
    for index, setup in enumerate(study.setups):
        own = [record for record in records if record.run.setup == setup.name]
        finished = [record for record in own if record.is_finished]
        first, last = verdicts.span(finished)
        points = min(
            MOST_POINTS, max((len(one.curve[0]) for one in finished), default=0)
        )
        steps = (
            np.linspace(first, last, points)
            if first < last
            else np.full(min(1, points), last)
        )
        groups = {}
        rng = np.random.default_rng([SEED, index])
        for cell in setup.cells:
            arms = {arm: verdicts.runs_of(own, setup, cell, arm) for arm in setup.arms}
            common = verdicts.span(itertools.chain(*arms.values()))
            for arm, runs in arms.items():
                if runs:
                    counts = statistics.resample(rng, len(runs), n_resamples)
                    groups[cell, arm] = _group(runs, steps, common, counts)
        compared = {
            cell: _comparison(study, setup, verdict, records, n_resamples)
            for cell, verdict in verdicts.judge(
                study, setup, records, n_resamples
            ).items()
            if all((cell, arm) in groups for arm in setup.arms[:2])
        }
        setups.append(SetupResult(setup, steps, groups, compared, own))
    return Analysis(study, records, setups)


def _group(
    runs: list[Record], steps: Array, common: tuple[float, float], counts: Array
) -> Group:
    curves = np.array([np.interp(steps, *record.curve) for record in runs])
    reached = [verdicts.scores(record, *common) for record in runs]
    scores = {name: np.array([one[name] for one in reached]) for name in reached[0]}
    aggregated = statistics.sample_efficiency(curves, "iqm", counts)
    return Group(
        [record.run.seed for record in runs], curves, *aggregated, scores, counts
    )


def _comparison(
    study: Study,
    setup: Setup,
    verdict: Verdict,
    records: list[Record],
    n_resamples: int,
) -> Comparison:
    others = [score for score in SCORES if score != study.primary.score]
    both = {
        score: verdicts.both_arms(records, setup, verdict.cell, score)
        for score in others
    }
    secondary = {
        score: verdicts.in_pairs(arms, n_resamples) for score, arms in both.items()
    }
    room = verdicts.headroom(study, setup, verdict.cell, records, n_resamples)
    return Comparison(verdict, secondary, room)
