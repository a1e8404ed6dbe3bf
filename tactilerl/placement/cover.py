"""Which taxels should a hand have that closes at the first touch? Pure functions of recorded starts.

A start counts for a set of taxels where the first of them to fire does so at a moment from which
closing succeeds. Where no taxel fires too early, that is maximum coverage (Nemhauser, Wolsey and
Fisher 1978).
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
TIE = 1e-9  # what the worth of a taxel counts for among sets that are equally good


@dataclass(frozen=True)
class Starts:
    """What happens in each of some starts while the hand waits, and what would if it closed."""

    fires: Array
    """(n, m) uint8: after how many actions each taxel fires first, or NEVER."""
    succeeds: Array
    """(n, NEVER + 1) bool: does a hand succeed that closes after so many actions? False where
    nobody asked, and for NEVER."""
    sets_off: Array
    """(n,) before which action the object begins to come."""
    lets_go: Array
    """(n,) before which action it is let go."""
    weights: Array
    """(n,) of each start; they sum to 1."""

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
        return np.asarray(self.weights @ self.good)

    @property
    def early(self) -> Array:
        """(m,) bool: taxels that fire in any start before the object has set off."""
        return np.asarray((self.fires < self.sets_off[:, None]).any(axis=0))


class Chosen(NamedTuple):
    """A set of taxels, and how good any could be."""

    taxels: list[int]
    value: float
    """Share of the starts that count."""
    bound: float | None
    """No set of as many has more; None where nobody knows."""


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
    return float(starts.weights @ successes(starts, taxels))


def values_with_each(starts: Starts, taxels: Sequence[int]) -> Array:
    """Return the share of the starts that these taxels win together with each other one (m,)."""
    moments = np.minimum(first_firing(starts, taxels)[:, None], starts.fires)
    rows = np.arange(len(starts))[:, None]
    return np.asarray(starts.weights @ starts.succeeds[rows, moments])


def greedy(
    starts: Starts,
    k: int,
    kept: Sequence[int] = (),
    overlap: Array | None = None,
) -> list[int]:
    """Choose `k` taxels one after another, then swap them as long as that gains something.

    Those `kept` stay, and no two are chosen that `overlap`, bool (m, m). ValueError where there is
    no room.
    """
    n_taxels = starts.fires.shape[1]
    ties = TIE * starts.worth
    chosen = list(kept)

    def best_addition(rests: list[list[int]]) -> list[int]:
        """Return the best set that is one of the `rests` and one taxel more."""
        scores = np.full((len(rests), n_taxels), -np.inf)
        for rest, row in zip(rests, scores, strict=True):
            is_taken = np.zeros(n_taxels, bool)
            if overlap is not None:
                is_taken |= overlap[rest].any(axis=0)
            is_taken[rest] = True
            is_free = ~is_taken
            row[is_free] = (values_with_each(starts, rest).round(12) + ties)[is_free]
        at, taxel = divmod(int(np.argmax(scores)), n_taxels)
        if not np.isfinite(scores[at, taxel]):
            room = (
                f"{len(chosen) - len(kept)}; there is no room for more of this radius"
            )
            raise ValueError(f"taxels: found {k - len(kept)}, allowed up to {room}")
        return [*rests[at], taxel]

    while len(chosen) < k:
        chosen = best_addition([chosen])
    for _ in range(MOST_SWAPS):
        rests = [[i for i in chosen if i != out] for out in chosen if out not in kept]
        swapped = best_addition(rests) if rests else chosen
        if value(starts, swapped) <= value(starts, chosen) + 1e-12:
            break
        chosen = swapped
    return chosen


def choose(
    starts: Starts,
    k: int,
    kept: Sequence[int] = (),
    overlap: Array | None = None,
) -> Chosen:
    """Choose the best `k` taxels of which no two `overlap`, by mixed-integer programming; where that
    takes more than `NODES` nodes of the search, by `greedy`, and then with a bound or without."""
    exact, bound = _exact(starts, k, kept, overlap)
    try:
        taxels = greedy(starts, k, kept, overlap)
    except ValueError:  # it left no room for as many, which there may be
        if exact is None:
            raise
        taxels = exact
    best = value(starts, taxels)
    if exact is not None and (reached := value(starts, exact)) >= best - 1e-12:
        taxels, best = exact, reached
    return Chosen(sorted(taxels), best, None if bound is None else max(bound, best))


def _exact(
    starts: Starts, k: int, kept: Sequence[int], overlap: Array | None
) -> tuple[list[int] | None, float | None]:
    """Return taxels and a bound, each None where there is none.

    A variable for each taxel, and for each start one for each run of moments between those that are
    too early: which of them holds the first firings?
    """
    rows, gains = _constraints(starts)
    m, n = starts.fires.shape[1], len(gains)
    if not n:
        return None, 0.0
    if overlap is not None:
        for i, j in np.argwhere(np.triu(overlap)).tolist():
            if not (i in kept and j in kept):
                rows.append(({i: 1.0, j: 1.0}, 1.0))
    matrix = sparse.lil_array((len(rows), m + n))
    for at, (row, _) in enumerate(rows):
        matrix[at, list(row)] = list(row.values())
    limits = np.array([limit for _, limit in rows])
    lower = np.zeros(m + n)
    lower[list(kept)] = 1.0
    is_taxel = np.r_[np.ones(m), np.zeros(n)]
    ties = 0.1 * starts.weights.min() / k * starts.worth
    solved = optimize.milp(
        -np.r_[ties, gains],
        integrality=is_taxel,
        bounds=optimize.Bounds(lower, np.ones(m + n)),
        constraints=[
            optimize.LinearConstraint(matrix.tocsr(), -np.inf, limits),
            optimize.LinearConstraint(is_taxel[None], k, k),
        ],
        options={"node_limit": NODES, "mip_rel_gap": 1e-6},
    )
    bound = solved.mip_dual_bound
    if bound is None or not np.isfinite(bound):
        bound = None
    elif np.ptp(starts.weights) == 0.0:  # whole starts
        bound = int(-bound * len(starts) + 1e-6) / len(starts)
    else:
        bound = -float(bound)
    if solved.x is None:
        return None, bound
    return np.flatnonzero(solved.x[:m] > 0.5).tolist(), bound


Row = tuple[dict[int, float], float]
"""Coefficients by column, and the upper limit, of a linear constraint."""


def _constraints(starts: Starts) -> tuple[list[Row], list[float]]:
    """Return the constraints, and the weight of each variable of a start; starts in which the same
    happens count together."""
    m = starts.fires.shape[1]
    happens = np.hstack([starts.fires, starts.good])
    patterns, which = np.unique(happens, axis=0, return_inverse=True)
    weights = np.bincount(which.reshape(-1), starts.weights)
    rows: list[Row] = []
    gains: list[float] = []
    for pattern, weight in zip(patterns, weights.tolist(), strict=True):
        fires, is_good = pattern[:m], pattern[m:].astype(bool)
        last: dict[
            int, int
        ] = {}  # moment of each run, by how many taxels are too early
        for moment in np.unique(fires[is_good]).tolist():
            last[int((~is_good & (fires < moment)).sum())] = moment
        runs = range(m + len(gains), m + len(gains) + len(last))
        gains += [weight] * len(last)
        for run, moment in zip(runs, last.values(), strict=True):
            good = np.flatnonzero(is_good & (fires <= moment)).tolist()
            early = np.flatnonzero(~is_good & (fires < moment)).tolist()
            rows.append(({**dict.fromkeys(good, -1.0), run: 1.0}, 0.0))
            rows += [({taxel: 1.0, run: 1.0}, 1.0) for taxel in early]
        if len(runs) > 1:
            rows.append((dict.fromkeys(runs, 1.0), 1.0))
    return rows, gains
