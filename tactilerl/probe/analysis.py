"""What each layout tells: predictions in the same folds, gains with intervals, checks.

A gain is what a layout's readings add to a control that knows all but them. Grasps are resampled
together for all layouts, so intervals are of paired differences.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from .. import statistics
from ..envs.hands import Array
from . import estimators, metrics
from .metrics import Metric
from .options import AnalysisFlags
from .readings import Grasps, noisy_angles

JOINTS, SIGHT = "joints", "joints+sight"
TAXELS, BOTH, ALONE = "joints+taxels", "joints+taxels+sight", "taxels"
CONTROL = {TAXELS: JOINTS, BOTH: SIGHT, SIGHT: JOINTS}
SHARES = (1 / 8, 1 / 4, 1 / 2)  # of the grasps, for the learning curve
NOISE, FAULTS, BOOTSTRAP, SHUFFLE = range(4)  # each has random numbers of its own


@dataclass(frozen=True)
class Choices(AnalysisFlags):
    """How grasps are asked."""

    seed: int = 0
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
    of_the_blind: bool = False
    """Who sees the object is not asked."""


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


@dataclass(frozen=True)
class Probe:
    """Grasps, and what is felt in them."""

    grasps: Grasps
    readings: Mapping[str, Array]
    """By layout, bool (n, taxels)."""
    choices: Choices

    def first(self, n: int) -> Probe:
        """The first `n` grasps."""
        readings = {name: felt[:n] for name, felt in self.readings.items()}
        return Probe(self.grasps.first(n), readings, self.choices)

    @property
    def densest(self) -> str:
        """The layout with the most taxels."""
        return max(self.readings, key=lambda name: self.readings[name].shape[1])

    def features(self, inputs: Inputs) -> Array:
        """(n, d)"""
        known, rng = inputs.what.split("+"), np.random.default_rng([self.choices.seed, NOISE])
        parts = [noisy_angles(self.grasps.angles, inputs.noise, rng)] if "joints" in known else []
        parts += [self.readings[str(inputs.layout)].astype(float)] if "taxels" in known else []
        parts += [self.grasps.sight()] if "sight" in known else []
        return np.concatenate(parts, axis=1)

    def folds(self, held: Array | None = None) -> list[estimators.Fold]:
        """The folds that everybody is asked in."""
        groups = self.grasps.objects if self.choices.hold_out == "objects" else None
        outcome = self.grasps.held if held is None else held
        return estimators.folds(outcome, self.choices.folds, groups, self.choices.seed)

    def weights(self) -> Array:
        """How often each grasp is in all of them (1, n), and in each bootstrap sample below."""
        n, rng = len(self.grasps), np.random.default_rng([self.choices.seed, BOOTSTRAP])
        drawn = np.ascontiguousarray(statistics.resample(rng, n, self.choices.resamples).T)
        return np.concatenate([np.ones((1, n), drawn.dtype), drawn])

    def answers(
        self, asked: Sequence[Question], inputs: Sequence[Inputs], weights: Array | None = None
    ) -> Samples:
        """All measures of all answers; every one in the same bootstrap samples, or by `weights`."""
        predicted = ask(asked, inputs, self.features, self.choices.jobs)
        every = self.weights() if weights is None else weights
        known = {question.name: question for question in asked}
        pairs = [(cell, metric) for cell in predicted for metric in known[cell.question].metrics]
        with threadpool_limits(1):
            values = Parallel(self.choices.jobs, prefer="threads")(
                delayed(metric)(known[cell.question].truth, predicted[cell], every)
                for cell, metric in pairs
            )
        return dict(zip(pairs, values, strict=True))


def hold_question(held: Array, kept: list[estimators.Fold], kind: estimators.Kind) -> Question:
    """Will it hold?"""
    measures = (metrics.AUC, metrics.BITS, metrics.LOG_LOSS)
    predict = partial(estimators.probabilities, held=held, kept=kept, kind=kind)
    return Question("hold", measures, held, predict)


def questions(probe: Probe) -> list[Question]:
    """All that can be asked of these grasps."""
    grasps, kept = probe.grasps, probe.folds()
    how: dict[str, Any] = {"kept": kept, "kind": probe.choices.estimator}
    place, index = grasps.object_in_hand()[0][:, :2], grasps.objects
    asked = [hold_question(grasps.held, **how)]
    measures = (metrics.R_SQUARED, metrics.ERROR_MM)
    predict = partial(estimators.values, targets=place, **how)
    asked.append(Question("position", measures, place, predict, of_the_blind=True))
    if probe.choices.hold_out == "grasps" and len(grasps.object_names) > 1:
        predict = partial(estimators.classes, labels=index, **how)
        asked.append(Question("object", (metrics.BALANCED_ACCURACY,), index, predict))
    yaw, parts = grasps.turn()
    if parts:
        truth = np.column_stack([yaw, np.full(len(yaw), 2 * math.pi / parts)])
        predict = partial(_turns, yaw=yaw, parts=parts, **how)
        asked.append(Question("yaw", (metrics.ERROR_DEGREES,), truth, predict, of_the_blind=True))
    return asked


def _turns(features: Array, yaw: Array, parts: int, **how: Any) -> Array:
    """Predicted yaw (n, 1), through the point on the circle where equal looks coincide."""
    circle = np.column_stack([np.cos(parts * yaw), np.sin(parts * yaw)])
    found = estimators.values(features, circle, **how)
    return np.arctan2(found[:, 1], found[:, 0])[:, None] / parts


def all_inputs(layouts: Sequence[str], noises: Sequence[float]) -> list[Inputs]:
    """All that are compared. Joint noise does not matter to taxels alone."""
    inputs = [Inputs(noises[0], ALONE, layout) for layout in layouts]
    for noise in noises:
        inputs += [Inputs(noise, JOINTS), Inputs(noise, SIGHT)]
        inputs += [Inputs(noise, what, layout) for what in (TAXELS, BOTH) for layout in layouts]
    return inputs


def ask(
    asked: Sequence[Question],
    inputs: Sequence[Inputs],
    features: Callable[[Inputs], Array],
    jobs: int,
) -> dict[Cell, Array]:
    """All predictions. In processes, for the solvers are Python half of the time."""
    every = itertools.product(asked, inputs)
    pairs = [(q, t) for q, t in every if not (q.of_the_blind and "sight" in t.what)]
    predictions = Parallel(jobs, prefer="processes")(
        delayed(_predictions)(q, features(t)) for q, t in pairs
    )
    return {Cell(q.name, t): p for (q, t), p in zip(pairs, predictions, strict=True)}


def _predictions(question: Question, features: Array) -> Array:
    """With one thread, in whichever process: the digits must not depend on the number of cores.
    Nor does a process know which warnings another one leaves unsaid."""
    with threadpool_limits(1), estimators.expected_warnings():
        return question.predict(features)


def gain_samples(samples: Samples, cell: Cell, metric: Metric) -> Array | None:
    """What `cell` knows beyond its control: better is above 0; None without a control."""
    inputs = cell.inputs
    if inputs.what not in CONTROL:
        return None
    control = Cell(cell.question, Inputs(inputs.noise, CONTROL[inputs.what]))
    return metric.sign * (samples[cell, metric] - samples[control, metric])


def hold_gain(samples: Samples, noise: float, layout: str, question: str = "hold") -> Array:
    """Gain in AUC (1 + resamples,) of a layout over the joints."""
    inputs = Inputs(noise, TAXELS, layout)
    gain = gain_samples(samples, Cell(question, inputs), metrics.AUC)
    assert gain is not None
    return gain


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
            row |= metrics.gain(gain)
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
    noises = dict.fromkeys(cell.inputs.noise for cell, _ in cells)
    for (question, metric), noise in itertools.product(first.items(), noises):
        family: list[dict[str, Any]] = []
        for a, b in itertools.combinations(layouts, 2):
            one, other = (samples[Cell(question, Inputs(noise, TAXELS, x)), metric] for x in (a, b))
            way = metric.sign * (one - other)
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


def learning_curve(probe: Probe, samples: Samples) -> list[dict[str, Any]]:
    """Gain in AUC from the first part of the grasps, up to all of them, which are measured in
    `samples`: were there enough?"""
    rows, choices, n_all = [], probe.choices, len(probe.grasps)
    for n in (*sorted({round(share * n_all) for share in SHARES}), n_all):
        some, measured = probe.first(n), samples
        if n < n_all:
            try:
                kept = some.folds()
            except ValueError:  # too few of one outcome for the folds
                continue
            asked = [hold_question(some.grasps.held, kept, choices.estimator)]
            inputs = [t for t in all_inputs([*probe.readings], choices.joint_noise)
                      if t.what in (JOINTS, TAXELS)]  # fmt: skip
            measured = some.answers(asked, inputs)
        for noise, layout in itertools.product(choices.joint_noise, probe.readings):
            gain = metrics.gain(hold_gain(measured, noise, layout))
            rows.append({"grasps": n, "joint_noise": noise, "layout": layout, **gain})
    return rows


def shuffled_gain(probe: Probe) -> dict[str, Any]:
    """The check: with outcomes dealt out at random there is nothing to tell, and the gain of the
    densest layout should be 0. Its mean over shuffles, and where 95 % of single ones are to be
    expected."""
    from scipy import stats

    rng = np.random.default_rng([probe.choices.seed, SHUFFLE])
    noise, layout, shuffles = probe.choices.joint_noise[0], probe.densest, probe.choices.shuffles
    asked = []
    for number in range(shuffles):
        held = rng.permutation(probe.grasps.held)
        question = hold_question(held, probe.folds(held), probe.choices.estimator)
        asked.append(replace(question, name=f"shuffled {number}", metrics=(metrics.AUC,)))
    inputs = [Inputs(noise, JOINTS), Inputs(noise, TAXELS, layout)]
    samples = probe.answers(asked, inputs, np.ones((1, len(probe.grasps)), np.uint8))
    gains = [float(hold_gain(samples, noise, layout, question.name)[0]) for question in asked]
    mean, spread = float(np.mean(gains)), float(np.std(gains, ddof=1))
    width = float(stats.t.ppf(0.975, shuffles - 1)) * spread * math.sqrt(1 + 1 / shuffles)
    return {
        "layout": layout, "joint_noise": noise, "shuffles": shuffles, "gain": mean,
        "interval": [mean - width, mean + width], "is_zero": mean - width <= 0 <= mean + width,
    }  # fmt: skip
