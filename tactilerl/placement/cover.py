"""Choose taxels for a hand that closes at the first touch: pure functions of recorded starts.

A start counts for a set of taxels where the first of them to fire does so at a moment
from which closing succeeds. Where no taxel fires too early, that is maximum coverage
(Nemhauser, Wolsey and Fisher 1978). Losses, bool (g, m), say which taxels fail
together: each row is a taxel, a digit, or what shares a board. What counts then is
success after the worst of them, and among equals success without any. Numbers of starts
are compared, not shares, so that equals are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..envs.state import Array

NEVER = 255
"""The moment of what does not happen; moments are numbers of actions."""
FIRSTS = 4  # taxels with which a search begins
Fits = Callable[[Sequence[int]], Array]
"""Tells which other taxels there is room for beside some, bool (m,)."""


@dataclass(frozen=True)
class Starts:
    """Record of some starts: when each taxel fires while the hand waits, and when closing succeeds."""

    fires: Array
    """(n, m) uint8: after how many actions each taxel fires first, or NEVER."""
    succeeds: Array
    """(n, NEVER + 1) bool: does a hand succeed that closes after so many actions? False
    where nobody asked, and for NEVER."""
    sets_off: Array
    """(n,) before which action no reading can tell that the object comes."""
    lets_go: Array
    """(n,) before which action it is let go."""

    def __len__(self) -> int:
        """Return how many starts these are."""
        return len(self.fires)

    @property
    def worth(self) -> Array:
        """(m,) in [0, 1]: the share of starts that each taxel alone would win."""
        return np.asarray(self.wins_at(self.fires) / len(self))

    @property
    def early(self) -> Array:
        """(m,) bool: taxels that fire in any start before the object has set off."""
        return np.asarray((self.fires < self.sets_off[:, None]).any(axis=0))

    def wins_at(self, moments: Array) -> Array:
        """Return how many starts are won by closing at moments (n, m); (m,) int."""
        return np.asarray(self.succeeds[np.arange(len(self))[:, None], moments].sum(0))


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
) -> tuple[int, int | None]:
    """Return how many starts a hand with these taxels wins after the worst loss.

    The second value is which loss that is; None where no loss costs anything.
    """
    least, worst = int(successes(starts, taxels).sum()), None
    for index in np.flatnonzero(losses[:, list(taxels)].any(axis=1)).tolist():
        after = int(successes(starts, without(taxels, losses[index])).sum())
        if after < least:
            least, worst = after, index
    return least, worst


def score(starts: Starts, taxels: Sequence[int], losses: Array) -> int:
    """Return what is maximised: success after the worst loss, and then success."""
    least, _ = worst_loss(starts, taxels, losses)
    return least * (len(starts) + 1) + int(successes(starts, taxels).sum())


def scores_with_each(starts: Starts, taxels: Sequence[int], losses: Array) -> Array:
    """Return the `score` of these taxels together with each other one, (m,) int."""

    def wins_with_each(some: Sequence[int]) -> Array:
        moments = np.minimum(first_firing(starts, some)[:, None], starts.fires)
        return starts.wins_at(moments)

    wins = wins_with_each(taxels)
    is_hit = losses[:, list(taxels)].any(axis=1)
    # Of the other losses, only the new taxel is part.
    is_hit_alone = losses[~is_hit].any(axis=0)
    alone = successes(starts, taxels).sum()
    least = np.where(is_hit_alone, np.minimum(wins, alone), wins)
    for lost in losses[is_hit]:
        left = without(taxels, lost)
        after = np.where(lost, successes(starts, left).sum(), wins_with_each(left))
        least = np.minimum(least, after)
    return np.asarray(least * (len(starts) + 1) + wins)


def greedy(
    starts: Starts,
    k: int,
    existing: Sequence[int],
    fits: Fits,
    losses: Array,
    first: Sequence[int],
) -> list[int]:
    """Add to the taxels `first` until there are `k`, then swap as long as that gains something.

    Those `existing` stay. There may be no room for as many.
    """
    # Of equally good sets, the one whose taxels feel more is the likelier to feel
    # unseen starts.
    ties = 0.5 * starts.worth

    def best_addition(rests: list[list[int]]) -> list[int]:
        """Return the best set that is one of the `rests` and one taxel more, or nothing."""
        scores = np.full((len(rests), len(ties)), -1.0)
        for rest, row in zip(rests, scores, strict=True):
            row[:] = np.where(
                fits(rest), scores_with_each(starts, rest, losses) + ties, -1.0
            )
        if scores.max(initial=-1.0) < 0:
            return []
        index, taxel = divmod(int(scores.argmax()), len(ties))
        return [*rests[index], taxel]

    chosen = list(first)
    while len(chosen) < k and (more := best_addition([chosen])):
        chosen = more
    while True:
        swapped = best_addition(
            [[i for i in chosen if i != out] for out in chosen if out not in existing]
        )
        if score(starts, swapped, losses) <= score(starts, chosen, losses):
            return chosen
        chosen = swapped


def choose(
    starts: Starts, k: int, existing: Sequence[int], fits: Fits, losses: Array
) -> list[int]:
    """Return the best `k` taxels that are found and fit, or as many as were found to have room.

    The search begins with the `existing` ones alone, with each of the few that are
    worth most, and with losses also with the best set for none.
    """
    is_free, firsts = fits(existing), [list(existing)]
    for taxel in np.argsort(-starts.worth, kind="stable")[:FIRSTS].tolist():
        if is_free[taxel]:
            firsts.append([*existing, taxel])
    if len(losses):
        firsts.append(choose(starts, k, existing, fits, losses[:0]))
    sets = [greedy(starts, k, existing, fits, losses, first) for first in firsts]
    best = max(sets, key=lambda taxels: (len(taxels), score(starts, taxels, losses)))
    return sorted(best)
