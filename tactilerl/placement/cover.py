"""Choose taxels for a hand that closes at the first touch: pure functions of recorded starts.

A start counts for a set of taxels where the first of them to fire does so at a moment from which
closing succeeds. Where no taxel fires too early, that is maximum coverage (Nemhauser, Wolsey and
Fisher 1978). Losses, bool (g, m), say which taxels fail together: each row is a taxel, a digit, or
what shares a board. What counts then is success after the worst of them, and among equals success
without any.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import optimize, sparse

from ..envs.state import Array

NEVER = 255
"""The moment of what does not happen; moments are numbers of actions."""
MAX_SWAPS = 20  # which settle long before
NODES = 200  # of a search by branch and bound
MAX_ROWS = 6_000  # of a linear program; larger ones are left to greedy search
TIE_WEIGHT = (
    1e-9  # what the worth of a taxel counts for among sets that are equally good
)
EQUAL_SHARES = 1e-12  # difference of shares that are equal
INTACT = 1e-6  # what success without a loss counts for among sets whose worst losses are equal


@dataclass(frozen=True)
class Starts:
    """Record of some starts: when each taxel fires while the hand waits, and when closing succeeds."""

    fires: Array
    """(n, m) uint8: after how many actions each taxel fires first, or NEVER."""
    succeeds: Array
    """(n, NEVER + 1) bool: does a hand succeed that closes after so many actions? False where
    nobody asked, and for NEVER."""
    sets_off: Array
    """(n,) before which action no reading can tell that the object comes."""
    lets_go: Array
    """(n,) before which action it is let go."""

    def __len__(self) -> int:
        """Return how many starts these are."""
        return len(self.fires)

    @property
    def good(self) -> Array:
        """(n, m) bool: does each taxel fire first at a moment from which closing succeeds?"""
        return self.succeeds[np.arange(len(self))[:, None], self.fires]

    @property
    def worth(self) -> Array:
        """(m,) in [0, 1]: the share of starts that each taxel alone would win.

        Of sets that are equally good, the one whose taxels feel more is the likelier to feel unseen
        starts.
        """
        return np.asarray(self.good.mean(axis=0))

    @property
    def early(self) -> Array:
        """(m,) bool: taxels that fire in any start before the object has set off."""
        return np.asarray((self.fires < self.sets_off[:, None]).any(axis=0))


class Chosen(NamedTuple):
    """A set of taxels, and how good any could be."""

    taxels: list[int]
    value: float
    """Share of the starts that count."""
    worst: float
    """The same after the worst loss that was thought of."""
    bound: float
    """No set of as many has more of `worst`; 1 where nobody knows."""


def first_firing(starts: Starts, taxels: Sequence[int]) -> Array:
    """Return after how many actions the first of these taxels fires in each start (n,), or NEVER."""
    return np.asarray(starts.fires[:, list(taxels)].min(axis=1, initial=NEVER))


def successes(starts: Starts, taxels: Sequence[int]) -> Array:
    """Tell which starts a hand with these taxels wins, bool (n,)."""
    return starts.succeeds[np.arange(len(starts)), first_firing(starts, taxels)]


def value(starts: Starts, taxels: Sequence[int]) -> float:
    """Return the share of the starts that a hand with these taxels wins."""
    return float(successes(starts, taxels).mean())


def without(taxels: Sequence[int], lost: Array) -> list[int]:
    """Return the taxels that a loss, bool (m,), leaves."""
    return [taxel for taxel in taxels if not lost[taxel]]


def worst_loss(
    starts: Starts, taxels: Sequence[int], losses: Array
) -> tuple[float, int | None]:
    """Return the share of the starts that a hand with these taxels wins after the worst loss.

    The second value is which loss that is; None where no loss costs anything.
    """
    least, worst = value(starts, taxels), None
    for index in np.flatnonzero(losses[:, list(taxels)].any(axis=1)).tolist():
        after = value(starts, without(taxels, losses[index]))
        if after < least - EQUAL_SHARES:
            least, worst = after, index
    return least, worst


def score(starts: Starts, taxels: Sequence[int], losses: Array) -> float:
    """Return what is maximised: success after the worst loss, and then success."""
    return worst_loss(starts, taxels, losses)[0] + INTACT * value(starts, taxels)


def values_with_each(starts: Starts, taxels: Sequence[int]) -> Array:
    """Return the share of the starts that these taxels win together with each other one (m,)."""
    moments = np.minimum(first_firing(starts, taxels)[:, None], starts.fires)
    rows = np.arange(len(starts))[:, None]
    return np.asarray(starts.succeeds[rows, moments].mean(axis=0))


def scores_with_each(starts: Starts, taxels: Sequence[int], losses: Array) -> Array:
    """Return the `score` of these taxels together with each other one (m,)."""
    values = values_with_each(starts, taxels)
    is_hit = losses[:, list(taxels)].any(axis=1)
    # Of the other losses, only the new taxel is part.
    is_hit_alone = losses[~is_hit].any(axis=0)
    worst = np.where(is_hit_alone, np.minimum(values, value(starts, taxels)), values)
    for lost in losses[is_hit]:
        left = without(taxels, lost)
        after = np.where(lost, value(starts, left), values_with_each(starts, left))
        worst = np.minimum(worst, after)
    return worst + INTACT * values


def greedy(
    starts: Starts,
    k: int,
    existing: Sequence[int],
    overlap: Array | None,
    losses: Array,
    first: Sequence[int],
) -> list[int]:
    """Add to the taxels `first` until there are `k`, then swap as long as that gains something.

    Those `existing` stay, and no two are chosen that `overlap`, bool (m, m). Raise ValueError where
    there is no room.
    """
    n_taxels = starts.fires.shape[1]
    ties = TIE_WEIGHT * starts.worth
    chosen = list(first)

    def best_addition(rests: list[list[int]]) -> list[int]:
        """Return the best set that is one of the `rests` and one taxel more."""
        scores = np.full((len(rests), n_taxels), -np.inf)
        for rest, row in zip(rests, scores, strict=True):
            is_free = np.ones(n_taxels, bool)
            is_free[rest] = False
            if overlap is not None:
                is_free &= ~overlap[rest].any(axis=0)
            each = scores_with_each(starts, rest, losses).round(12) + ties
            row[is_free] = each[is_free]
        index, taxel = divmod(int(np.argmax(scores)), n_taxels)
        if not np.isfinite(scores[index, taxel]):
            raise ValueError(
                f"taxels: found {k - len(existing)}, allowed up to {len(chosen) - len(existing)}; "
                "there is no room for more of this radius"
            )
        return [*rests[index], taxel]

    while len(chosen) < k:
        chosen = best_addition([chosen])
    for _ in range(MAX_SWAPS):
        swapped = best_addition(
            [[i for i in chosen if i != out] for out in chosen if out not in existing]
        )
        if (
            score(starts, swapped, losses) - score(starts, chosen, losses)
            <= EQUAL_SHARES
        ):
            break
        chosen = swapped
    return chosen


def choose(
    starts: Starts,
    k: int,
    existing: Sequence[int] = (),
    overlap: Array | None = None,
    losses: Array | None = None,
) -> Chosen:
    """Choose the best `k` taxels of which no two `overlap`, by mixed-integer programming.

    Where that takes too long, choose by `greedy`, and then with a bound or without.
    """
    if losses is None:
        losses = np.zeros((0, starts.fires.shape[1]), bool)
    exact, bound = _exact(starts, k, existing, overlap, losses)
    sets = [] if exact is None else [exact]
    firsts = [existing, *sets]
    if len(losses):
        firsts.append(choose(starts, k, existing, overlap).taxels)
    try:
        for first in firsts:
            sets.append(greedy(starts, k, existing, overlap, losses, first))
    except ValueError:  # it left no room for as many, which there may be
        if exact is None:
            raise
    best = max(sets, key=lambda taxels: round(score(starts, taxels, losses), 12))
    worst, _ = worst_loss(starts, best, losses)
    return Chosen(sorted(best), value(starts, best), worst, bound)


def _exact(
    starts: Starts,
    k: int,
    existing: Sequence[int],
    overlap: Array | None,
    losses: Array,
) -> tuple[list[int] | None, float]:
    """Return the best taxels, or None, and a bound of success after the worst loss."""
    n, m = starts.fires.shape
    rows, cases = _program(starts, losses)
    if len(rows) > MAX_ROWS:
        return None, 1.0
    if overlap is not None:
        for i, j in np.argwhere(np.triu(overlap)).tolist():
            if not (i in existing and j in existing):
                rows.append(({i: 1.0, j: 1.0}, 1.0))
    rows += [(case, 0.0) for case in cases]
    n_columns = max(max(row) for row, _ in rows) + 1
    matrix = sparse.lil_array((len(rows), n_columns))
    for at, (row, _) in enumerate(rows):
        matrix[at, list(row)] = list(row.values())
    lower, upper = np.zeros(n_columns), np.ones(n_columns)
    lower[list(existing)], upper[m] = 1.0, n
    is_taxel = np.arange(n_columns) < m
    gains = np.zeros(n_columns)
    gains[list(cases[0])] = [-weight for weight in cases[0].values()]
    gains[:m] = 0.1 / k * starts.worth
    if len(losses):  # of equals after the worst, the best without: less than one start
        gains *= 0.5 / n
    gains[m] = len(losses) > 0
    solved = optimize.milp(
        -gains,
        integrality=is_taxel,
        bounds=optimize.Bounds(lower, upper),
        constraints=[
            optimize.LinearConstraint(
                matrix.tocsr(), -np.inf, [limit for _, limit in rows]
            ),
            optimize.LinearConstraint(is_taxel[None], k, k),
        ],
        options={"node_limit": NODES, "mip_rel_gap": 1e-6},
    )
    if solved.x is None:
        return None, 1.0
    bound = int(1e-3 - solved.mip_dual_bound) / n  # whole starts
    return np.flatnonzero(solved.x[:m] > 0.5).tolist(), bound


def _program(
    starts: Starts, losses: Array
) -> tuple[list[tuple[dict[int, float], float]], list[dict[int, float]]]:
    """Return the constraints of the linear program: coefficients by column, and upper limit.

    Columns are a variable for each taxel; the starts that succeed after the worst loss; and for each
    start one for each run of moments between those that are too early: does the first firing lie
    there? There are as many again for each loss that changes the start. Starts in which the same
    happens count together.

    The second list has the coefficients of one more constraint for no loss and for each loss, whose
    upper limit is 0: the starts that succeed after the worst are not more than those after this.
    """
    m = starts.fires.shape[1]
    happens = np.hstack([starts.fires, starts.good])
    patterns, counts = np.unique(happens, axis=0, return_counts=True)
    rows: list[tuple[dict[int, float], float]] = []
    cases = [{m: 1.0} for _ in range(len(losses) + 1)]
    columns = itertools.count(m + 1)

    def add(fires: Array, is_good: Array) -> list[int]:
        """Add the constraints of a start, and return the columns of its runs."""
        bad = np.flatnonzero(~is_good)
        bad = bad[np.argsort(fires[bad], kind="stable")]
        n_too_early = np.searchsorted(fires[bad], fires)
        runs = []
        for most in np.unique(n_too_early[is_good]).tolist():
            runs.append(run := next(columns))
            good = np.flatnonzero(is_good & (n_too_early <= most)).tolist()
            rows.append(({**dict.fromkeys(good, -1.0), run: 1.0}, 0.0))
            rows.extend(({i: 1.0, run: 1.0}, 1.0) for i in bad[:most].tolist())
        if len(runs) > 1:
            rows.append((dict.fromkeys(runs, 1.0), 1.0))
        return runs

    for pattern, count in zip(patterns, counts.tolist(), strict=True):
        fires, is_good = pattern[:m], pattern[m:] > 0
        intact = add(fires, is_good)
        cases[0] |= dict.fromkeys(intact, -count)
        for lost, case in zip(losses, cases[1:], strict=True):
            is_hit = (fires[lost] < NEVER).any()
            runs = (
                add(np.where(lost, NEVER, fires), is_good & ~lost) if is_hit else intact
            )
            case |= dict.fromkeys(runs, -count)
    return rows, cases
