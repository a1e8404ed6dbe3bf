"""Taxels for handovers: chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from .. import statistics
from ..envs import layouts, validation
from ..envs.layouts import Layout
from ..pictures import places
from ..scripted import gate
from . import cover
from .candidates import DesignFlags, Pool, waiting
from .cover import Starts
from .recording import record

CHOICE, TEST = 500_000, 750_000
"""Seeds of starts to choose from, and to judge on; those of the gate are others."""
RANDOM_SETS = 20
N_RESAMPLES = 10_000
ByWait = dict[float | None, Starts]
"""Starts by how far the hand is closed while it waits; None for as the scene has it."""
Tick = Callable[[], None]


@dataclass(frozen=True)
class Row:
    """Say how good a set of taxels is, in starts from which none was chosen."""

    layout: str
    """A layout, "whole skin", "chosen", or "random": the mean of random sets."""
    taxels: int
    success: float
    felt: float
    """Share of the starts that a taxel feels before the object is let go."""
    worst: float
    """Success after the worst loss."""
    success_interval: tuple[float, float] | None = None
    """95 %."""
    worst_interval: tuple[float, float] | None = None
    """95 %."""
    lost: str | None = None
    """The worst loss; None where no loss costs anything, and for random sets."""
    start_closing: float | None = None
    """Share by which the hand is closed while it waits; None for as the scene has it."""
    chosen_from: float | None = None
    """Success in the starts from which these taxels were chosen."""
    chosen_worst: float | None = None
    """The same after the worst loss, where they were chosen for that."""
    bound: float | None = None
    """No set of as many has more of what they were chosen for in those; 1 where nobody knows."""
    difference: tuple[float, float, float] | None = None
    """Success less that of the best layout, and its 95 % interval."""
    threshold: float | None = None
    """Force from which a taxel fires, N; None for what the scene or the layout says."""


class Use(NamedTuple):
    """Say what touch has to win, in the starts to choose from."""

    threshold: float | None
    """Force from which a taxel fires, N; None for what the scene or the layout says."""
    touch: float
    """Success of a hand that feels with all candidates."""
    blind: float
    """Success of the best scripted hand that waits and goes by its joints or sight."""


@dataclass(frozen=True)
class Design:
    """Hold the taxels that were chosen, and say how good they are."""

    pool: Pool
    choice: ByWait
    """The starts to choose from."""
    test: ByWait
    """Other starts, on which everything is judged."""
    chosen: dict[int, list[int]]
    """Columns of the skin by number of taxels; those that the hand has already come on top."""
    best: str | None
    """The layout with the most success, of those to compare with."""
    rows: list[Row]
    """Rows for each threshold after the other."""
    uses: list[Use]
    """Uses of touch for each threshold. The fields before `rows` are of the first."""

    def layout(self, n: int) -> Layout:
        """Return a layout of `n` taxels, and those that were there already."""
        about = f"{n} {'taxel' if n == 1 else 'taxels'} placed by tactilerl for "
        taxels = self.pool.skin.take(self.chosen[n])
        return layouts.of_taxels(
            taxels, self.pool.hand, about + ", ".join(self.pool.scenes)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        pool, names = self.pool, validation.names(DesignFlags) - {"workers"}
        return {
            "about": "taxels placed by tactilerl",
            "env": pool.env,
            "simulator": next(iter(pool.scenes.values())).simulator,
            "asking": {name: getattr(pool.flags, name) for name in sorted(names)},
            "candidates": len(pool.free),
            "early": pool.early,
            "beside": self.best,
            "rows": [asdict(row) for row in self.rows],
            "uses": [use._asdict() for use in self.uses],
            "places": {
                n: [place._asdict() for place in places.of(pool.skin.take(columns))]
                for n, columns in self.chosen.items()
            },
        }


def design(flags: DesignFlags, workers: int, tick: Tick = lambda: None) -> Design:
    """Choose taxels by which a hand succeeds that closes at the first touch.

    `tick` is called after every start that is played. Raise ValueError where touch cannot help, or for
    a scene in which nothing is handed over.
    """
    pool = Pool.of(flags)
    choices = _played(pool, CHOICE, flags.starts, workers, tick)
    # The same candidates for all ways to wait.
    pools = [
        pool.without(np.any([starts.early for starts in choice.values()], axis=0))
        for choice in choices
    ]
    blind, uses = cache(partial(_blind, pool, workers)), []
    for threshold, choice, each in zip(flags.thresholds, choices, pools, strict=True):
        rates = {wait: cover.value(choice[wait], each.columns) for wait in choice}
        wait = max(rates, key=rates.__getitem__)
        uses.append(Use(threshold, rates[wait], blind(wait)))
    if not any(gate.pays(use.touch, use.blind) for use in uses):
        best = max(uses, key=lambda use: use.touch)
        raise ValueError(
            "scene: touch cannot help here: a hand that goes by its joints or sight succeeds in "
            f"{best.blind:.2f} of the starts, one that feels with all candidates in {best.touch:.2f}"
        )
    tests = _played(pool, TEST, flags.test_starts, workers, tick)
    designs = [
        _judged(*parts, uses)
        for parts in zip(flags.thresholds, pools, choices, tests, strict=True)
    ]
    return replace(designs[0], rows=[row for each in designs for row in each.rows])


def _blind(pool: Pool, workers: int, wait: float | None) -> float:
    """Return the success of the best hand that goes by its joints or sight, the mean over scenes."""
    n = min(pool.flags.starts, 100)
    examine = partial(
        gate.examine, pool.env, starts=n, search=max(1, n // 20), seed=0, workers=workers,
        senses=("joints", "sight"),
    )  # fmt: skip
    scenes = [waiting(scene, wait) for scene in pool.scenes.values()]
    hands = [gate.without_touch(examine(scene)) for scene in scenes]
    return sum(hand.rate for hand in hands) / len(hands)


def _played(pool: Pool, first: int, n: int, workers: int, tick: Tick) -> list[ByWait]:
    """Play `n` starts of each scene with the whole skin, for each way to wait.

    Return them for each threshold.
    """
    flags = pool.flags
    first += 2 * gate.SEARCH * flags.seed
    played: list[ByWait] = [{} for _ in flags.thresholds]
    for wait in flags.waits:
        scenes = [waiting(scene, wait) for scene in pool.scenes.values()]
        recordings = record(
            pool.env, scenes, pool.skin, range(first, first + n), workers, tick, flags.thresholds
        )  # fmt: skip
        for by_wait, starts in zip(played, recordings, strict=True):
            by_wait[wait] = starts
    return played


def _judged(
    threshold: float | None,
    pool: Pool,
    choice: ByWait,
    test: ByWait,
    uses: list[Use],
) -> Design:
    """Return what is chosen for one threshold, beside what it is compared with."""
    judge = Judge(choice, test, pool)
    rows = [judge.row(name, columns) for name, columns in pool.references.items()]
    best = max(rows, key=lambda row: row.success).layout if rows else None
    rows.append(judge.row("whole skin", pool.columns))
    chosen = {}
    for n in pool.flags.numbers:
        picked = _choose(choice, pool, n)
        columns = chosen[n] = [pool.columns[i] for i in picked.taxels]
        row = replace(
            judge.row("chosen", columns),
            taxels=n,
            chosen_from=picked.value,
            chosen_worst=picked.worst if pool.flags.survives else None,
            bound=picked.bound,
            difference=judge.difference(columns, pool.references[best])
            if best
            else None,
        )
        rng = np.random.default_rng([pool.flags.seed, n])
        rows += [row, judge.random(n, rng)]
    rows = [replace(row, threshold=threshold) for row in rows]
    return Design(pool, choice, test, chosen, best, rows, uses)


def _choose(choice: ByWait, pool: Pool, n: int) -> cover.Chosen:
    """Choose the best `n` taxels of all ways to wait, with the bound of all."""
    losses = pool.losses.members[:, pool.columns] if pool.flags.survives else None
    sets = []
    for starts in choice.values():
        starts = replace(starts, fires=starts.fires[:, pool.columns])
        n_all, existing = n + len(pool.existing), range(len(pool.existing))
        sets.append(cover.choose(starts, n_all, existing, pool.overlap, losses))
    best = max(sets, key=lambda chosen: (chosen.worst, chosen.value))
    return best._replace(bound=max(chosen.bound for chosen in sets))


class Judge:
    """Say what sets of taxels win in starts from which none of them was chosen.

    A set waits as suited it best in those to choose from.
    """

    def __init__(self, choice: ByWait, test: ByWait, pool: Pool) -> None:
        """Take starts to choose from and to judge on, and what may be lost."""
        self._choice, self._test, self._pool = choice, test, pool
        self._losses = pool.losses.members
        rng, n_scenes = np.random.default_rng(0), len(pool.scenes)
        n = len(next(iter(test.values()))) // n_scenes
        # Within each scene: which ones there are is not by chance.
        counts = [statistics.resample(rng, n, N_RESAMPLES) for _ in range(n_scenes)]
        self._counts = np.vstack(counts)

    def wait(self, taxels: Sequence[int]) -> float | None:
        """Return the share by which the hand is closed meanwhile; None for as the scene has it."""
        losses = self._losses if self._pool.flags.survives else self._losses[:0]
        scores = {
            wait: round(cover.score(starts, taxels, losses), 12)
            for wait, starts in self._choice.items()
        }
        return max(scores, key=scores.__getitem__)

    def row(self, layout: str, taxels: Sequence[int]) -> Row:
        """Return success, with its interval, share felt, and the same after the worst loss."""
        wait = self.wait(taxels)
        starts = self._test[wait]
        worst, lost = cover.worst_loss(starts, taxels, self._losses)
        success = cover.value(starts, taxels)
        return Row(
            layout=layout,
            taxels=len(taxels),
            success=success,
            felt=float((cover.first_firing(starts, taxels) < starts.lets_go).mean()),
            worst=worst,
            success_interval=_interval(success, len(starts)),
            worst_interval=_interval(worst, len(starts)),
            lost=None if lost is None else self._pool.losses.names[lost],
            start_closing=wait,
        )

    def random(self, n: int, rng: np.random.Generator) -> Row:
        """Return means over random sets of `n` taxels, or as many as find room."""
        sets = [drawn(n, self._pool, rng) for _ in range(RANDOM_SETS)]
        rows = [self.row("random", taxels) for taxels in sets]
        means = np.mean([(row.success, row.felt, row.worst) for row in rows], axis=0)
        return Row("random", n, *means.tolist())

    def difference(self, a: Sequence[int], b: Sequence[int]) -> statistics.Estimate:
        """Return the success of `a` less that of `b` in the same starts, with its interval."""
        won = [
            cover.successes(self._test[self.wait(taxels)], taxels).astype(float)
            for taxels in (a, b)
        ]
        return statistics.mean(won[0] - won[1], self._counts)


def _interval(rate: float, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate in `n` starts."""
    return statistics.wilson_interval(round(n * rate), n)


def drawn(n: int, pool: Pool, rng: np.random.Generator) -> list[int]:
    """Draw columns: those that the hand has, and `n` random ones that do not overlap."""
    if pool.overlap is None:
        return pool.existing + rng.choice(pool.free, n, replace=False).tolist()
    n_existing, columns = len(pool.existing), pool.columns
    taxels = list(range(n_existing))
    for taxel in n_existing + rng.permutation(len(pool.free)):
        if len(taxels) < n_existing + n and not pool.overlap[taxel, taxels].any():
            taxels.append(int(taxel))
    return [columns[taxel] for taxel in taxels]
