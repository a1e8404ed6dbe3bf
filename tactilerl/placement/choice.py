"""Taxels for handovers: chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .. import statistics
from ..envs import layouts, validation
from ..envs.grasp import GraspConfig
from ..envs.layouts import Layout
from ..pictures import hand_map
from ..scripted import gate
from . import cover
from .candidates import DesignFlags, Pool
from .cover import Starts
from .recording import record

CHOICE, TEST = 500_000, 750_000
"""Seeds of starts to choose from, and to judge on; those of the gate are others."""
RANDOM_SETS = 20
ByWait = dict[float, Starts]
"""Starts by how far the hand is closed while it waits."""
Tick = Callable[[], None]


@dataclass(frozen=True)
class Row:
    """Say how good a set of taxels is, in starts from which none was chosen."""

    layout: str
    """A layout, "whole skin", "chosen", "random": the mean of random sets, or "no
    touch": the best scripted hand without."""
    taxels: int
    success: float
    felt: float
    """Share of the starts that a taxel feels before the object is let go."""
    worst: float
    """Success after the loss that was the worst in the starts to choose from."""
    success_interval: tuple[float, float] | None = None
    """95 %."""
    worst_interval: tuple[float, float] | None = None
    """95 %."""
    lost: str | None = None
    """Name of that loss; None where no loss costs anything, and for random sets."""
    start_closing: float | None = None
    """Share by which the hand is closed while it waits; None for random sets."""
    price: float | None = None
    """Price of the chosen taxels and their boards."""
    is_knee: bool = False
    """True for the set from which on more taxels, or more money, gain little."""


class Pick(NamedTuple):
    """A set of taxels that was chosen."""

    key: float
    """Number of taxels, or with a budget the price."""
    n: int
    """Number of taxels; those that the hand has already do not count for it, nor for
    the price."""
    boards: int
    """Number of boards that these may take; 0 for any."""
    price: float | None
    taxels: list[int]
    """With those that the hand has already."""
    score: int
    """Its score in the starts to choose from (`cover.score`)."""
    success: float
    """Its success there."""


@dataclass(frozen=True)
class Judge:
    """Say what sets of taxels win in starts from which none of them was chosen.

    A set waits as suited it best in those to choose from.
    """

    pool: Pool
    choice: ByWait
    """The starts to choose from."""
    test: ByWait
    """Other starts, on which everything is judged."""

    def wait(self, taxels: Sequence[int]) -> float:
        """Return how far a hand with these taxels is closed while it waits."""
        losses = self.pool.to_survive
        scores = {w: cover.score(x, taxels, losses) for w, x in self.choice.items()}
        return max(scores, key=lambda wait: scores[wait])

    def row(self, layout: str, taxels: Sequence[int]) -> Row:
        """Return success, with its interval, share felt, and success after the worst loss.

        Which loss is the worst is found in the starts to choose from: in these, the
        least of several shares would be too low, and its interval as well. A set that
        was chosen for its worst loss has none there that stands out; for it, the least
        share is nearer to the truth, and not too high.
        """
        wait, losses = self.wait(taxels), self.pool.losses
        starts, found_in = self.test[wait], self.choice[wait]
        if layout == "chosen" and self.pool.flags.survives:
            found_in = starts
        _, lost = cover.worst_loss(found_in, taxels, losses.members)
        left = taxels
        if lost is not None:
            left = cover.without(taxels, losses.members[lost])
        success, worst = cover.value(starts, taxels), cover.value(starts, left)
        return Row(
            layout=layout,
            taxels=len(taxels),
            success=success,
            felt=float((cover.first_firing(starts, taxels) < starts.lets_go).mean()),
            worst=worst,
            success_interval=_interval(success, len(starts)),
            worst_interval=_interval(worst, len(starts)),
            lost=None if lost is None else losses.names[lost],
            start_closing=wait,
        )

    def random(self, n: int, boards: int) -> Row:
        """Return means over random sets of `n` taxels more, or as many as find room."""
        rng = np.random.default_rng([self.pool.flags.seed, n])
        sets = [drawn(n, self.pool, boards, rng) for _ in range(RANDOM_SETS)]
        rows = [self.row("random", taxels) for taxels in sets]
        means = np.mean([(row.success, row.felt, row.worst) for row in rows], axis=0)
        return Row("random", n, *means.tolist())


def _interval(rate: float, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate in `n` starts."""
    return statistics.wilson_interval(round(n * rate), n)


def drawn(n: int, pool: Pool, boards: int, rng: np.random.Generator) -> list[int]:
    """Draw taxels: those that the hand has, and up to `n` random ones that find room."""
    taxels = list(pool.existing)
    for taxel in rng.permutation(np.flatnonzero(pool.free)).tolist():
        if len(taxels) < len(pool.existing) + n and pool.fits(boards, taxels)[taxel]:
            taxels.append(taxel)
    return taxels


@dataclass(frozen=True)
class Design:
    """Hold the taxels that were chosen, and say how good they are."""

    judge: Judge
    chosen: dict[float, list[int]]
    """Chosen sets by number of taxels, or with a budget by price; with those that the
    hand has already, which do not count for either."""
    rows: list[Row]
    """The first is that of no touch."""
    blind_hand: str
    """Name of the best scripted hand without touch, in each scene if they differ."""

    @property
    def pool(self) -> Pool:
        """Hand, scenes and candidates."""
        return self.judge.pool

    @property
    def best(self) -> list[int]:
        """The largest set, or the dearest."""
        return self.chosen[max(self.chosen)]

    def sentences(self) -> list[str]:
        """Say whether touch pays, from which set on, and where more taxels gain little."""
        blind = self.rows[0].success
        chosen = [row for row in self.rows if row.layout == "chosen"]
        paying = [row for row in chosen if gate.pays(row.success, blind)]
        row = paying[0] if paying else max(chosen, key=lambda row: row.success)
        sensor, threshold = self.pool.flags.sensor, self.pool.first.taxel_threshold
        verdict = f"Touch {'pays' if paying else 'does not pay'}"
        if sensor:
            verdict += f" with {layouts.short(sensor)}"
        if threshold is not None:
            verdict += f" at {threshold:g} N"
        if paying and len(chosen) > 1:
            verdict += f" from {_taxels(row.taxels, row.price)} on"
        said = [
            f"{verdict}: with {_taxels(row.taxels, row.price)} chosen the hand succeeds in "
            f"{row.success:.2f} of the starts, the best one without touch ({self.blind_hand}, as the "
            f"gate finds it) in {blind:.2f}."
        ]
        said += gate.few(len(self.pool.scenes) * self.pool.flags.test_starts)
        most = chosen[-1]
        for row in chosen:
            if row.is_knee:
                said.append(
                    f"The knee is at {_taxels(row.taxels, row.price)}: {row.success:.2f}; "
                    f"{_taxels(most.taxels, most.price)} reach {most.success:.2f}."
                )
        return said

    def layout(self, key: float) -> Layout:
        """Return the layout of a chosen set, with the taxels that were there already."""
        pool, taxels = self.pool, self.chosen[key]
        n, scenes = len(taxels) - len(pool.existing), ", ".join(pool.scenes)
        about = f"{_taxels(n)} placed by tactilerl for {scenes}"
        return layouts.of_taxels(pool.skin.take(taxels), pool.hand, about)

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        pool, names = self.pool, validation.names(DesignFlags) - {"workers"}
        return {
            "env": pool.env,
            "threshold": pool.first.taxel_threshold,
            "asking": {name: getattr(pool.flags, name) for name in sorted(names)},
            "candidates": int(pool.free.sum()),
            "rows": [asdict(row) for row in self.rows],
            "verdict": " ".join(self.sentences()),
            "places": {
                f"{key:g}": [
                    place._asdict() for place in hand_map.places(pool.skin.take(taxels))
                ]
                for key, taxels in self.chosen.items()
            },
        }


def _taxels(n: int, price: float | None = None) -> str:
    """Return how many taxels, and what they cost."""
    cost = "" if price is None else f" for {price:g}"
    return f"{n} {'taxel' if n == 1 else 'taxels'}{cost}"


def design(pool: Pool, workers: int, tick: Tick = lambda: None) -> Design:
    """Choose taxels by which a hand succeeds that closes at the first touch.

    `tick` is called after every start and episode.
    """
    flags = pool.flags
    choice = _played(pool, CHOICE, flags.starts, workers, tick)
    # The same candidates for all ways to wait.
    early = np.any([starts.early for starts in choice.values()], axis=0)
    pool = pool.without(early)
    wait = max(choice, key=lambda wait: cover.value(choice[wait], pool.whole))
    blind, blind_hand = _blind(pool, wait, workers, tick)
    test = _played(pool, TEST, flags.test_starts, workers, tick)
    return judged(Judge(pool, choice, test), blind, blind_hand, wait)


def judged(judge: Judge, blind: float, blind_hand: str, wait: float) -> Design:
    """Return what is chosen from played starts, beside what it is compared with.

    The best hand without touch is `wait` closed while it waits, and has the success
    `blind`.
    """
    pool = judge.pool
    interval = _interval(blind, len(judge.test[wait]))
    no_touch = Row("no touch", 0, blind, 0.0, blind, interval, interval)
    rows = [replace(no_touch, start_closing=wait)]
    rows += [judge.row(name, taxels) for name, taxels in pool.references.items()]
    rows.append(judge.row("whole skin", pool.whole))
    picks = _picks(judge.choice, pool)
    successes = [pick.success for pick in picks]
    at = knee([0.0, *(pick.key for pick in picks)], [blind, *successes])
    for index, pick in enumerate(picks, 1):
        row = replace(
            judge.row("chosen", pick.taxels),
            taxels=pick.n,
            price=pick.price,
            is_knee=index == at < len(picks),
        )
        rows += [row, judge.random(pick.n, pick.boards)]
    return Design(judge, {pick.key: pick.taxels for pick in picks}, rows, blind_hand)


def n_played(pool: Pool) -> int:
    """Return the number of starts and episodes that a design plays, more or less."""
    flags = pool.flags
    n_starts = len(pool.waits) * (flags.starts + flags.test_starts)
    n_senses = len(gate.BLIND) - 1  # for most scenes let nobody see
    n_blind = n_senses * gate.n_played(flags.test_starts, _search(flags))
    return len(flags.scene) * (n_starts + n_blind)


def _blind(pool: Pool, wait: float, workers: int, tick: Tick) -> tuple[float, str]:
    """Return the success of the best scripted hand without touch, and which it is.

    It is chosen in the starts from which the gate chooses it, and judged where taxels
    are. The success is the mean over scenes, each with the hand that is best there.
    """
    flags = pool.flags
    searched = gate.numbers(flags.seed, _search(flags), gate.SEARCH)
    compared = gate.numbers(flags.seed, flags.test_starts, TEST)
    played = searched, compared, workers, tick, gate.BLIND
    found = [
        gate.without_touch(gate.examine(pool.env, scene, *played))
        for scene in _waiting(pool, wait)
    ]
    rate = sum(hand.rate for hand in found) / len(found)
    return rate, ", ".join(dict.fromkeys(hand.name for hand in found))


def _search(flags: DesignFlags) -> int:
    """Return how many starts each candidate of a sense plays: with 200 starts as many as the gate's."""
    return max(1, flags.starts // 10)


def _played(pool: Pool, first: int, n: int, workers: int, tick: Tick) -> ByWait:
    """Play `n` starts of each scene with the whole skin, for each way to wait."""
    numbers = gate.numbers(pool.flags.seed, n, first)
    return {
        wait: record(pool.env, _waiting(pool, wait), pool.skin, numbers, workers, tick)
        for wait in pool.waits
    }


def _waiting(pool: Pool, wait: float) -> list[GraspConfig]:
    """Return the scenes with a hand that is so far closed while it waits."""
    return [replace(scene, start_closing=wait) for scene in pool.scenes.values()]


def _picks(choice: ByWait, pool: Pool) -> list[Pick]:
    """Choose the best set of each size that is asked for, of all ways to wait.

    Within a budget these are the sets that no cheaper one reaches. Raise ValueError
    where there is no room for as many taxels as are asked for.
    """
    size, n_existing = len(pool.free), len(pool.existing)
    losses = pool.to_survive[:, :size]
    picks = []
    for n, boards in pool.sizes():
        fits = partial(pool.fits, boards)
        sets = []
        for starts in choice.values():
            starts = replace(starts, fires=starts.fires[:, :size])
            taxels = cover.choose(starts, n_existing + n, pool.existing, fits, losses)
            success = cover.value(starts, taxels)
            sets.append((cover.score(starts, taxels, losses), success, taxels))
        score, success, taxels = max(sets, key=lambda found: (len(found[2]), found[0]))
        placed = taxels[n_existing:]
        price = pool.prices.of(placed) if pool.prices else None
        key = len(placed) if pool.flags.budget is None or price is None else price
        picks.append(Pick(key, len(placed), boards, price, taxels, score, success))
    if (most := max(pick.n for pick in picks)) < pool.needed:
        raise ValueError(
            f"taxels: found {pool.needed}, allowed up to {most}; no room was found for more"
        )
    if pool.flags.budget is None:
        return picks
    better: list[Pick] = []
    for pick in sorted(picks, key=lambda pick: (pick.key, -pick.score)):
        if not better or pick.score > better[-1].score:
            better.append(pick)
    return better


def knee(prices: Sequence[float], successes: Sequence[float]) -> int:
    """Return the index from which on more money buys little.

    It is the point that is furthest above the line from the first to the last (Satopää
    et al. 2011, "Finding a 'kneedle' in a haystack"). The first is what one has for
    nothing.
    """
    x, y = (np.asarray(values, float) for values in (prices, successes))
    run, rise = max(x[-1] - x[0], 1e-9), max(y[-1] - y[0], 1e-9)
    return int(np.argmax((y - y[0]) / rise - (x - x[0]) / run))
