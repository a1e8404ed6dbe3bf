"""Choose taxels for a hand that closes at the first touch: pure functions of recorded starts.

A start counts for a set of taxels where the first of them to fire does so at a moment from which
closing succeeds. Where no taxel fires too early, that is maximum coverage (Nemhauser, Wolsey and
Fisher 1978). Losses, bool (g, m), say which taxels fail together: each row is a taxel, a digit, or
what shares a board. What counts then is success after the worst of them, and among equals success
without any.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from ..envs.state import Array

NEVER = 255
"""The moment of what does not happen; moments are numbers of actions."""
MAX_SWAPS = 20  # which settle long before
FIRSTS = 4  # taxels with which a search begins
TIE_WEIGHT = (
    1e-9  # what the worth of a taxel counts for among sets that are equally good
)
EQUAL_SHARES = 1e-12  # difference of shares that are equal
INTACT = 1e-6  # what success without a loss counts for among sets whose worst losses are equal
Fits = Callable[[Sequence[int]], Array]
"""Tells which other taxels there is room for beside some, bool (m,)."""


@dataclass(frozen=True)
class Starts:
    """Record of some starts: when each taxel fires while the hand waits, and when closing succeeds."""

    fires: Array
    """(n, m) uint8: after how many actions each taxel fires first, or NEVER."""
    succeeds: Array
    """(n, NEVER + 1) bool: does a hand succeed that closes after so many actions? False where
    nobody asked, and for NEVER."""
    sets_off: Array
    """(n, m) before which action no reading of each taxel can tell that the object comes."""
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
        return np.asarray((self.fires < self.sets_off).any(axis=0))


class Chosen(NamedTuple):
    """A set of taxels, and how good it is."""

    taxels: list[int]
    worst: float
    """Share of the starts that count after the worst loss that was thought of."""
    value: float
    """The same without a loss."""


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
    fits: Fits,
    losses: Array,
    first: Sequence[int],
) -> list[int]:
    """Add to the taxels `first` until there are `k`, then swap as long as that gains something.

    Those `existing` stay. Return nothing where there is no room for as many.
    """
    n_taxels = starts.fires.shape[1]
    ties = TIE_WEIGHT * starts.worth
    chosen = list(first)

    def best_addition(rests: list[list[int]]) -> list[int]:
        """Return the best set that is one of the `rests` and one taxel more, or nothing."""
        scores = np.full((len(rests), n_taxels), -np.inf)
        for rest, row in zip(rests, scores, strict=True):
            is_free = fits(rest)
            each = scores_with_each(starts, rest, losses).round(12) + ties
            row[is_free] = each[is_free]
        index, taxel = divmod(int(np.argmax(scores)), n_taxels)
        return [*rests[index], taxel] if np.isfinite(scores[index, taxel]) else []

    while len(chosen) < k:
        chosen = best_addition([chosen])
        if not chosen:
            return []
    for _ in range(MAX_SWAPS):
        swapped = best_addition(
            [[i for i in chosen if i != out] for out in chosen if out not in existing]
        )
        gain = score(starts, swapped, losses) - score(starts, chosen, losses)
        if gain <= EQUAL_SHARES:
            break
        chosen = swapped
    return chosen


def packed(k: int, existing: Sequence[int], fits: Fits) -> list[int]:
    """Return `k` taxels, or as many as find room, each of which leaves as much for others as it can."""
    chosen = list(existing)
    while len(chosen) < k and (is_free := fits(chosen)).any():
        free = np.flatnonzero(is_free).tolist()
        chosen.append(max(free, key=lambda taxel: fits([*chosen, taxel]).sum()))
    return chosen


def choose(
    starts: Starts,
    k: int,
    existing: Sequence[int] = (),
    fits: Fits | None = None,
    losses: Array | None = None,
) -> Chosen:
    """Choose the best `k` taxels that are found and fit (default: all do).

    The search begins with the `existing` ones alone, with each of the few that are worth most, and with
    losses also with the best set for none. Of fewer taxels than `k` there is no room for more.
    """
    n_taxels = starts.fires.shape[1]
    if fits is None:
        fits = partial(others, n_taxels)
    is_free, firsts = fits(existing), [list(existing)]
    for taxel in np.argsort(-starts.worth, kind="stable")[:FIRSTS].tolist():
        if is_free[taxel]:
            firsts.append([*existing, taxel])
    if losses is None:
        losses = np.zeros((0, n_taxels), bool)
    if len(losses):
        firsts.append(choose(starts, k, existing, fits).taxels)
    sets = [greedy(starts, k, existing, fits, losses, first) for first in firsts]
    if not any(sets):
        first = packed(k, existing, fits)
        sets = [greedy(starts, len(first), existing, fits, losses, first)]
    best = max(
        filter(None, sets), key=lambda taxels: round(score(starts, taxels, losses), 12)
    )
    worst, _ = worst_loss(starts, best, losses)
    return Chosen(sorted(best), worst, value(starts, best))


def others(n: int, taxels: Sequence[int]) -> Array:
    """Tell which of `n` taxels are none of these, bool (n,)."""
    return ~np.isin(np.arange(n), taxels)
