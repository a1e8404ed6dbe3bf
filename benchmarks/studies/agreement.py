"""Do set-ups agree on the order of their cells, such as layouts? What foretells it, and what takes
which share of the variance? Functions over arrays, for the tables of the docs."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
import scipy.stats

from tactilerl import statistics
from tactilerl.statistics import Array, Estimate
from tactilerl.study import verdicts

N_RESAMPLES = 2000  # of each set-up
N_SIMULATED = 200
N_PERMUTATIONS = 50_000


def rank_agreement(values: Array, resampled: Array | None = None) -> Estimate:
    """Do set-ups put the cells (layouts) into the same order? Mean Spearman correlation over pairs
    of set-ups.

    `values` (setups, cells) and, for the interval, `resampled` (setups, cells, n_resamples).
    Resampling adds noise to the ranks, so the interval leans towards 0. NaN where a set-up has all
    cells alike.
    """
    value = float(_mean_spearman(values[..., None])[0])
    drawn = np.empty(0) if resampled is None else _mean_spearman(resampled)
    return Estimate(value, *statistics.percentile_interval(drawn))


def _mean_spearman(values: Array) -> Array:
    """(setups, cells, n) → (n,)"""
    ranks = scipy.stats.rankdata(values, axis=1)
    first, second = np.triu_indices(len(values), k=1)
    with warnings.catch_warnings(action="ignore", category=scipy.stats.ConstantInputWarning):
        return np.asarray(
            scipy.stats.pearsonr(ranks[first], ranks[second], axis=1).statistic.mean(axis=0)
        )


def _bootstrapped(gains: Iterable[Array]) -> Array:
    """Mean gain of every cell in resamples of the seeds, which the cells of a set-up share: of each
    (cells, seeds), (setups, cells, N_RESAMPLES)."""
    drawn = []
    for i, one in enumerate(gains):  # set-ups are resampled apart from each other
        counts = verdicts.resamples(n := one.shape[1])[:, i * N_RESAMPLES : (i + 1) * N_RESAMPLES]
        drawn.append(one @ counts.astype(float) / n)
    return np.array(drawn)


def agreement_of(gains: Sequence[Array]) -> Estimate:
    """`rank_agreement` of set-ups whose gains (cells, seeds) are given, resampled over seeds."""
    values = np.array([one.mean(axis=1) for one in gains])
    return rank_agreement(values, _bootstrapped(gains))


def foretold(predictors: Sequence[Array], gains: Sequence[Array]) -> Estimate:
    """Spearman correlation of a predictor (cells,) with the means of the gains (cells, seeds), averaged
    over set-ups. The interval is a bootstrap over seeds."""
    each = []
    for told, one, drawn in zip(predictors, gains, _bootstrapped(gains), strict=True):
        means = np.column_stack([one.mean(axis=1), drawn])
        each.append(_mean_spearman(np.array([np.broadcast_to(told[:, None], means.shape), means])))
    correlations = np.mean(each, axis=0)
    return Estimate(float(correlations[0]), *statistics.percentile_interval(correlations[1:]))


def concordance(values: Array, n_permutations: int = N_PERMUTATIONS) -> tuple[float, float]:
    """Kendall's W of the cells' order over set-ups, (setups, cells): 0 is no agreement, 1 the same
    order everywhere. And its p-value, from shuffling the order of every set-up."""
    n_setups, n_cells = values.shape
    ranks = scipy.stats.rankdata(values, axis=1)
    friedman = scipy.stats.friedmanchisquare(*values.T).statistic
    rng = np.random.default_rng(0)
    shuffled = rng.permuted(np.broadcast_to(ranks, (n_permutations, *ranks.shape)), axis=2)
    # Of ranks whose row sums are alike, the variance of the column sums orders W.
    spread = np.round(shuffled.sum(axis=1).var(axis=1), 9)
    as_large = int((spread >= np.round(ranks.sum(axis=0).var(), 9)).sum())
    p_value = (1 + as_large) / (1 + n_permutations)
    return float(friedman / (n_setups * (n_cells - 1))), p_value


PARTS = {
    "set-up": ["setup"],
    "layout": ["layout"],
    "set-up × layout": ["setup", "layout"],
    "seed within set-up": ["pair"],
}
"""Random effects of `variance_shares`, by what they are drawn for. A seed's gains share its run without
touch."""


def variance_shares(
    rows: Sequence[tuple[float, str, str, str]], n_simulated: int = N_SIMULATED
) -> dict[str, Estimate]:
    """Which share of the gains' variance do set-up, layout, and both together take?

    Of rows (gain, setup, layout, pair), by statsmodels' MixedLM. Intervals are a parametric bootstrap:
    the model is fitted again to gains drawn from it.
    """
    from statsmodels.regression.mixed_linear_model import MixedLM

    table = pd.DataFrame(rows, columns=["gain", "setup", "layout", "pair"])
    effects = {name: "0 + " + ":".join(f"C({one})" for one in by) for name, by in PARTS.items()}

    def fitted(gains: Array) -> tuple[dict[str, float], float]:
        table["gain"] = gains
        model = MixedLM.from_formula("gain ~ 1", table, groups=np.ones(len(table)), vc_formula=effects)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a variance at its bound 0 is no fault
            fit = model.fit(reml=True, method=["lbfgs"])
        variances = dict(zip(model.exog_vc.names, map(float, fit.vcomp), strict=True))
        found = {name: variances[name] for name in PARTS} | {"rest": float(fit.scale)}
        return found, float(fit.params.iloc[0])

    variances, centre = fitted(table["gain"].to_numpy())
    members = {name: table.groupby(by).ngroup().to_numpy() for name, by in PARTS.items()}
    members["rest"] = np.arange(len(table))
    rng, drawn = np.random.default_rng(0), []
    for _ in range(n_simulated):
        gains = centre + sum(
            math.sqrt(variances[name]) * rng.standard_normal(member.max() + 1)[member]
            for name, member in members.items()
        )
        drawn.append(_shares(fitted(gains)[0]))
    return {
        name: Estimate(value, *statistics.percentile_interval(np.array([each[name] for each in drawn])))
        for name, value in _shares(variances).items()
    }


def _shares(variances: dict[str, float]) -> dict[str, float]:
    whole = sum(variances.values())
    return {name: variance / whole for name, variance in variances.items()}
