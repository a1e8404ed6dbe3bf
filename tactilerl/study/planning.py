"""How many pairs of runs does an effect need? From the spread of a pilot's pairs, by statsmodels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats
from statsmodels.stats.power import TTestIndPower, TTestPower

from ..statistics import CONFIDENCE, Array, fewest_pairs
from .grid import SCORES, Setup, Study
from .records import Record
from .verdicts import Pairs, both_arms, in_pairs

MOST = 100_000  # runs; more are none that anybody could train
SHARES = (
    3 / 8,
    9 / 16,
    3 / 4,
    1,
)  # of the pairs, at which to look: 6, 9, 12 and 16 of 16


@dataclass(frozen=True)
class Need:
    """What the comparisons of a set-up need by one score."""

    setup: str
    score: str
    pairs: int
    """Of the pilot, in all cells."""
    correlation: float
    """Of treatment and control within seeds, pooled over the cells."""
    sd: float
    """Of the differences within the cells, pooled."""
    unpaired: int | None
    """Runs per arm, were the pairs torn apart; None where nobody can run so many."""
    needed: int | None
    """Pairs for the wanted power at `alpha`."""
    interval: tuple[int | None, int | None]
    """Of `needed`: for all that the pilot's few pairs can say of their spread."""
    needed_holm: int | None
    """Pairs where every cell of the set-up is to stand: at alpha / settings."""
    settings: int
    """Cells that are compared."""


def plan(
    study: Study, records: Sequence[Record], effect: float, power: float, alpha: float
) -> list[Need]:
    """What each set-up needs to find a difference of `effect`, by each score."""
    needs = []
    for setup in study.setups:
        for score in SCORES if setup.compare else ():
            cells = [
                in_pairs(both_arms(records, setup, cell, score)) for cell in setup.cells
            ]
            cells = [one for one in cells if len(one) > 1]
            if cells:
                needs.append(_need(setup, score, cells, effect, power, alpha))
    return needs


def _need(
    setup: Setup,
    score: str,
    cells: Sequence[Pairs],
    effect: float,
    power: float,
    alpha: float,
) -> Need:
    correlation, sd, sd_arm = spread([(one.treatment, one.control) for one in cells])
    n_pairs, tail = sum(map(len, cells)), (1 - CONFIDENCE) / 2
    freedom = n_pairs - len(cells)
    low, high = (
        sd * math.sqrt(freedom / scipy.stats.chi2.isf(t, freedom))
        for t in (tail, 1 - tail)
    )

    def pairs_for(sd: float, level: float = alpha) -> int | None:
        return runs_needed(effect, sd, power, level)

    unpaired = runs_needed(effect, sd_arm, power, alpha, in_pairs=False)
    return Need(
        setup.name, score, n_pairs, correlation, sd, unpaired, pairs_for(sd),
        (pairs_for(low), pairs_for(high)), pairs_for(sd, alpha / len(setup.cells)), len(setup.cells),
    )  # fmt: skip


def spread(cells: Sequence[tuple[Array, Array]]) -> tuple[float, float, float]:
    """Correlation within pairs, standard deviation of their differences and of the runs of an arm;
    of (treatment, control), both (pairs,), of each cell, about the cell's own means."""
    a, b = (
        np.concatenate([arms[i] - arms[i].mean() for arms in cells]) for i in (0, 1)
    )
    freedom = len(a) - len(cells)
    squares, product = float(a @ a), float(a @ b)
    size = (squares * float(b @ b)) ** 0.5
    sd = (float((a - b) @ (a - b)) / freedom) ** 0.5
    return (
        product / size if size else np.nan,
        sd,
        ((squares + float(b @ b)) / (2 * freedom)) ** 0.5,
    )


def runs_needed(
    effect: float, sd: float, power: float, alpha: float, in_pairs: bool = True
) -> int | None:
    """Pairs, or runs per group, for a t test to find `effect` with `power`, and not fewer pairs than
    a sign-flip test needs to fall below `alpha`; None where `MOST` do not suffice."""
    least = fewest_pairs(alpha) if in_pairs else 2
    test, size = (TTestPower() if in_pairs else TTestIndPower()), effect / max(sd, 1e-9)
    level = {
        "alpha": alpha / 2,
        "alternative": "larger",
    }  # the other tail is nothing, or NaN
    if not test.power(size, least, **level) < power:  # NaN: too close to 1
        return least
    if test.power(size, MOST, **level) < power:
        return None
    return math.ceil(float(test.solve_power(size, power=power, **level)) - 1e-9)


def best(needs: Sequence[Need]) -> dict[str, Need]:
    """By set-up, the score that needs the fewest pairs."""
    found: dict[str, Need] = {}
    for need in needs:
        known = found.get(need.setup)
        if need.needed and (known is None or need.needed < (known.needed or 0)):
            found[need.setup] = need
    return found


def looks(n_pairs: int, alpha: float) -> list[int]:
    """When to look at `n_pairs` pairs, not before a look could end with a difference at all."""
    can_end = (n for n in range(1, n_pairs) if fewest_pairs(alpha * n / n_pairs) <= n)
    first = next(can_end, n_pairs)
    return sorted({max(first, round(share * n_pairs)) for share in SHARES})
