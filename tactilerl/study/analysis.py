"""From records to numbers: every group of runs, every comparison, every set-up of a study."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .. import statistics
from ..statistics import Array, Estimate, Metric, Term
from . import published, verdicts
from .grid import Setup, Study
from .primary import SCORES
from .published import Published
from .records import Record
from .verdicts import SEED, Headroom, Pairs, Verdict

MOST_POINTS = 500  # of a curve
THRESHOLDS = (0.5, 0.9)


@dataclass(frozen=True)
class Group:
    """The finished runs of one cell and arm."""

    cell: str
    arm: str
    seeds: list[int]
    curves: Array
    """(runs, points) at the set-up's common steps."""
    iqm_curve: Array
    """(points,)"""
    iqm_bounds: Array
    """(points, 2): its pointwise intervals."""
    scores: dict[str, Array]
    """By name in SCORES, (runs,)."""
    counts: Array
    """Bootstrap resamples of these runs."""

    def estimate(self, metric: Metric, score: str) -> Estimate:
        """An aggregate with its percentile interval."""
        return statistics.estimate(self.scores[score], metric, self.counts)

    def by_seed(self, score: str) -> dict[int, float]:
        """A score of each run."""
        return dict(zip(self.seeds, map(float, self.scores[score]), strict=True))

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
    iqm_difference: Estimate
    """Of converged rates, as the paper compares them; not in pairs."""
    overlap: float
    improvement: Estimate


@dataclass(frozen=True)
class SetupResult:
    """One set-up."""

    setup: Setup
    steps: Array
    """(points,) at which the curves are compared."""
    groups: dict[tuple[str, str], Group]
    comparisons: dict[str, Comparison]
    published: Published | None
    records: list[Record]

    @property
    def cells(self) -> list[str]:
        """Those with finished runs, in order of the grid."""
        return [cell for cell in self.setup.cells if any(cell == c for c, _ in self.groups)]


@dataclass(frozen=True)
class Agreement:
    """Do two or more set-ups put the cells into the same order?"""

    by: str
    setups: list[str]
    correlation: Estimate


@dataclass(frozen=True)
class Analysis:
    """A whole study."""

    study: Study
    records: list[Record]
    setups: list[SetupResult]
    agreements: list[Agreement] = field(default_factory=list)
    mixed: list[Term] | str = "not asked"
    """The mixed model's terms, or why there are none."""

    @property
    def fewest(self) -> int:
        """Runs in the smallest group."""
        return min((len(group) for one in self.setups for group in one.groups.values()), default=0)


def analyse(study: Study, records: list[Record], n_resamples: int = statistics.N_RESAMPLES) -> Analysis:
    """All numbers of a report."""
    setups = []
    for index, setup in enumerate(study.setups):
        own = [record for record in records if record.run.setup == setup.name]
        rng = np.random.default_rng([SEED, index])
        result = _setup(setup, own, rng, n_resamples)
        compared = _comparisons(study, result, records, n_resamples)
        setups.append(replace(result, comparisons=compared))
    score = study.primary.score
    agreements = _agreements(setups, score, np.random.default_rng(SEED), n_resamples)
    return Analysis(study, records, setups, agreements, _mixed(setups, score))


def _setup(
    setup: Setup, records: list[Record], rng: np.random.Generator, n_resamples: int
) -> SetupResult:
    finished = [r for r in records if verdicts.is_finished(r, setup.measure)]
    steps = _common_steps([r.curve(setup.measure)[0] for r in finished])
    groups = {}
    for cell in setup.cells:
        for arm in setup.arms:
            own = [r for r in finished if (r.run.cell, r.run.arm) == (cell, arm)]
            if own:
                counts = statistics.resample(rng, len(own), n_resamples)
                groups[cell, arm] = _group(cell, arm, own, setup.measure, steps, counts)
    configs = [record.config for record in records if record.config]
    paper = published.find(configs[0]) if configs else None
    return SetupResult(setup, steps, groups, {}, paper, records)


def _common_steps(curves: list[Array]) -> Array:
    """Steps at which all runs have a rate, evenly spaced."""
    if not curves:
        return np.empty(0)
    first, last = max(steps[0] for steps in curves), min(steps[-1] for steps in curves)
    points = min(MOST_POINTS, max(len(steps) for steps in curves))
    return np.linspace(first, last, points) if last > first else np.array([last])


def _group(
    cell: str, arm: str, records: list[Record], measure: str, steps: Array, counts: Array
) -> Group:
    raw = [record.curve(measure) for record in records]
    curves = np.array([np.interp(steps, *one) for one in raw])
    reached = [verdicts.scores(record, measure) for record in records]
    scores = {name: np.array([one[name] for one in reached]) for name in SCORES}
    for threshold in THRESHOLDS:
        scores[f"steps to {threshold:g}"] = np.array(
            [statistics.steps_to_threshold(s, rates[None], threshold)[0] for s, rates in raw]
        )
    seeds = [record.run.seed for record in records]
    aggregated = statistics.sample_efficiency(curves, "iqm", counts)
    return Group(cell, arm, seeds, curves, *aggregated, scores, counts)


def _comparisons(
    study: Study, one: SetupResult, records: list[Record], n_resamples: int
) -> dict[str, Comparison]:
    found = {}
    for cell, verdict in verdicts.judge(study, one.setup, records, n_resamples).items():
        if any((cell, arm) not in one.groups for arm in one.setup.arms[:2]):
            continue
        treatment, control = pair(one, cell)
        secondary = {
            score: verdicts.in_pairs(treatment.by_seed(score), control.by_seed(score), n_resamples)
            for score in SCORES
            if score != study.primary.score
        }
        room = verdicts.headroom(study, one.setup, cell, records, n_resamples)
        a, b = (group.scores["converged"] for group in (treatment, control))
        bounds = [group.estimate("iqm", "converged")[1:] for group in (treatment, control)]
        drawn = treatment.counts, control.counts
        found[cell] = Comparison(
            verdict, secondary, room,
            statistics.difference(a, b, "iqm", drawn),
            statistics.interval_overlap(bounds[0], bounds[1]),
            statistics.probability_of_improvement(a, b, drawn),
        )  # fmt: skip
    return found


def pair(one: SetupResult, cell: str) -> tuple[Group, Group]:
    """Treatment and control of a cell that has both."""
    treatment, control = one.setup.arms[:2]
    return one.groups[cell, treatment], one.groups[cell, control]


def _agreements(
    setups: list[SetupResult], score: str, rng: np.random.Generator, n_resamples: int
) -> list[Agreement]:
    """Order of the cells, by the treatment alone and by its difference to the control."""
    compared = [one for one in setups if len(one.comparisons) > 1]
    cells = list(compared[0].comparisons) if compared else []
    compared = [one for one in compared if list(one.comparisons) == cells]
    if len(compared) < 2 or len(cells) < 3:
        return []
    found = []
    for by in ("treatment", "difference to the control"):
        runs = [[_ordered_by(by, one, cell, score) for cell in cells] for one in compared]
        if not all(len(each) for row in runs for each in row):
            continue
        values = np.array([[each.mean() for each in row] for row in runs])
        drawn = np.array(
            [
                [
                    statistics.bootstrap(x, "mean", statistics.resample(rng, len(x), n_resamples))
                    for x in row
                ]
                for row in runs
            ]
        )
        names = [one.setup.name for one in compared]
        found.append(Agreement(by, names, statistics.rank_agreement(values, drawn)))
    return found


def _ordered_by(by: str, one: SetupResult, cell: str, score: str) -> Array:
    if by == "treatment":
        return pair(one, cell)[0].scores[score]
    pairs = one.comparisons[cell].verdict.pairs
    return pairs.treatment - pairs.control


def factors(config: dict[str, Any]) -> tuple[str, str, str]:
    """(hand, simulator, algorithm) of a run's config.json; the environment where it has no hand."""
    scene = config.get("scene") or {}
    return config["run"]["env"], scene.get("simulator", "none"), config["run"]["algo"]


def _mixed(setups: list[SetupResult], by: str) -> list[Term] | str:
    compared = [one for one in setups if one.comparisons]
    kinds = {}
    for one in compared:
        kinds[one.setup.name] = next(factors(r.config) for r in one.records if r.config)
    levels = [len({kind[axis] for kind in kinds.values()}) for axis in range(3)]
    if len(set(kinds.values())) < 2 or math.prod(levels) != len(set(kinds.values())):
        return (
            "no mixed model: the set-ups do not cross their hands, simulators and algorithms, "
            "so the effect of one cannot be told from that of another"
        )
    rows = [
        (score, group.arm == one.setup.arms[0], *kinds[one.setup.name], one.setup.name + cell)
        for one in compared
        for cell in one.comparisons
        for group in pair(one, cell)
        for score in group.scores[by]
    ]
    scores, treated, hands, simulators, algorithms, cells = zip(*rows, strict=True)
    axes = {"hand": hands, "simulator": simulators, "algorithm": algorithms}
    try:
        return statistics.mixed_model(np.array(scores), np.array(treated), axes, cells)
    except ValueError as error:
        return str(error)
