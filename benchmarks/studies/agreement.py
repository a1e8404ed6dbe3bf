"""Do set-ups agree on the order of their cells, such as layouts? What predicts it, and what takes
which share of the variance? Functions over arrays, for the tables of the docs."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
import scipy.stats
from tactilerl import statistics
from tactilerl.statistics import Array, Estimate
from tactilerl.study import verdicts

N_RESAMPLES = 2000  # of each set-up
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


def predicts_order(predictor: Array, gains: Array) -> Estimate:
    """Spearman correlation of a predictor (cells,) with the means of gains (cells, seeds), which are
    resampled over seeds."""
    (drawn,) = _bootstrapped([gains])
    resampled = np.array([np.broadcast_to(predictor[:, None], drawn.shape), drawn])
    return rank_agreement(np.array([predictor, gains.mean(axis=1)]), resampled)


def concordance(
    values: Array, blocks: Sequence[str] | None = None, n_permutations: int = N_PERMUTATIONS
) -> tuple[float, float]:
    """Kendall's W of the cells' order over set-ups, (setups, cells): 0 is no agreement, 1 the same
    order everywhere. And its p-value, from shuffling the order of every set-up, or of all set-ups of a
    block, such as a hand, in the same way. A small p says that there is some agreement."""
    n_setups, n_cells = values.shape
    ranks = scipy.stats.rankdata(values, axis=1)
    friedman = scipy.stats.friedmanchisquare(*values.T).statistic
    _, block = np.unique(blocks or np.arange(n_setups), return_inverse=True)
    together = np.array([ranks[block == one].sum(axis=0) for one in range(block.max() + 1)])
    rng = np.random.default_rng(0)
    shuffled = rng.permuted(np.broadcast_to(together, (n_permutations, *together.shape)), axis=2)
    # Of ranks whose row sums are alike, the variance of the column sums orders W.
    spread = np.round(shuffled.sum(axis=1).var(axis=1), 9)
    p_value = _share_as_large(spread, np.round(ranks.sum(axis=0).var(), 9))
    return float(friedman / (n_setups * (n_cells - 1))), p_value


def predicted_by_block(
    predictors: Sequence[Array], values: Array, blocks: Sequence[str]
) -> tuple[float, float]:
    """Spearman correlation of a predictor (cells,) with the values (setups, cells), averaged over
    set-ups. And its two-sided p-value, from all ways to reorder the predictor, which the set-ups of a
    block share."""
    told, reached = (_standard_ranks(np.asarray(each)) for each in (predictors, values))
    orders = np.array([*itertools.permutations(range(values.shape[1]))])
    sums = np.zeros(1)
    for block in dict.fromkeys(blocks):
        own = [i for i, one in enumerate(blocks) if one == block]
        by_order = told[own[0]][orders] @ reached[own].sum(axis=0)
        sums = np.add.outer(sums, by_order).ravel()
    sums = np.round(sums / values.size, 9)
    found = sums[0]  # of the order as it is
    return float(found), float((np.abs(sums) >= abs(found)).mean())


def _standard_ranks(values: Array) -> Array:
    ranks = scipy.stats.rankdata(values, axis=-1)
    return np.asarray(scipy.stats.zscore(ranks, axis=-1))


def _share_as_large(drawn: Array, found: float) -> float:
    return float((1 + (drawn >= found).sum()) / (1 + len(drawn)))


# -- analysis of variance --------------------------------------------------------------------
# Gains (setups, cells, seeds), a set-up's seeds its own; all parts are random effects. In a balanced
# design the mean squares give what a mixed model fitted by REML gives, as long as no part is at 0:
# there statsmodels' MixedLM does not converge.


def mean_squares(gains: Array) -> dict[str, tuple[Array, int]]:
    """Mean squares (...) of gains (..., setups, cells, seeds), and their degrees of freedom."""
    n_setups, n_cells, n_seeds = gains.shape[-3:]
    setup, cell, both, seed, whole = (
        gains.mean(axis=axes, keepdims=True) for axes in ((-2, -1), (-3, -1), -1, -2, (-3, -2, -1))
    )
    effects = {
        "set-up": (setup - whole, n_setups - 1),
        "layout": (cell - whole, n_cells - 1),
        "set-up × layout": (both - setup - cell + whole, (n_setups - 1) * (n_cells - 1)),
        "seed within set-up": (seed - setup, n_setups * (n_seeds - 1)),
        "rest": (gains - both - seed + setup, n_setups * (n_cells - 1) * (n_seeds - 1)),
    }
    return {
        name: ((np.broadcast_to(effect, gains.shape) ** 2).sum(axis=(-3, -2, -1)) / df, df)
        for name, (effect, df) in effects.items()
    }


def variance_shares(gains: Array) -> dict[str, Estimate]:
    """Which share of the variance of gains (setups, cells, seeds) does each part take? Intervals draw
    each mean square from its χ² distribution (generalised pivots, Weerahandi 1993)."""
    squares, rng = mean_squares(gains), np.random.default_rng(0)
    drawn = {
        name: np.append(square, square * df / rng.chisquare(df, N_PERMUTATIONS))
        for name, (square, df) in squares.items()
    }
    return {
        name: Estimate(float(share[0]), *statistics.percentile_interval(share[1:]))
        for name, share in shares(drawn, *gains.shape).items()
    }


def shares(squares: dict[str, Array], n_setups: int, n_cells: int, n_seeds: int) -> dict[str, Array]:
    """From mean squares, by what they are on average."""
    setup, cell, both, seed, rest = squares.values()
    variances = {
        "set-up": (setup - seed - both + rest) / (n_cells * n_seeds),
        "layout": (cell - both) / (n_setups * n_seeds),
        "set-up × layout": (both - rest) / n_seeds,
        "seed within set-up": (seed - rest) / n_cells,
        "rest": rest,
    }
    cut = {name: np.maximum(variance, 0.0) for name, variance in variances.items()}
    return {name: variance / sum(cut.values()) for name, variance in cut.items()}


def differ(gains: Array, n_simulated: int = 5000) -> float:
    """p-value of: the differences between cells are the same in all set-ups, of gains (setups, cells,
    seeds). The F test of their interaction, its null drawn with each set-up's own noise."""

    def ratio(values: Array) -> Array:
        squares = mean_squares(values)
        return squares["set-up × layout"][0] / squares["rest"][0]

    noise = gains - gains.mean(axis=1, keepdims=True) - gains.mean(axis=2, keepdims=True)
    own = (noise + gains.mean(axis=(1, 2), keepdims=True)).std(axis=(1, 2), keepdims=True)
    drawn = own * np.random.default_rng(0).standard_normal((n_simulated, *gains.shape))
    return _share_as_large(ratio(drawn), float(ratio(gains)))
