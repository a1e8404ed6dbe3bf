"""What each layout tells: predictions in the same folds, gains with intervals, checks.

A gain is what a layout's readings add to a control that knows all but them. Grasps are resampled
together for all layouts, so intervals are of paired differences.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from .. import statistics
from ..envs.hands import Array
from . import estimators, metrics
from .metrics import Metric
from .readings import Grasps, noisy_angles

JOINTS, SIGHT = "joints", "joints+sight"
TAXELS, BOTH, ALONE = "joints+taxels", "joints+taxels+sight", "taxels"
CONTROL = {TAXELS: JOINTS, BOTH: SIGHT, SIGHT: JOINTS}
SHARES = (1 / 8, 1 / 4, 1 / 2)  # of the grasps, for the learning curve
NOISE, FAULTS, BOOTSTRAP, SHUFFLE = range(4)  # each has random numbers of its own


@dataclass(frozen=True)
class Choices:
    """How grasps are asked."""

    seed: int = 0
    folds: int = 5
    estimator: estimators.Kind = "linear"
    joint_noise: tuple[float, ...] = (0.0, 0.05)
    resamples: int = 2_000
    shuffles: int = 10
    by_object: bool = False
    """No object is in the training folds and in the one held back."""
    jobs: int = 1


@dataclass(frozen=True)
class Question:
    """Something to tell, and how good an answer is."""

    name: str
    metrics: tuple[Metric, ...]
    """The first is the one by which layouts are compared."""
    truth: Array
    predict: Callable[[Array], Array]
    """From features (n, d) to predictions of grasps that were held back."""
    is_asked: Callable[[str], bool] = lambda inputs: True
    """Of those who are given these inputs?"""


class Inputs(NamedTuple):
    """What a classifier is given."""

    noise: float
    """Of the joint angles, rad."""
    what: str
    layout: str | None = None


class Cell(NamedTuple):
    """One answer: to which question, and by whom."""

    question: str
    inputs: Inputs


Samples = Mapping[tuple[Cell, Metric], Array]
"""Values of a measure (1 + resamples,): of all grasps, then of each bootstrap sample."""


def kept_folds(grasps: Grasps, choices: Choices) -> list[estimators.Fold]:
    """The folds that everybody is asked in."""
    groups = grasps.objects if choices.by_object else None
    return estimators.folds(grasps.held, choices.folds, groups, choices.seed)


def hold_question(held: Array, kept: list[estimators.Fold], kind: estimators.Kind) -> Question:
    """Will it hold?"""
    measures = (metrics.AUC, metrics.BITS, metrics.LOG_LOSS)
    return Question("hold", measures, held, lambda x: estimators.probabilities(x, held, kept, kind))


def questions(grasps: Grasps, kept: list[estimators.Fold], choices: Choices) -> list[Question]:
    """All that can be asked of these grasps. Who sees the object is not asked where it is."""
    kind = choices.estimator
    place, _ = grasps.object_in_hand()
    place = place[:, :2]
    asked = [
        hold_question(grasps.held, kept, kind),
        Question(
            "position",
            (metrics.R_SQUARED, metrics.ERROR_MM),
            place,
            lambda x: estimators.values(x, place, kept, kind),
            _is_blind,
        ),
    ]
    if not choices.by_object and len(grasps.object_names) > 1:
        index = grasps.objects
        measures = (metrics.BALANCED_ACCURACY,)
        predict = lambda x: estimators.classes(x, index, kept, kind)  # noqa: E731
        asked.append(Question("object", measures, index, predict))
    yaw, parts = grasps.turn()
    if parts:
        truth = np.column_stack([yaw, np.full(len(yaw), 2 * math.pi / parts)])
        measures = (metrics.ERROR_DEGREES,)
        asked.append(
            Question("yaw", measures, truth, lambda x: _turns(x, yaw, parts, kept, kind), _is_blind)
        )
    return asked


def _is_blind(inputs: str) -> bool:
    return "sight" not in inputs


def _turns(
    features: Array, yaw: Array, parts: int, kept: list[estimators.Fold], kind: estimators.Kind
) -> Array:
    """Predicted yaw (n, 1), through the point on the circle where equal looks coincide."""
    circle = np.column_stack([np.cos(parts * yaw), np.sin(parts * yaw)])
    found = estimators.values(features, circle, kept, kind)
    return np.arctan2(found[:, 1], found[:, 0])[:, None] / parts


class FeatureBuilder:
    """Makes features (n, d) of what a classifier is given."""

    def __init__(self, grasps: Grasps, readings: Mapping[str, Array], seed: int) -> None:
        """`readings` by layout, bool (n, taxels)."""
        self._angles, self._sight = grasps.angles, grasps.sight()
        self._readings, self._seed = readings, seed

    def angles(self, noise: float) -> Array:
        """Joint angles with noise, rad."""
        return noisy_angles(self._angles, noise, np.random.default_rng([self._seed, NOISE]))

    def features(self, inputs: Inputs) -> Array:
        """(n, d)"""
        known = inputs.what.split("+")
        parts = [self.angles(inputs.noise)] if "joints" in known else []
        parts += [self._readings[str(inputs.layout)].astype(float)] if "taxels" in known else []
        parts += [self._sight] if "sight" in known else []
        return np.concatenate(parts, axis=1)


def all_inputs(layouts: Sequence[str], noises: Sequence[float]) -> list[Inputs]:
    """All that are compared. Joint noise does not matter to taxels alone."""
    inputs = [Inputs(noises[0], ALONE, layout) for layout in layouts]
    for noise in noises:
        inputs += [Inputs(noise, JOINTS), Inputs(noise, SIGHT)]
        inputs += [Inputs(noise, what, layout) for what in (TAXELS, BOTH) for layout in layouts]
    return inputs


def ask(
    asked: Sequence[Question], inputs: Sequence[Inputs], builder: FeatureBuilder, jobs: int
) -> dict[Cell, Array]:
    """All predictions. In processes, for the solvers are Python half of the time."""
    pairs = [(q, t) for q, t in itertools.product(asked, inputs) if q.is_asked(t.what)]
    predictions = Parallel(jobs, prefer="processes")(
        delayed(_predictions)(q, builder.features(t)) for q, t in pairs
    )
    return {Cell(q.name, t): p for (q, t), p in zip(pairs, predictions, strict=True)}


def _predictions(question: Question, features: Array) -> Array:
    """With one thread, in whichever process: the digits must not depend on the number of cores.
    Nor does a process know which warnings another one leaves unsaid."""
    with threadpool_limits(1), estimators.expected_warnings():
        return question.predict(features)


def measured(
    asked: Sequence[Question], predicted: dict[Cell, Array], weights: Array, jobs: int
) -> Samples:
    """All measures of all predictions; every one in the same bootstrap samples."""
    every = np.concatenate([np.ones((1, weights.shape[1]), weights.dtype), weights])
    truth = {question.name: question.truth for question in asked}
    measures = {question.name: question.metrics for question in asked}
    pairs = [(cell, metric) for cell in predicted for metric in measures[cell.question]]
    with threadpool_limits(1):
        values = Parallel(jobs, prefer="threads")(
            delayed(metric)(truth[cell.question], predicted[cell], every) for cell, metric in pairs
        )
    return dict(zip(pairs, values, strict=True))


def bootstrap(n: int, choices: Choices) -> Array:
    """The samples of `n` grasps in which everything is measured."""
    rng = np.random.default_rng([choices.seed, BOOTSTRAP])
    return np.ascontiguousarray(statistics.resample(rng, n, choices.resamples).T)


def gain_samples(samples: Samples, cell: Cell, metric: Metric) -> Array | None:
    """What `cell` knows beyond its control: better is above 0; None without a control."""
    inputs = cell.inputs
    if inputs.what not in CONTROL:
        return None
    control = Cell(cell.question, Inputs(inputs.noise, CONTROL[inputs.what]))
    return _sign(metric) * (samples[cell, metric] - samples[control, metric])


def _sign(metric: Metric) -> int:
    return 1 if metric.higher_is_better else -1


def table(samples: Samples) -> list[dict[str, Any]]:
    """A row for each measure of each answer, with its gain over its control."""
    rows = []
    for (cell, metric), values in samples.items():
        row = {
            "question": cell.question,
            "metric": metric.name,
            "joint_noise": cell.inputs.noise,
            "told": cell.inputs.what,
            "layout": cell.inputs.layout,
            "value": metrics.number(values[0]),
            "interval": metrics.interval(values[1:]),
        }
        gain = gain_samples(samples, cell, metric)
        if gain is not None:
            row |= {"gain": metrics.number(gain[0]), "gain_interval": metrics.interval(gain[1:])}
        rows.append(row)
    return rows


def differences(samples: Samples, layouts: Sequence[str]) -> list[dict[str, Any]]:
    """Every two layouts, given with the joints, by each question's first measure; p-values of one
    question at one noise are corrected together (Holm)."""
    rows = []
    cells = [(cell, metric) for cell, metric in samples if cell.inputs.what == TAXELS]
    first: dict[str, Metric] = {}
    for cell, metric in cells:
        first.setdefault(cell.question, metric)
    noises = list(dict.fromkeys(cell.inputs.noise for cell, _ in cells))
    for (question, metric), noise in itertools.product(first.items(), noises):
        family: list[dict[str, Any]] = []
        for a, b in itertools.combinations(layouts, 2):
            one, other = (samples[Cell(question, Inputs(noise, TAXELS, x)), metric] for x in (a, b))
            way = _sign(metric) * (one - other)
            family.append(
                {
                    "question": question, "metric": metric.name, "joint_noise": noise,
                    "a": a, "b": b, "difference": metrics.number(way[0]),
                    "interval": metrics.interval(way[1:]), "p": statistics.bootstrap_p(way[1:]),
                }
            )  # fmt: skip
        for row, p in zip(family, statistics.holm([row["p"] for row in family]), strict=True):
            rows.append({**row, "p_holm": float(p)})
    return rows


def hold_gains(
    grasps: Grasps, readings: Mapping[str, Array], choices: Choices
) -> dict[tuple[float, str], Array]:
    """Gain in AUC (1 + resamples,) of each layout over the joints, by (noise, layout)."""
    asked = [hold_question(grasps.held, kept_folds(grasps, choices), choices.estimator)]
    inputs = [Inputs(noise, JOINTS) for noise in choices.joint_noise]
    inputs += [Inputs(noise, TAXELS, name) for noise in choices.joint_noise for name in readings]
    predicted = ask(asked, inputs, FeatureBuilder(grasps, readings, choices.seed), choices.jobs)
    samples = measured(asked, predicted, bootstrap(len(grasps), choices), choices.jobs)
    gains = {}
    for t in inputs:
        gain = gain_samples(samples, Cell("hold", t), metrics.AUC)
        if gain is not None:
            gains[t.noise, str(t.layout)] = gain
    return gains


def learning_curve(
    grasps: Grasps, readings: Mapping[str, Array], choices: Choices, samples: Samples
) -> list[dict[str, Any]]:
    """Gain in AUC from the first part of the grasps, up to all of them, which are measured in
    `samples`: were there enough?"""
    rows = []
    for n in sorted({round(share * len(grasps)) for share in SHARES}):
        some = grasps.first(n)
        try:
            gains = hold_gains(some, {k: felt[:n] for k, felt in readings.items()}, choices)
        except ValueError:  # too few of one outcome for the folds
            continue
        rows += [_point(n, *key, gain) for key, gain in gains.items()]
    for noise, layout in itertools.product(choices.joint_noise, readings):
        gain = gain_samples(samples, Cell("hold", Inputs(noise, TAXELS, layout)), metrics.AUC)
        assert gain is not None
        rows.append(_point(len(grasps), noise, layout, gain))
    return rows


def _point(n: int, noise: float, layout: str, gain: Array) -> dict[str, Any]:
    row = {"grasps": n, "joint_noise": noise, "layout": layout, "gain": float(gain[0])}
    return {**row, "gain_interval": metrics.interval(gain[1:])}


def shuffled_gain(grasps: Grasps, layout: str, readings: Array, choices: Choices) -> dict[str, Any]:
    """The check: with outcomes dealt out at random there is nothing to tell, and the gain of a
    layout should be 0. Its mean over shuffles, and where 95 % of single ones are to be expected."""
    from scipy import stats

    rng = np.random.default_rng([choices.seed, SHUFFLE])
    noise = choices.joint_noise[0]
    builder = FeatureBuilder(grasps, {layout: readings}, choices.seed)
    inputs = [Inputs(noise, JOINTS), Inputs(noise, TAXELS, layout)]
    gains, asked, shuffles = [], [], choices.shuffles
    for number in range(shuffles):
        held = rng.permutation(grasps.held)
        groups = grasps.objects if choices.by_object else None
        kept = estimators.folds(held, choices.folds, groups, choices.seed)
        question = hold_question(held, kept, choices.estimator)
        asked.append(Question(f"shuffled {number}", (metrics.AUC,), held, question.predict))
    predicted = ask(asked, inputs, builder, choices.jobs)
    samples = measured(asked, predicted, np.ones((0, len(grasps)), np.uint8), choices.jobs)
    for question in asked:
        gain = gain_samples(samples, Cell(question.name, inputs[1]), metrics.AUC)
        assert gain is not None
        gains.append(float(gain[0]))
    mean, spread = float(np.mean(gains)), float(np.std(gains, ddof=1))
    width = float(stats.t.ppf(0.975, shuffles - 1)) * spread * math.sqrt(1 + 1 / shuffles)
    return {
        "layout": layout, "joint_noise": noise, "shuffles": shuffles, "gain": mean,
        "interval": [mean - width, mean + width], "is_zero": mean - width <= 0 <= mean + width,
    }  # fmt: skip
