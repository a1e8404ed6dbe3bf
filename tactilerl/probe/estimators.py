"""What predicts: regularised linear models, by scikit-learn.

Predictions are of grasps that were held back: each fold by a model that was fitted, and whose
hyperparameters were chosen, on the others.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from sklearn.compose import TransformedTargetRegressor
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegressionCV, RidgeCV
from sklearn.model_selection import (
    GroupKFold,
    StratifiedKFold,
    cross_val_predict,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from ..envs.state import Array

Fold = tuple[Array, Array]
"""Indices of grasps to fit on, and of those held back."""
INNER_FOLDS = 3  # in which hyperparameters are chosen
PENALTIES = [
    0.003,
    0.03,
    0.3,
    3.0,
]  # C of the logistic regression, of standardised features
RIDGES = np.logspace(-1, 4, 11)


@contextmanager
def expected_warnings() -> Iterator[None]:
    """Silences what estimators warn of when they see few grasps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.filterwarnings("ignore", "The least populated class")
        warnings.filterwarnings("ignore", "Only one sample available")
        yield


def folds(held: Array, n: int, groups: Array | None, seed: int) -> list[Fold]:
    """`n` folds with as many held grasps in each; or, with `groups` (grasps,), as many folds as
    there are groups, up to `n`, and no group on both sides. ValueError where there cannot be."""
    for label, what in ((True, "were held"), (False, "were not")):
        count = int((held == label).sum())
        if count == 0:
            raise ValueError(
                f"grasps: found {len(held)} with the same outcome ({count} {what}), allowed grasps "
                "of both outcomes"
            )
        if count < n:
            raise ValueError(
                f"folds: found {n}, allowed up to {count}, the grasps that {what}"
            )
    splitter: Any = StratifiedKFold(n, shuffle=True, random_state=seed)
    if groups is not None:
        objects = len(np.unique(groups))
        if objects < 2:
            raise ValueError(
                f"hold_out: found {objects} object, allowed two or more, to hold some out"
            )
        splitter = GroupKFold(min(n, objects))
    found = list(splitter.split(np.zeros((len(held), 1)), held, groups))
    for train, _ in found:
        n_held = int(held[train].sum())
        least, most = sorted((n_held, len(train) - n_held))
        if least == 0 or most < INNER_FOLDS:
            raise ValueError(
                f"grasps: found a fold with {least} of one outcome and {most} of the other to learn "
                f"from, allowed 1 and {INNER_FOLDS} or more: too few grasps"
            )
    return found


def probabilities(features: Array, targets: Array, kept: list[Fold]) -> Array:
    """(n, 2): probability that each grasp holds, and the share that held in its training folds."""
    inner = StratifiedKFold(INNER_FOLDS, shuffle=True, random_state=0)
    chosen = LogisticRegressionCV(
        Cs=PENALTIES, l1_ratios=(0.0,), cv=inner, scoring="neg_log_loss", tol=1e-3, max_iter=1000,
        use_legacy_attributes=False,
    )  # fmt: skip
    model, predicted = (
        make_pipeline(StandardScaler(), chosen),
        np.full((len(targets), 2), np.nan),
    )
    for train, test in kept:
        model.fit(features[train], targets[train])
        predicted[test, 0] = model.predict_proba(features[test])[:, 1]
        predicted[test, 1] = targets[train].mean()
    return predicted


def values(features: Array, targets: Array, kept: list[Fold]) -> Array:
    """(n, d) predictions of `targets` (n, d)."""
    model = make_pipeline(
        StandardScaler(), RidgeCV(RIDGES)
    )  # leaves one out, in closed form
    # Ridge regression shrinks what is measured in large units less.
    scaled = TransformedTargetRegressor(model, transformer=StandardScaler())
    return cross_val_predict(scaled, features, targets, cv=kept)


def classes(features: Array, targets: Array, kept: list[Fold]) -> Array:
    """(n,) predictions of the classes `targets`."""
    # Its shrinkage is not chosen but follows from the training folds.
    discriminant = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    model = make_pipeline(StandardScaler(), discriminant)
    return cross_val_predict(model, features, targets, cv=kept)
