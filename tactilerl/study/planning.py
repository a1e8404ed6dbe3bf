"""How many pairs of runs does an effect need? From the spread of a pilot's pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import statistics
from ..statistics import Array
from .grid import SCORES, Setup, Study
from .records import Record
from .verdicts import SEED, Pairs, both_arms, in_pairs

AT = (10, 20)  # pairs
SHARES = (3 / 8, 9 / 16, 3 / 4, 1)  # of the pairs, at which to look: 6, 9, 12 and 16 of 16


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
    """Pairs where every cell of the set-up is to stand: at alpha / cells."""
    power: dict[int, float]
    """Of a t test in pairs at `alpha`, by pairs."""
    simulated: float
    """Of the sign-flip test with `needed` pairs (10 where nobody can say how many)."""


def plan(
    study: Study, records: Sequence[Record], effect: float, power: float, alpha: float
) -> list[Need]:
    """What each set-up needs to find a difference of `effect`, by each score."""
    needs = []
    for setup in study.setups:
        for score in SCORES if setup.compare else ():
            cells = [in_pairs(both_arms(records, setup, cell, score)) for cell in setup.cells]
            cells = [one for one in cells if len(one) > 1]
            if cells:
                needs.append(_need(setup, score, cells, effect, power, alpha))
    return needs


def spread(cells: Sequence[tuple[Array, Array]]) -> tuple[float, float, float]:
    """Correlation within pairs, standard deviation of their differences and of the runs of an arm;
    of (treatment, control), both (pairs,), of each cell, about the cell's own means."""
    a, b = (np.concatenate([arms[i] - arms[i].mean() for arms in cells]) for i in (0, 1))
    freedom = len(a) - len(cells)
    squares, product = float(a @ a), float(a @ b)
    size = (squares * float(b @ b)) ** 0.5
    sd = (float((a - b) @ (a - b)) / freedom) ** 0.5
    return product / size if size else np.nan, sd, ((squares + float(b @ b)) / (2 * freedom)) ** 0.5


def _need(
    setup: Setup, score: str, cells: Sequence[Pairs], effect: float, power: float, alpha: float
) -> Need:
    n_pairs = sum(map(len, cells))
    correlation, sd, sd_arm = spread([(one.treatment, one.control) for one in cells])

    def pairs_for(sd: float, level: float = alpha) -> int | None:
        return statistics.runs_needed(effect, sd, power, level, in_pairs=True)

    low, high = statistics.sd_interval(sd, n_pairs - len(cells))
    needed = pairs_for(sd)
    deviations = np.concatenate([d - d.mean() for d in (one.treatment - one.control for one in cells)])
    rng = np.random.default_rng(SEED)
    n = needed if needed and needed <= 200 else 10
    return Need(
        setup.name, score, n_pairs, correlation, sd,
        statistics.runs_needed(effect, sd_arm, power, alpha, in_pairs=False),
        needed, (pairs_for(low), pairs_for(high)), pairs_for(sd, alpha / len(setup.cells)),
        {at: statistics.power_of_t_test(effect, sd, at, alpha, in_pairs=True) for at in AT},
        statistics.simulated_power(rng, deviations, effect, n, alpha),
    )  # fmt: skip


def best(needs: Sequence[Need]) -> dict[str, Need]:
    """By set-up, the score that needs the fewest pairs."""
    known = [need for need in needs if need.needed]
    return {
        setup: min((n for n in known if n.setup == setup), key=lambda need: need.needed or 0)
        for setup in dict.fromkeys(need.setup for need in known)
    }


def looks(n_pairs: int) -> list[int]:
    """When to look at a study of `n_pairs` pairs."""
    return sorted({max(statistics.FEWEST_PAIRS, round(share * n_pairs)) for share in SHARES})
