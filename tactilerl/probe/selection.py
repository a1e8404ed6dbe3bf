"""Which taxels of a dense skin? Forward selection: one after another, the one that tells most
beyond the joints and those already chosen.

How much a taxel would tell is Rao's score test of a logistic regression: a second-order
estimate of the gain in likelihood, for all candidates at once, from one fit without them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from ..envs.state import Array
from . import estimators, metrics
from .analysis import JOINTS, Cell, Probe, Samples, hold_gain

# C of the regression from which candidates are judged, of standardised features. Weak: a penalty
# pulls at the weights of what is chosen, so that copies of it would seem to tell something.
PENALTY = 100.0
REDUNDANT = 1e-6  # share of a candidate's variance that the others leave unexplained
CURVE = (1, 2, 3, 5, 7, 10, 14, 19, 28, 40, 56, 79, 110, 160)  # taxels at which the gain is scored


def worth(probe: Probe) -> dict[str, Any]:
    """What each taxel of the densest layout would tell alone, beyond the angles with the last of the
    noises: bits a grasp, less what a taxel of noise would seem to tell."""
    noise, layout, held = probe.choices.joint_noise[-1], probe.densest, probe.grasps.held
    known = StandardScaler().fit_transform(probe.features(noise, JOINTS))
    with threadpool_limits(1):  # as everywhere here: the digits do not depend on the cores
        score = _scores(known, probe.readings[layout].astype(float), held)
    bits = np.maximum(score - 1.0, 0.0) / (2.0 * len(held) * math.log(2.0))
    return {"layout": layout, "joint_noise": noise, "bits": bits.tolist()}


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


def select(probe: Probe, skin: Array, samples: Samples) -> tuple[list[int], dict[str, Any]]:
    """The taxels of `skin` (n, m) chosen from all grasps, in order, and an honest curve.

    In the curve each grasp is predicted from taxels that were chosen without it, at the numbers asked
    for, at those of `CURVE` below and at the number of each layout; by the angles with the last of
    the noises. The probe's layouts were scored in the same folds, in `samples`.
    """
    noise, most = probe.choices.joint_noise[-1], max(probe.choices.select)
    known, held = probe.features(noise, JOINTS), probe.grasps.held
    kept, weights = probe.folds(held), probe.weights()
    alone = samples[Cell("hold", "auc", noise, JOINTS)]
    sizes = {name: readings.shape[1] for name, readings in probe.readings.items()}
    numbers = {*probe.choices.select, *CURVE, *sizes.values()}
    points = sorted(k for k in numbers if k <= min(most, skin.shape[1]))

    def gain(k: int) -> Array:
        """Of the best `k`, which differ from fold to fold, in AUC (b,)."""
        predicted = np.full((len(held), 2), np.nan)
        for path, fold in zip(paths, kept, strict=True):
            features = np.column_stack([known, skin[:, path[:k]].astype(float)])
            found = estimators.probabilities(features, held, [fold], probe.choices.estimator)
            predicted[fold[1]] = found[fold[1]]
        return metrics.measure("auc", held, predicted, weights) - alone

    in_threads = Parallel(probe.jobs, prefer="threads")
    with threadpool_limits(1):
        *paths, final = in_threads(
            delayed(forward)(known[train], skin[train], held[train], most)
            for train in (*(train for train, _ in kept), np.arange(len(held)))
        )
        best = dict(zip(points, in_threads(delayed(gain)(k) for k in points), strict=True))
    layouts = []
    for name, size in sizes.items():
        told = hold_gain(samples, noise, name)
        row = {"layout": name, "taxels": size, **metrics.gain(told)}
        if size in best:  # how far the layout is behind the best of the same number
            row |= metrics.estimate("lead", best[size] - told, "lead_interval")
        layouts.append(row)
    curve = [{"taxels": k, **metrics.gain(told)} for k, told in best.items()]
    return final, {"joint_noise": noise, "curve": curve, "layouts": layouts}
