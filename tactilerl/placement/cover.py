"""Which taxels should a hand have that closes at the first touch? Pure functions of recorded starts.

A start counts for a set of taxels where the first of them to fire does so at a moment from which
closing succeeds. Where no taxel fires too early, that is maximum coverage (Nemhauser, Wolsey and
Fisher 1978). Losses, bool (g, m), say which taxels fail together: each row is a taxel, a digit, or
what shares a board. What counts then is success after the worst of them, and among equals success
without any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import optimize, sparse

from ..envs.state import Array

NEVER = 255
"""The moment of what does not happen; moments are numbers of actions."""
MOST_SWAPS = 20  # which settle long before
NODES = 200  # of a search by branch and bound
MOST_ROWS = 6_000  # of a linear program; larger ones are left to greedy search
TIE = 1e-9  # what the worth of a taxel counts for among sets that are equally good
SAME = 1e-12  # difference of shares that are equal
INTACT = 1e-6  # what success without a loss counts for among sets whose worst losses are equal


@dataclass(frozen=True)
class Starts:
    """What happens in each of some starts while the hand waits, and what would if it closed."""

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
        return len(self.fires)

    @classmethod
    def joined(cls, parts: Sequence[Starts]) -> Starts:
        """Return the starts of all parts, in their order."""
        arrays = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*map(np.concatenate, arrays))

    def take(self, taxels: Sequence[int]) -> Starts:
        """Return the same starts with some taxels alone."""
        return replace(self, fires=self.fires[:, list(taxels)])

    @property
    def good(self) -> Array:
        """(n, m) bool: does each taxel fire first at a moment from which closing succeeds?"""
        return self.succeeds[np.arange(len(self))[:, None], self.fires]

    @property
    def worth(self) -> Array:
        """(m,) in [0, 1]: the share of starts that each taxel alone would win. Of sets that are
        equally good, the one whose taxels feel more is the likelier to feel unseen starts."""
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
    bound: float | None
    """No set of as many has more of `worst`; None where nobody knows."""


def first_firing(starts: Starts, taxels: Sequence[int]) -> Array:
    """Return after how many actions the first of these taxels fires in each start (n,), or NEVER."""
    return np.asarray(starts.fires[:, list(taxels)].min(axis=1, initial=NEVER))


def felt(starts: Starts, taxels: Sequence[int]) -> Array:
    """Tell where one of these taxels fires before the object is let go, bool (n,)."""
    return np.asarray(first_firing(starts, taxels) < starts.lets_go)


def successes(starts: Starts, taxels: Sequence[int]) -> Array:
    """Tell which starts a hand with these taxels wins, bool (n,)."""
    return starts.succeeds[np.arange(len(starts)), first_firing(starts, taxels)]


def value(starts: Starts, taxels: Sequence[int]) -> float:
    """Return the share of the starts that a hand with these taxels wins."""
    return float(successes(starts, taxels).mean())


def without(taxels: Sequence[int], lost: Array) -> list[int]:
    """Return what a loss, bool (m,), leaves of these taxels."""
    return [taxel for taxel in taxels if not lost[taxel]]


def worst_loss(
    starts: Starts, taxels: Sequence[int], losses: Array
) -> tuple[float, int | None]:
    """Return the share of the starts that a hand with these taxels wins after the worst loss, and
    which loss that is; None where no loss costs anything."""
    least, worst = value(starts, taxels), None
    for index in np.flatnonzero(losses[:, list(taxels)].any(axis=1)).tolist():
        after = value(starts, without(taxels, losses[index]))
        if after < least - SAME:
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
    existing: Sequence[int] = (),
    overlap: Array | None = None,
    losses: Array | None = None,
    first: Sequence[int] = (),
) -> list[int]:
    """Choose `k` taxels one after another, then swap them as long as that gains something.

    Those `existing` stay, and no two are chosen that `overlap`, bool (m, m). `first` are the
    taxels to begin with, if any. ValueError where there is no room.
    """
    n_taxels = starts.fires.shape[1]
    losses = np.zeros((0, n_taxels), bool) if losses is None else losses
    ties = TIE * starts.worth
    chosen = list(first or existing)

    def best_addition(rests: list[list[int]]) -> list[int]:
        """Return the best set that is one of the `rests` and one taxel more."""
        scores = np.full((len(rests), n_taxels), -np.inf)
        for rest, row in zip(rests, scores, strict=True):
            is_taken = np.zeros(n_taxels, bool)
            if overlap is not None:
                is_taken |= overlap[rest].any(axis=0)
            is_taken[rest] = True
            is_free = ~is_taken
            each = scores_with_each(starts, rest, losses).round(12) + ties
            row[is_free] = each[is_free]
        at, taxel = divmod(int(np.argmax(scores)), n_taxels)
        if not np.isfinite(scores[at, taxel]):
            room = f"{len(chosen) - len(existing)}; there is no room for more of this radius"
            raise ValueError(f"taxels: found {k - len(existing)}, allowed up to {room}")
        return [*rests[at], taxel]

    while len(chosen) < k:
        chosen = best_addition([chosen])
    reached = score(starts, chosen, losses)
    for _ in range(MOST_SWAPS):
        rests = [
            [i for i in chosen if i != out] for out in chosen if out not in existing
        ]
        swapped = best_addition(rests) if rests else chosen
        gained = score(starts, swapped, losses) - reached
        if gained <= SAME:
            break
        chosen, reached = swapped, reached + gained
    return chosen


def choose(
    starts: Starts,
    k: int,
    existing: Sequence[int] = (),
    overlap: Array | None = None,
    losses: Array | None = None,
) -> Chosen:
    """Choose the best `k` taxels of which no two `overlap`, by mixed-integer programming; where that
    takes too long, by `greedy`, and then with a bound or without."""
    exact, bound = _exact(starts, k, existing, overlap, losses)
    sets = [] if exact is None else [exact]
    firsts: list[Sequence[int]] = [existing]
    if losses is not None:  # what is best without a loss, and what the program says
        firsts += [choose(starts, k, existing, overlap).taxels, *sets]
    try:
        for first in firsts:
            sets.append(greedy(starts, k, existing, overlap, losses, first))
    except ValueError:  # it left no room for as many, which there may be
        if exact is None:
            raise
    every = losses if losses is not None else np.zeros((0, starts.fires.shape[1]), bool)
    best = max(sets, key=lambda taxels: round(score(starts, taxels, every), 12))
    worst, _ = worst_loss(starts, best, every)
    bound = None if bound is None else max(bound, worst)
    return Chosen(sorted(best), value(starts, best), worst, bound)


def _exact(
    starts: Starts,
    k: int,
    existing: Sequence[int],
    overlap: Array | None,
    losses: Array | None,
) -> tuple[list[int] | None, float | None]:
    """Return taxels and a bound, each None where there is none.

    A variable for each taxel, and for each start one for each run of moments between those that are
    too early: which of them holds the first firings? With losses, the same again for each start that
    a loss changes, and a last variable that none of the sums after a loss is below.
    """
    m = starts.fires.shape[1]
    rows, gains, after = _program(starts, losses)
    n = len(gains)
    if not any(gains):
        return None, 0.0
    if len(rows) > MOST_ROWS:
        return None, None
    if overlap is not None:
        for i, j in np.argwhere(np.triu(overlap)).tolist():
            if not (i in existing and j in existing):
                rows.append(({i: 1.0, j: 1.0}, 1.0))
    if losses is not None:
        rows += [
            ({**{z: -g for z, g in sums.items()}, m + n: 1.0}, 0.0) for sums in after
        ]
    matrix = sparse.lil_array((len(rows), m + n + 1))
    for at, (row, _) in enumerate(rows):
        matrix[at, list(row)] = list(row.values())
    limits = np.array([limit for _, limit in rows])
    lower = np.zeros(m + n + 1)
    lower[list(existing)] = 1.0
    is_taxel = np.r_[np.ones(m), np.zeros(n + 1)]
    ties = 0.1 / len(starts) / k * starts.worth
    objective = np.r_[ties, gains, 0.0]
    if losses is not None:
        objective = np.r_[0.5 / len(starts) * objective[:-1], 1.0]
    solved = optimize.milp(
        -objective,
        integrality=is_taxel,
        bounds=optimize.Bounds(lower, np.ones(m + n + 1)),
        constraints=[
            optimize.LinearConstraint(matrix.tocsr(), -np.inf, limits),
            optimize.LinearConstraint(is_taxel[None], k, k),
        ],
        options={"node_limit": NODES, "mip_rel_gap": 1e-6},
    )
    bound = solved.mip_dual_bound
    if bound is not None and np.isfinite(bound):  # whole starts
        bound = int(-bound * len(starts) + 1e-6) / len(starts)
    else:
        bound = None
    if solved.x is None:
        return None, bound
    return np.flatnonzero(solved.x[:m] > 0.5).tolist(), bound


Constraint = tuple[dict[int, float], float]
"""Coefficients by column, and the upper limit, of a linear constraint."""


def _program(
    starts: Starts, losses: Array | None
) -> tuple[list[Constraint], list[float], list[dict[int, float]]]:
    """Return the constraints, the weight of each variable of a start without a loss (0 of others),
    and for each loss, and for none, the variables that count after it with their weights; starts in
    which the same happens count together."""
    m = starts.fires.shape[1]
    happens = np.hstack([starts.fires, starts.good])
    patterns, which = np.unique(happens, axis=0, return_inverse=True)
    weights = (np.bincount(which.reshape(-1)) / len(starts)).tolist()
    rows: list[Constraint] = []
    gains: list[float] = []
    lost = np.zeros((0, m), bool) if losses is None else losses
    after: list[dict[int, float]] = [{} for _ in range(len(lost) + 1)]

    def add(
        fires: Array, is_good: Array, weight: float, gain: float
    ) -> dict[int, float]:
        """Add variables of a start, and return their weights."""
        last: dict[
            int, int
        ] = {}  # moment of each run, by how many taxels are too early
        for moment in np.unique(fires[is_good]).tolist():
            last[int((~is_good & (fires < moment)).sum())] = moment
        runs = range(m + len(gains), m + len(gains) + len(last))
        gains.extend([gain] * len(last))
        for run, moment in zip(runs, last.values(), strict=True):
            good = np.flatnonzero(is_good & (fires <= moment)).tolist()
            early = np.flatnonzero(~is_good & (fires < moment)).tolist()
            rows.append(({**dict.fromkeys(good, -1.0), run: 1.0}, 0.0))
            rows.extend(({taxel: 1.0, run: 1.0}, 1.0) for taxel in early)
        if len(runs) > 1:
            rows.append((dict.fromkeys(runs, 1.0), 1.0))
        return dict.fromkeys(runs, weight)

    for pattern, weight in zip(patterns, weights, strict=True):
        fires, is_good = pattern[:m], pattern[m:].astype(bool)
        intact = add(fires, is_good, weight, weight)
        after[-1] |= intact
        for members, counts in zip(lost, after, strict=False):
            if (members & (fires < NEVER)).any():
                left = np.where(members, NEVER, fires)
                counts |= add(left, is_good & ~members, weight, 0.0)
            else:
                counts |= intact
    return rows, gains, after
