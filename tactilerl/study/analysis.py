"""From records to numbers: every group of runs, every comparison, every set-up of a study."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import published, statistics
from .grid import Setup, Study
from .published import Published
from .records import Record
from .statistics import Array, Estimate, Metric, Term

SEED = 20_210_830  # of all resampling: the same records give the same report
MOST_POINTS = 500  # of a curve
SCORES = {
    "converged": "converged rate",
    "final": "final rate (mean of the last tenth)",
    "area": "area under the curve",
}
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

    def estimate(self, metric: Metric, score: str = "converged") -> Estimate:
        """An aggregate with its percentile interval."""
        return statistics.estimate(self.scores[score], metric, self.counts)

    def __len__(self) -> int:
        return len(self.seeds)


@dataclass(frozen=True)
class Comparison:
    """Treatment against control in one cell, by converged rate."""

    cell: str
    difference: Estimate
    """Of IQMs."""
    overlap: float
    improvement: Estimate
    p_value: float
    within: Estimate
    """Mean difference between runs of the same seed, of those that both arms have."""
    p_within: float
    p_holm: float = math.nan


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
        setups.append(_setup(setup, own, np.random.default_rng([SEED, index]), n_resamples))
    return Analysis(study, records, setups, _agreements(setups), _mixed(setups))


def _setup(
    setup: Setup, records: list[Record], rng: np.random.Generator, n_resamples: int
) -> SetupResult:
    finished = [r for r in records if r.state == "done" and len(r.curve(setup.measure)[0])]
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
    comparisons = _comparisons(setup, groups, rng, n_resamples)
    return SetupResult(setup, steps, groups, comparisons, paper, records)


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
    scores = {
        "converged": np.array([statistics.converged_rate(rates[None])[0] for _, rates in raw]),
        "final": np.array([statistics.final_rate(rates[None])[0] for _, rates in raw]),
        "area": statistics.area_under_curve(steps, curves),
    }
    for threshold in THRESHOLDS:
        scores[f"steps to {threshold:g}"] = np.array(
            [statistics.steps_to_threshold(s, rates[None], threshold)[0] for s, rates in raw]
        )
    seeds = [record.run.seed for record in records]
    aggregated = statistics.sample_efficiency(curves, "iqm", counts)
    return Group(cell, arm, seeds, curves, *aggregated, scores, counts)


def _comparisons(
    setup: Setup, groups: dict[tuple[str, str], Group], rng: np.random.Generator, n_resamples: int
) -> dict[str, Comparison]:
    if setup.compare is None:
        return {}
    found = {}
    for cell in setup.cells:
        treatment, control = (groups.get((cell, arm)) for arm in setup.arms[:2])
        if treatment is None or control is None:
            continue
        a, b = treatment.scores["converged"], control.scores["converged"]
        drawn = treatment.counts, control.counts
        found[cell] = Comparison(
            cell,
            statistics.difference(a, b, "iqm", drawn),
            statistics.interval_overlap(treatment.estimate("iqm")[1:], control.estimate("iqm")[1:]),
            statistics.probability_of_improvement(a, b, drawn),
            statistics.permutation_p(a, b, "iqm", rng, n_resamples),
            *_within_seeds(treatment, control, rng, n_resamples),
        )
    corrected = statistics.holm([one.p_value for one in found.values()])
    return {
        cell: replace(one, p_holm=float(p))
        for (cell, one), p in zip(found.items(), corrected, strict=True)
    }


def _within_seeds(
    treatment: Group, control: Group, rng: np.random.Generator, n_resamples: int
) -> tuple[Estimate, float]:
    """The mean difference between runs of the same seed, and its p-value; NaN without such runs."""
    shared = sorted(set(treatment.seeds) & set(control.seeds))
    if not shared:
        return Estimate(math.nan, math.nan, math.nan), math.nan
    a, b = (
        np.array([group.scores["converged"][group.seeds.index(seed)] for seed in shared])
        for group in (treatment, control)
    )
    counts = statistics.resample(rng, len(shared), n_resamples)
    p_value = statistics.permutation_p(a, b, "mean", rng, n_resamples, paired=True)
    return statistics.estimate(a - b, "mean", counts), p_value


def _agreements(setups: list[SetupResult]) -> list[Agreement]:
    """Order of the cells, by the treatment alone and by its difference to the control."""
    compared = [one for one in setups if len(one.comparisons) > 1]
    cells = list(compared[0].comparisons) if compared else []
    compared = [one for one in compared if list(one.comparisons) == cells]
    if len(compared) < 2 or len(cells) < 3:
        return []
    found = []
    for by in ("treatment", "difference to the control"):
        drawn = np.array([[_resampled(one, cell, by) for cell in cells] for one in compared])
        values = np.array([[_value(one, cell, by) for cell in cells] for one in compared])
        names = [one.setup.name for one in compared]
        found.append(Agreement(by, names, statistics.rank_agreement(values, drawn)))
    return found


def pair(one: SetupResult, cell: str) -> tuple[Group, Group]:
    """Treatment and control of a cell that has both."""
    treatment, control = one.setup.arms[:2]
    return one.groups[cell, treatment], one.groups[cell, control]


def _value(one: SetupResult, cell: str, by: str) -> float:
    treatment, control = (group.estimate("iqm").value for group in pair(one, cell))
    return treatment if by == "treatment" else treatment - control


def _resampled(one: SetupResult, cell: str, by: str) -> Array:
    treatment, control = (
        statistics.bootstrap(group.scores["converged"], "iqm", group.counts)
        for group in pair(one, cell)
    )
    return treatment if by == "treatment" else treatment - control


def factors(config: dict[str, Any]) -> tuple[str, str, str]:
    """(hand, simulator, algorithm) of a run's config.json; the environment where it has no hand."""
    scene = config.get("scene") or {}
    return config["run"]["env"], scene.get("simulator", "none"), config["run"]["algo"]


def _mixed(setups: list[SetupResult]) -> list[Term] | str:
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
        for score in group.scores["converged"]
    ]
    scores, treated, hands, simulators, algorithms, cells = zip(*rows, strict=True)
    axes = {"hand": hands, "simulator": simulators, "algorithm": algorithms}
    try:
        return statistics.mixed_model(np.array(scores), np.array(treated), axes, cells)
    except ValueError as error:
        return str(error)
