"""Which taxels of a dense skin? Forward selection: one after another, the one that tells most
beyond the joints and those already chosen.

How much a taxel would tell is Rao's score test of a logistic regression: a second-order
estimate of the gain in likelihood, for all candidates at once, from one fit without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from joblib import Parallel, delayed
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from ..envs.state import Array
from . import estimators, metrics
from .analysis import JOINTS, Probe

# C of the regression from which candidates are judged, of standardised features. Weak: a penalty
# pulls at the weights of what is chosen, so that copies of it would seem to tell something.
PENALTY = 100.0
REDUNDANT = 1e-6  # share of a candidate's variance that the others leave unexplained


def bits(probe: Probe, skin: Array) -> Array:
    """What each taxel of a skin (n, m) would tell alone, beyond the angles with the last of the noises:
    bits a grasp (m,), less what a taxel of noise would seem to tell."""
    known = StandardScaler().fit_transform(
        probe.features(probe.choices.joint_noise[-1], JOINTS)
    )
    held = probe.grasps.held
    with threadpool_limits(
        1
    ):  # as everywhere here: the digits do not depend on the cores
        score = _scores(known, skin.astype(float), held)
    return np.maximum(score - 1.0, 0.0) / (2.0 * len(held) * math.log(2.0))


def forward(
    known: Array, candidates: Array, held: Array, n: int, overlap: Array | None = None
) -> list[int]:
    """Indices of up to `n` candidates (n, m), in the order in which they were chosen; fewer when
    the others tell nothing new. Of candidates that are alike, or `overlap`, bool (h + m, h + m) where
    the hand has h already, one is chosen at most."""
    features, pool = StandardScaler().fit_transform(known), candidates.astype(float)
    chosen: list[int] = []
    m = candidates.shape[1]
    overlap = np.zeros((m, m), bool) if overlap is None else overlap
    is_free = ~overlap[:-m, -m:].any(axis=0)
    for _ in range(min(n, m)):
        score = np.where(is_free, _scores(features, pool, held), 0.0)
        best = int(np.argmax(score))
        if not score[best] > 0.0:
            break
        chosen.append(best)
        column = pool[:, best]
        is_free &= (pool != column[:, None]).any(axis=0) & ~overlap[-m + best, -m:]
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


def select(
    probe: Probe,
    skin: Array,
    numbers: Sequence[int],
    has: Array,
    overlap: Array | None = None,
) -> tuple[list[int], dict[int, Array], dict[str, Array]]:
    """The taxels of `skin` (n, m) chosen from all grasps, in order; and gains in AUC over the angles
    with the last of the noises: of the best so many, and of each of the probe's layouts. `has` (n, h)
    are readings of taxels that the hand has already, and `overlap` (h + m, h + m) says which do not fit
    beside each other.

    Each grasp is predicted from taxels that were chosen without it. Gains are (1 + resamples,): of all
    grasps, then of each bootstrap sample.
    """
    noise, held = probe.choices.joint_noise[-1], probe.grasps.held
    joints = probe.features(noise, JOINTS)
    known = np.column_stack([joints, has.astype(float)])
    kept, weights = probe.folds(held), probe.weights()
    in_threads = Parallel(probe.jobs, prefer="threads")
    with threadpool_limits(1):
        *paths, final = in_threads(
            delayed(forward)(
                known[train], skin[train], held[train], max(numbers), overlap
            )
            for train in (*(train for train, _ in kept), np.arange(len(held)))
        )

        def told(features: Sequence[Array]) -> Array:
            """AUC (b,) where each fold has features of its own."""
            predicted = np.full((len(held), 2), np.nan)
            for own, fold in zip(features, kept, strict=True):
                predicted[fold[1]] = estimators.probabilities(own, held, [fold])[
                    fold[1]
                ]
            return metrics.measure("auc", held, predicted, weights)

        alone = told([joints] * len(kept))
        best = [
            [np.column_stack([known, skin[:, path[:n]]]) for path in paths]
            for n in numbers
        ]
        layouts = [
            [np.column_stack([joints, felt])] * len(kept)
            for felt in probe.readings.values()
        ]
        found = in_threads(delayed(told)(features) for features in (*best, *layouts))
    gains = [one - alone for one in found]
    by_layout = zip(probe.readings, gains[len(best) :], strict=True)
    return final, dict(zip(numbers, gains, strict=False)), dict(by_layout)
