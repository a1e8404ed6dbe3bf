"""Which taxels of a dense skin? Forward selection: one after another, the one that tells most
beyond the joints and those already chosen.

How much a taxel would tell is Rao's score test of a logistic regression: a second-order
estimate of the gain in likelihood, for all candidates at once, from one fit without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from ..envs.hands import Array
from . import metrics
from .analysis import JOINTS, Inputs, Probe, hold_question
from .estimators import Kind

# C of the regression from which candidates are judged, of standardised features. Weak: a penalty
# pulls at the weights of what is chosen, so that copies of it would seem to tell something.
PENALTY = 100.0
REDUNDANT = 1e-6  # share of a candidate's variance that the others leave unexplained
CURVE = (1, 2, 3, 5, 7, 10, 14, 19, 28, 40, 56, 79, 110, 160)  # taxels at which the gain is scored


def worth(known: Array, candidates: Array, held: Array) -> Array:
    """What each candidate (n, m) would tell of `held` (n,) alone, beyond `known` (n, d): bits a
    grasp (m,), less what a taxel of noise would seem to tell."""
    with threadpool_limits(1):  # as everywhere here: the digits do not depend on the cores
        score = _scores(StandardScaler().fit_transform(known), candidates.astype(float), held)
    return np.maximum(score - 1.0, 0.0) / (2.0 * len(held) * math.log(2.0))


def forward(known: Array, candidates: Array, held: Array, n: int) -> list[int]:
    """Indices of up to `n` candidates (n, m), in the order in which they were chosen; fewer when
    the others tell nothing new. Of candidates that are alike one is chosen at most."""
    features, pool = StandardScaler().fit_transform(known), candidates.astype(float)
    chosen: list[int] = []
    is_free = np.ones(candidates.shape[1], bool)
    for _ in range(min(n, candidates.shape[1])):
        score = np.where(is_free, _scores(features, pool, held), 0.0)
        best = int(np.argmax(score))
        if not score[best] > 0.0:
            break
        chosen.append(best)
        column = pool[:, best]
        is_free &= (pool != column[:, None]).any(axis=0)
        features = np.column_stack([features, (column - column.mean()) / column.std()])
    return chosen


def _scores(features: Array, candidates: Array, held: Array) -> Array:
    """Score statistics (m,): chi-squared with one degree of freedom where a candidate tells
    nothing; 0 where it is a copy of what there is."""
    model = LogisticRegression(C=PENALTY, tol=1e-3, max_iter=1000).fit(features, held)
    probability = model.predict_proba(features)[:, 1]
    weight = probability * (1.0 - probability)
    design = np.column_stack([np.ones(len(held)), features])
    shrinkage = np.diag([0.0, *np.full(features.shape[1], 1.0 / PENALTY)])
    information = design.T @ (weight[:, None] * design) + shrinkage
    crossed = (weight[:, None] * design).T @ candidates
    explained = np.einsum("ij,ij->j", crossed, np.linalg.solve(information, crossed))
    total = weight @ np.square(candidates)
    left = total - explained
    slope = (held - probability) @ candidates
    is_new = left > REDUNDANT * np.maximum(total, 1e-12)
    return np.where(is_new, np.square(slope) / np.where(is_new, left, 1.0), 0.0)


def select(probe: Probe, skin: Array, numbers: Sequence[int]) -> tuple[list[int], dict[str, Any]]:
    """The taxels of `skin` (n, m) chosen from all grasps, in order, and an honest curve.

    In the curve each grasp is predicted from taxels that were chosen without it, at `numbers`, at
    those of `CURVE` below and at the number of each layout; by the angles with the last of the
    noises. The probe's layouts are scored in the same folds.
    """
    noise, jobs = probe.choices.joint_noise[-1], probe.choices.jobs
    known = probe.features(Inputs(noise, JOINTS))
    held, kept, most = probe.grasps.held, probe.folds(), max(numbers)
    sizes = {name: readings.shape[1] for name, readings in probe.readings.items()}
    points = sorted({k for k in (*numbers, *CURVE, *sizes.values()) if k <= min(most, skin.shape[1])})
    with threadpool_limits(1):
        *paths, final = Parallel(jobs, prefer="threads")(
            delayed(forward)(known[train], skin[train], held[train], most)
            for train in (*(train for train, _ in kept), np.arange(len(held)))
        )
        every = probe.weights()
        tried: dict[Any, list[Array]] = {(JOINTS,): [known] * len(kept)}
        tried |= {("layout", name): [_with(known, r)] * len(kept) for name, r in probe.readings.items()}
        tried |= {("best", k): [_with(known, skin[:, p[:k]]) for p in paths] for k in points}
        scored = Parallel(jobs, prefer="threads")(
            delayed(_score)(features, held, kept, probe.choices.estimator, every)
            for features in tried.values()
        )
    auc = dict(zip(tried, scored, strict=True))
    gains = {key: value - auc[(JOINTS,)] for key, value in auc.items()}
    return final, {"joint_noise": noise, **_curve(gains, points, sizes)}


def _with(known: Array, readings: Array) -> Array:
    return np.column_stack([known, readings.astype(float)])


def _score(features: list[Array], held: Array, kept: list[Any], kind: Kind, weights: Array) -> Array:
    """AUC (b,) of predictions in which each fold has features (n, d) of its own."""
    predicted = np.full((len(held), 2), np.nan)
    for own, fold in zip(features, kept, strict=True):
        found = hold_question(held, [fold], kind).predict(own)
        predicted[fold[1]] = found[fold[1]]
    return metrics.AUC(held, predicted, weights)


def _curve(gains: dict[Any, Array], points: list[int], sizes: dict[str, int]) -> dict[str, Any]:
    curve = [{"taxels": k, **metrics.gain(gains["best", k])} for k in points]
    against = []
    for name, size in sizes.items():
        row = {"layout": name, "taxels": size, **metrics.gain(gains["layout", name])}
        if size in points:  # how far the layout is behind the best of the same number
            lead = gains["best", size] - gains["layout", name]
            row |= {"lead": float(lead[0]), "lead_interval": metrics.interval(lead[1:])}
        against.append(row)
    return {"curve": curve, "layouts": against}
