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
from ..envs.state import Array
from . import estimators, metrics
from .options import AnalysisFlags
from .readings import Grasps

JOINTS, SIGHT = "joints", "joints+sight"
TAXELS, BOTH, ALONE = "joints+taxels", "joints+taxels+sight", "taxels"
IDLE = 10  # s: processes without work end, also those of a probe that was killed
CONTROL = {TAXELS: JOINTS, BOTH: SIGHT, SIGHT: JOINTS}
NOISE, FAULTS, BOOTSTRAP, SHUFFLE = range(4)  # each has random numbers of its own


@dataclass(frozen=True)
class Question:
    """Something to tell, and how good an answer is."""

    name: str
    metrics: tuple[str, ...]
    """The first is the one by which layouts are compared."""
    truth: Array
    predict: Callable[[Array], Array]
    """From features (n, d) to predictions of grasps that were held back."""
    of_the_blind: bool = False
    """Who sees the object is not asked."""


Inputs = tuple[float, str, str | None]
"""What a classifier is given: noise of the joint angles, rad, what it is told, of which layout."""


class Cell(NamedTuple):
    """A measure of one answer: to which question, and by whom."""

    question: str
    metric: str
    joint_noise: float
    told: str
    layout: str | None = None


Samples = Mapping[Cell, Array]
"""Values of a measure (1 + resamples,): of all grasps, then of each bootstrap sample."""


@dataclass(frozen=True)
class Probe:
    """Grasps, and what is felt in them."""

    grasps: Grasps
    readings: Mapping[str, Array]
    """By layout, bool (n, taxels)."""
    choices: AnalysisFlags
    seed: int = 0
    jobs: int = 1

    @property
    def densest(self) -> str:
        """The layout with the most taxels."""
        return max(self.readings, key=lambda name: self.readings[name].shape[1])

    def features(self, noise: float, told: str, layout: str | None = None) -> Array:
        """(n, d). Joint angles have the same draws at any noise."""
        known, rng = told.split("+"), np.random.default_rng([self.seed, NOISE])
        angles, parts = self.grasps.angles, []
        if "joints" in known:
            parts.append(angles + noise * rng.standard_normal(angles.shape))
        if "taxels" in known:
            parts.append(self.readings[str(layout)].astype(float))
        if "sight" in known:
            parts.append(self.grasps.sight())
        return np.concatenate(parts, axis=1)

    def inputs(self) -> list[Inputs]:
        """All that are compared. Joint noise does not matter to taxels alone."""
        layouts, noises = [*self.readings], self.choices.joint_noise
        inputs: list[Inputs] = [(noises[0], ALONE, layout) for layout in layouts]
        for noise in noises:
            inputs += [(noise, JOINTS, None), (noise, SIGHT, None)]
            inputs += [
                (noise, told, layout) for told in (TAXELS, BOTH) for layout in layouts
            ]
        return inputs

    def folds(self, held: Array) -> list[estimators.Fold]:
        """The folds that everybody is asked in."""
        groups = (
            self.grasps.objects()[1] if self.choices.hold_out == "objects" else None
        )
        return estimators.folds(held, self.choices.folds, groups, self.seed)

    def weights(self) -> Array:
        """How often each grasp is in all of them (1, n), and in each bootstrap sample below."""
        n, rng = len(self.grasps), np.random.default_rng([self.seed, BOOTSTRAP])
        drawn = np.ascontiguousarray(
            statistics.resample(rng, n, self.choices.resamples).T
        )
        return np.concatenate([np.ones((1, n), drawn.dtype), drawn])

    def will_it_hold(self, held: Array) -> Question:
        """The question whose answer is `held` (n,)."""
        predict = partial(estimators.probabilities, targets=held, kept=self.folds(held))
        return Question("hold", ("auc", "bits", "log_loss"), held, predict)

    def questions(self) -> list[Question]:
        """All that can be asked of these grasps."""
        grasps, asked = self.grasps, [self.will_it_hold(self.grasps.held)]
        kept = self.folds(grasps.held)
        place, (names, index) = grasps.object_in_hand()[0][:, :2], grasps.objects()
        predict = partial(estimators.values, targets=place, kept=kept)
        asked.append(
            Question("position", ("r2", "error_mm"), place, predict, of_the_blind=True)
        )
        if self.choices.hold_out == "grasps" and len(names) > 1:
            predict = partial(estimators.classes, targets=index, kept=kept)
            asked.append(Question("object", ("balanced_accuracy",), index, predict))
        yaw, parts = grasps.turn()
        if parts:
            truth = np.column_stack([yaw, np.full(len(yaw), 2 * math.pi / parts)])
            circle = np.column_stack([np.cos(parts * yaw), np.sin(parts * yaw)])
            predict = partial(estimators.values, targets=circle, kept=kept)
            asked.append(
                Question("yaw", ("error_deg",), truth, predict, of_the_blind=True)
            )
        return asked

    def answers(
        self,
        asked: Sequence[Question],
        inputs: Sequence[Inputs],
        weights: Array | None = None,
    ) -> Samples:
        """All measures of all answers; every one in the same bootstrap samples, or by `weights`. In
        processes, for the solvers are Python half of the time."""
        every = self.weights() if weights is None else weights
        pairs = [
            (question, given)
            for question, given in itertools.product(asked, inputs)
            if not (question.of_the_blind and "sight" in given[1])
        ]
        found = Parallel(self.jobs, backend="loky", idle_worker_timeout=IDLE)(
            delayed(answer)(question, self.features(*given), every)
            for question, given in pairs
        )
        return {
            Cell(question.name, metric, *given): values
            for (question, given), measured in zip(pairs, found, strict=True)
            for metric, values in zip(question.metrics, measured, strict=True)
        }


def answer(question: Question, features: Array, weights: Array) -> list[Array]:
    """A question's measures by some features (n, d), with `weights` (b, n).

    With one thread, in whichever process: the digits must not depend on the number of cores. Nor
    does a process know which warnings another one leaves unsaid.
    """
    with threadpool_limits(1), estimators.expected_warnings():
        told = question.predict(features)
        return [
            metrics.measure(name, question.truth, told, weights)
            for name in question.metrics
        ]


def gain(samples: Samples, cell: Cell) -> Array:
    """What `cell` knows beyond its control: better is above 0."""
    control = cell._replace(told=CONTROL[cell.told], layout=None)
    return metrics.sign(cell.metric) * (samples[cell] - samples[control])


def hold_gain(
    samples: Samples, noise: float, layout: str, question: str = "hold"
) -> Array:
    """Gain in AUC (1 + resamples,) of a layout over the joints."""
    return gain(samples, Cell(question, "auc", noise, TAXELS, layout))


def table(samples: Samples) -> list[dict[str, Any]]:
    """A row for each measure of each answer, with its gain over its control."""
    rows = []
    for cell, values in samples.items():
        gained = metrics.gain(gain(samples, cell)) if cell.told in CONTROL else {}
        rows.append({**cell._asdict(), **metrics.estimate("value", values), **gained})
    return rows


def differences(
    probe: Probe, asked: list[Question], samples: Samples
) -> list[dict[str, Any]]:
    """Every two layouts, given with the joints, by each question's first measure; p-values of one
    question at one noise are corrected together (Holm)."""
    rows = []
    for question, noise in itertools.product(asked, probe.choices.joint_noise):
        name, metric = question.name, question.metrics[0]
        known = {
            x: samples[Cell(name, metric, noise, TAXELS, x)] for x in probe.readings
        }
        pairs = list(itertools.combinations(known, 2))
        ways = [metrics.sign(metric) * (known[a] - known[b]) for a, b in pairs]
        p_values = [statistics.bootstrap_p(way[1:]) for way in ways]
        corrected = statistics.holm(p_values).tolist()
        for (a, b), way, p, p_holm in zip(
            pairs, ways, p_values, corrected, strict=True
        ):
            about = {
                "question": name,
                "metric": metric,
                "joint_noise": noise,
                "a": a,
                "b": b,
            }
            told = metrics.estimate("difference", way)
            rows.append({**about, **told, "p": p, "p_holm": p_holm})
    return rows


def shuffled_gain(probe: Probe) -> dict[str, Any]:
    """The check: with outcomes dealt out at random there is nothing to tell, and the gain of the
    densest layout should be 0. Its mean over shuffles, and where 95 % of single ones are to be
    expected."""
    from scipy import stats

    rng = np.random.default_rng([probe.seed, SHUFFLE])
    noise, layout, shuffles = (
        probe.choices.joint_noise[0],
        probe.densest,
        probe.choices.shuffles,
    )
    asked = [
        replace(
            probe.will_it_hold(rng.permutation(probe.grasps.held)),
            name=str(k),
            metrics=("auc",),
        )
        for k in range(shuffles)
    ]
    inputs: list[Inputs] = [(noise, JOINTS, None), (noise, TAXELS, layout)]
    samples = probe.answers(asked, inputs, np.ones((1, len(probe.grasps)), np.uint8))
    gains = [
        float(hold_gain(samples, noise, layout, question.name)[0]) for question in asked
    ]
    mean, spread = float(np.mean(gains)), float(np.std(gains, ddof=1))
    width = (
        float(stats.t.ppf(0.975, shuffles - 1)) * spread * math.sqrt(1 + 1 / shuffles)
    )
    return {
        "layout": layout, "joint_noise": noise, "shuffles": shuffles, "gain": mean,
        "interval": [mean - width, mean + width], "is_zero": mean - width <= 0 <= mean + width,
    }  # fmt: skip
