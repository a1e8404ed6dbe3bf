"""Which taxels should a hand have that closes at the first touch? Pure functions of recorded starts.

A start counts for a set of taxels where the first of them to fire does so at a moment from which
closing succeeds. Where no taxel fires too early, that is maximum coverage (Nemhauser, Wolsey and
Fisher 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import optimize, sparse

from ..envs.state import Array

NEVER = 255
"""The moment of what does not happen; moments are numbers of actions."""
MEMORY = 20_000_000  # numbers handled at once
ROUNDS = 20  # of swaps, which settle long before
NODES = 200  # of a search by branch and bound


@dataclass(frozen=True)
class Starts:
    """What happens in each of some starts while the hand waits, and what would if it closed."""

    fires: Array
    """(n, m) uint8: after how many actions each taxel fires first, or NEVER."""
    succeeds: Array
    """(n, NEVER + 1) bool: does a hand succeed that closes after so many actions? False where nobody
    asked, and for NEVER."""
    sets_off: Array
    """(n,) before which action the object begins to come."""
    lets_go: Array
    """(n,) before which action it is let go."""
    weights: Array
    """(n,) of each start; they sum to 1."""

    def __len__(self) -> int:
        return len(self.fires)

    def take(self, taxels: Sequence[int]) -> Starts:
        return replace(self, fires=self.fires[:, list(taxels)])

    @property
    def good(self) -> Array:
        """(n, m) bool: does each taxel fire first at a moment from which closing succeeds?"""
        return self.succeeds[np.arange(len(self))[:, None], self.fires]

    @property
    def worth(self) -> Array:
        """(m,) in [0, 1]: the share of starts that each taxel alone would win. Of sets that are equally
        good, the one whose taxels feel more is the likelier to feel starts that nobody has seen."""
        return np.asarray(self.weights @ self.good)

    @property
    def early(self) -> Array:
        """(m,) bool: taxels that fire in any start before the object has set off."""
        return np.asarray((self.fires < self.sets_off[:, None]).any(axis=0))

    def felt(self, taxels: Sequence[int]) -> Array:
        """(n,) bool: does one of these taxels fire before the object is let go?"""
        return self.fires[:, list(taxels)].min(axis=1, initial=NEVER) < self.lets_go


class Aim(NamedTuple):
    """What is asked of a set of taxels."""

    redundancy: int = 1
    """By how many taxels a start is to be felt in time: any `redundancy - 1` may be dead."""
    dead: float = 0.0
    """Probability that a taxel never fires."""
    false_on: float = 0.0
    """Probability that a taxel that works fires in a step without being touched."""

    @property
    def is_certain(self) -> bool:
        return not (self.dead or self.false_on)


FIRST = Aim()


class Chosen(NamedTuple):
    """A set of taxels, and how good any could be."""

    taxels: list[int]
    value: float
    """Share of the starts that count, or the probability of that."""
    bound: float | None
    """No set of as many has more; None where nobody knows."""


def scores(starts: Starts, sets: Array, aim: Aim) -> Array:
    """(n, s): does each start count for each set of taxels (s, k)? With faults, how probably?"""
    if not sets.shape[1]:
        return np.zeros((len(starts), len(sets)))
    step = max(
        1, MEMORY // (len(starts) * (sets.shape[1] if aim.is_certain else NEVER))
    )
    parts = [sets[i : i + step] for i in range(0, len(sets), step)]
    score = _certain if aim.is_certain else _expected
    return np.concatenate([score(starts, part, aim) for part in parts], axis=1)


def _certain(starts: Starts, sets: Array, aim: Aim) -> Array:
    first = starts.fires[:, sets]
    rows = np.arange(len(starts))[:, None]
    if aim.redundancy == 1:
        return starts.succeeds[rows, first.min(axis=2)].astype(float)
    if sets.shape[1] < aim.redundancy:
        return np.zeros(first.shape[:2])
    first = np.sort(first, axis=2)[:, :, : aim.redundancy]  # whichever of them are dead
    return starts.succeeds[rows[:, :, None], first].all(axis=2).astype(float)


def _expected(starts: Starts, sets: Array, aim: Aim) -> Array:
    """By how probably none has fired after each number of actions."""
    moments = np.arange(NEVER)
    silent = (1.0 - aim.false_on) ** (moments + 1.0)
    none = np.ones((len(starts), len(sets), NEVER))
    for column in sets.T:
        is_before = moments < starts.fires[:, column, None]
        none *= aim.dead + (1.0 - aim.dead) * silent * is_before
    fires = -np.diff(none, axis=2, prepend=1.0)
    return np.asarray(
        np.einsum("nst,nt->ns", fires, starts.succeeds[:, :NEVER].astype(float))
    )


def value(starts: Starts, taxels: Sequence[int], aim: Aim = FIRST) -> float:
    """Share of the starts that count for these taxels."""
    return float(
        starts.weights @ scores(starts, np.array([list(taxels)], int), aim)[:, 0]
    )


def greedy(
    starts: Starts,
    k: int,
    aim: Aim = FIRST,
    kept: Sequence[int] = (),
    rounds: int = ROUNDS,
    overlap: Array | None = None,
) -> list[int]:
    """`k` taxels one after another, then up to `rounds` swaps as long as one gains something; those
    `kept` stay, and no two are chosen that `overlap`, bool (m, m). ValueError where there is no
    room."""
    chosen, every, ties = list(kept), np.arange(starts.fires.shape[1]), starts.worth
    overlap = np.zeros((len(every),) * 2, bool) if overlap is None else overlap

    def best(rests: list[list[int]], redundancy: int) -> tuple[float, list[int]]:
        free = [(rest, every[~overlap[rest].any(axis=0)]) for rest in rests]
        sets = np.array(
            [[*rest, j] for rest, own in free for j in own if j not in rest], int
        )
        if not len(sets):
            room = (
                f"{len(chosen) - len(kept)}; there is no room for more of this radius"
            )
            raise ValueError(f"taxels: found {k - len(kept)}, allowed up to {room}")
        found = starts.weights @ scores(
            starts, sets, aim._replace(redundancy=redundancy)
        )
        at = int(np.argmax(found.round(12) + 1e-9 * ties[sets[:, -1]]))
        return float(found[at]), sets[at].tolist()

    while (
        len(chosen) < k
    ):  # of several that must feel a start, the first alone gain nothing
        _, chosen = best([chosen], min(aim.redundancy, len(chosen) + 1))
    for _ in range(rounds):
        rests = [[i for i in chosen if i != out] for out in chosen if out not in kept]
        found, swapped = best(rests, aim.redundancy) if rests else (0.0, chosen)
        if found <= value(starts, chosen, aim) + 1e-12:
            break
        chosen = swapped
    return chosen


def choose(
    starts: Starts,
    k: int,
    aim: Aim = FIRST,
    kept: Sequence[int] = (),
    overlap: Array | None = None,
) -> Chosen:
    """The best `k` taxels of which no two `overlap`, by mixed-integer programming; where that takes
    more than `NODES` nodes of the search, or taxels may fail, by `greedy`, and then with a bound or
    without."""
    # With dead taxels a set is worth a mean over its subsets, so no more than the best without.
    redundancy = aim.redundancy if aim.is_certain else 1
    exact = partial(_exact, starts, k, redundancy, kept, overlap)
    try:
        found = greedy(starts, k, aim, kept, overlap=overlap)
    except ValueError:  # it left no room for as many, which there may be
        if (fitting := exact()[0]) is None:
            raise
        found = fitting
    least = value(starts, found, aim)
    if aim.false_on:
        return Chosen(sorted(found), least, None)
    taxels, bound = exact()
    if taxels is not None and (reached := value(starts, taxels, aim)) >= least - 1e-12:
        found, least = taxels, reached
    return Chosen(
        sorted(found), least, max(bound, least) if bound is not None else None
    )


def _exact(
    starts: Starts,
    k: int,
    redundancy: int,
    kept: Sequence[int],
    overlap: Array | None,
) -> tuple[list[int] | None, float | None]:
    """Taxels and bound. A variable for each taxel, and for each start one for each run of moments
    between those that are too early: which of them holds the first firings?"""
    rows, gains = _constraints(starts, redundancy)
    m, n = starts.fires.shape[1], len(gains)
    if not n:
        return None, 0.0
    pairs = [] if overlap is None else np.argwhere(np.triu(overlap)).tolist()
    rows += [([1.0, 1.0], pair, 1.0) for pair in pairs if not {*pair} <= {*kept}]
    lower, upper = np.zeros(m + n), np.ones(m + n)
    lower[list(kept)] = 1.0
    ties = 0.1 * starts.weights.min() / k * starts.worth
    data, columns, limits = zip(*rows, strict=True)
    pointers = np.cumsum([0, *map(len, columns)])
    matrix = sparse.csr_array(
        (np.concatenate(data), np.concatenate(columns), pointers),
        shape=(len(rows), m + n),
    )
    size = sparse.csr_array(np.r_[np.ones(m), np.zeros(n)][None])
    found = optimize.milp(
        -np.r_[ties, gains],
        integrality=np.r_[np.ones(m), np.full(n, redundancy > 1)],
        bounds=optimize.Bounds(lower, upper),
        constraints=[
            optimize.LinearConstraint(matrix, -np.inf, np.array(limits)),
            optimize.LinearConstraint(size, k, k),
        ],
        options={"node_limit": NODES, "mip_rel_gap": 1e-6},
    )
    bound = None if found.mip_dual_bound is None else float(-found.mip_dual_bound)
    if bound is None or not np.isfinite(bound):
        bound = None
    elif np.ptp(starts.weights) == 0.0:  # whole starts
        bound = int(bound * len(starts) + 1e-6) / len(starts)
    return None if found.x is None else np.flatnonzero(
        found.x[:m] > 0.5
    ).tolist(), bound


def _constraints(
    starts: Starts, redundancy: int
) -> tuple[list[tuple[list[float], list[int], float]], list[float]]:
    """Rows (coefficients, columns, upper limit) of a matrix, and the weight of each start's variables;
    starts in which the same happens count together."""
    m, good = starts.fires.shape[1], starts.good
    patterns, which = np.unique(
        np.hstack([starts.fires, good]), axis=0, return_inverse=True
    )
    weights = np.bincount(which.reshape(-1), starts.weights)
    rows: list[tuple[list[float], list[int], float]] = []
    gains: list[float] = []
    for pattern, weight in zip(patterns, weights, strict=True):
        own: list[tuple[int, int]] = []
        early: list[int] = []
        fires, is_good = pattern[:m], pattern[m:].astype(bool)
        for moment in np.unique(fires[is_good]):
            late = np.flatnonzero(~is_good & (fires < moment))
            so_far = np.flatnonzero(is_good & (fires <= moment)).tolist()
            if own and len(late) == len(early):  # the same run goes on
                rows[own[-1][1]] = _cover(so_far, own[-1][0], redundancy)
                continue
            early = late.tolist()
            z = m + len(gains)
            gains.append(float(weight))
            own.append((z, len(rows)))
            rows.append(_cover(so_far, z, redundancy))
            rows += [([1.0, 1.0], [j, z], 1.0) for j in early]
        if len(own) > 1:
            rows.append(([1.0] * len(own), [z for z, _ in own], 1.0))
    return rows, gains


def _cover(
    taxels: list[int], z: int, redundancy: int
) -> tuple[list[float], list[int], float]:
    """z may be 1 where `redundancy` of the taxels are chosen."""
    return [-1.0] * len(taxels) + [float(redundancy)], [*taxels, z], 0.0
