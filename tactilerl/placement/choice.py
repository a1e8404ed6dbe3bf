"""Taxels for handovers: chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from .. import statistics
from ..envs import layouts, validation
from ..envs.layouts import Layout
from ..envs.state import Array
from ..pictures import places
from ..scripted import gate
from . import cover
from .candidates import DesignFlags, Pool
from .cover import Starts
from .recording import record

CHOICE, TEST = 500_000, 750_000
"""Seeds of starts to choose from, and to judge on; those of the gate are others."""
RANDOM_SETS = 20
N_RESAMPLES = 10_000
MADE = "placed by tactilerl"
"""Stands in the description of every layout that was designed."""
ByWait = dict[float | None, Starts]
"""Starts by how far the hand is closed while it waits; None for as the scene has it."""
Tick = Callable[[], None]


@dataclass(frozen=True)
class Row:
    """How good a set of taxels is, in starts from which none was chosen."""

    layout: str
    """A layout, "whole skin", "chosen", or "random": the mean of random sets."""
    taxels: int
    success: float
    felt: float
    """Share of the starts that a taxel feels before the object is let go."""
    success_interval: tuple[float, float] | None = None
    """95 %."""
    start_closing: float | None = None
    """How far the hand is closed while it waits; None for as the scene has it."""
    chosen_from: float | None = None
    """Success in the starts from which these taxels were chosen."""
    bound: float | None = None
    """No set of as many succeeds more often in those; None where nobody knows."""
    difference: tuple[float, float, float] | None = None
    """By how much success is above that of the best layout, and its 95 % interval."""


@dataclass(frozen=True)
class Design:
    """What was chosen, and how good it is."""

    pool: Pool
    chosen: dict[int, list[int]]
    """By number of taxels, indices in the pool, without those that were there already."""
    worth: Array
    """(m,) of each taxel of the pool alone: the share of starts that it wins."""
    hopeless: float
    """Share of the starts in which the hand fails at whichever touch it closes."""
    best: str | None
    """Of the layouts to compare with, the one with the most success."""
    rows: list[Row]

    def layout(self, n: int) -> Layout:
        """Return a layout of `n` taxels, and those that were there already."""
        taxels = self.pool.taxels.take(
            sorted([*self.chosen[n], *range(self.pool.n_kept)])
        )
        scenes = ", ".join(scene.name for scene in self.pool.scenes)
        about = f"{n} taxel{'s' * (n > 1)} {MADE} for {scenes}"
        if (closing := self.waits_at(n)) is not None:
            about += f", waiting {closing:g} closed"
        return layouts.of_taxels(taxels, self.pool.hand, about)

    def waits_at(self, n: int) -> float | None:
        """Return how far the hand with `n` taxels is closed while it waits; None for as the scene has
        it."""
        rows = (row for row in self.rows if (row.layout, row.taxels) == ("chosen", n))
        return next(rows).start_closing

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        pool = self.pool
        names = validation.names(DesignFlags) - {"workers"}
        asked = {key: flag for key, flag in asdict(pool.flags).items() if key in names}
        chosen = {n: places.of(pool.taxels.take(own)) for n, own in self.chosen.items()}
        return {
            "about": f"taxels {MADE}",
            "env": pool.env,
            "simulator": pool.scenes[0].config.simulator,
            "scenes": [scene.name for scene in pool.scenes],
            "asking": asked,
            "candidates": len(pool.columns) - pool.n_kept,
            "early": pool.early,
            "hopeless": self.hopeless,
            "beside": self.best,
            "rows": [asdict(row) for row in self.rows],
            "places": {
                n: [asdict(place) for place in own] for n, own in chosen.items()
            },
        }


def design(flags: DesignFlags, workers: int, tick: Tick = lambda: None) -> Design:
    """Choose taxels by which a hand succeeds that closes at the first touch.

    `tick` is called after every start that is played. ValueError where nobody feels a start in time,
    where touch cannot help, or for a scene in which nothing is handed over.
    """
    pool = Pool.of(flags)
    choice = _played(pool, CHOICE, flags.starts, workers, tick)
    # The same candidates for all ways to wait.
    pool = pool.without(np.any([starts.early for starts in choice.values()], axis=0))
    wait = max(choice, key=lambda wait: cover.value(choice[wait], pool.columns))
    if not choice[wait].take(pool.columns).good.any():
        raise ValueError("skin: no taxel feels any start in time; choose other places")
    _require_use(choice[wait], wait, pool, workers)
    test = _played(pool, TEST, flags.test_starts, workers, tick)
    judge = Judge(choice, test, len(pool.scenes))
    rows = [judge.row(name, columns) for name, columns in pool.beside.items()]
    best = max(rows, key=lambda row: row.success).layout if rows else None
    rows.append(judge.row("whole skin", pool.columns))
    chosen: dict[int, list[int]] = {}
    for n in flags.numbers:
        picked = _choose(choice, pool, n)
        chosen[n] = [i for i in picked.taxels if i >= pool.n_kept]
        columns = [pool.columns[i] for i in picked.taxels]
        row = replace(
            judge.row("chosen", columns),
            taxels=n,
            chosen_from=picked.value,
            bound=picked.bound,
        )
        if best:
            difference = judge.difference(columns, pool.beside[best])
            row = replace(row, difference=difference)
        rows += [row, judge.random(n, pool, np.random.default_rng([flags.seed, n]))]
    worth = choice[judge.wait(columns)].take(pool.columns).worth
    return Design(pool, chosen, worth, judge.hopeless, best, rows)


def _played(pool: Pool, first: int, n: int, workers: int, tick: Tick) -> ByWait:
    """Play `n` starts of each scene with the whole skin, for each way to wait."""
    first += 2 * gate.SEARCH * pool.flags.seed
    numbers = range(first, first + n)
    played: ByWait = {}
    for wait in pool.flags.start_closing or (None,):
        parts = [
            record(
                pool.env, scene.waiting(wait), pool.skin, numbers, workers, tick,
                scene.weight,
            )
            for scene in pool.scenes
        ]  # fmt: skip
        played[wait] = Starts.joined(parts)
    return played


def _choose(choice: ByWait, pool: Pool, n: int) -> cover.Chosen:
    """Choose the best `n` taxels of all ways to wait, with the bound of all."""
    k, kept = n + pool.n_kept, range(pool.n_kept)
    every = [
        cover.choose(starts.take(pool.columns), k, kept, pool.overlap)
        for starts in choice.values()
    ]
    bounds = [one.bound for one in every if one.bound is not None]
    best = max(every, key=lambda one: one.value)
    return best._replace(bound=max(bounds) if len(bounds) == len(every) else None)


class Judge:
    """Says what sets of taxels win in starts from which none of them was chosen. A set waits as suited
    it best in those to choose from."""

    def __init__(self, choice: ByWait, test: ByWait, n_scenes: int = 1) -> None:
        self._choice, self._test = choice, test
        self._weights = next(iter(test.values())).weights
        rng, n = np.random.default_rng(0), len(self._weights) // n_scenes
        # Within each scene: which ones there are is not by chance.
        counts = [statistics.resample(rng, n, N_RESAMPLES) for _ in range(n_scenes)]
        self._counts = np.vstack(counts)

    def wait(self, taxels: Sequence[int]) -> float | None:
        """Return how far the hand is closed meanwhile; None for as the scene has it."""
        return max(self._choice, key=lambda w: cover.value(self._choice[w], taxels))

    @property
    def hopeless(self) -> float:
        """Share of the starts in which the hand fails at whichever touch it closes."""
        can = [starts.succeeds.any(axis=1) for starts in self._test.values()]
        return float(self._weights @ ~np.any(can, axis=0))

    def row(self, layout: str, taxels: Sequence[int]) -> Row:
        """Return success, with its interval, and share felt."""
        won, felt = self._won_and_felt(taxels)
        interval = self._mean(won)[1:]
        if np.allclose(self._weights, 1 / len(won)):
            interval = statistics.wilson_interval(int(won.sum()), len(won))
        return Row(
            layout=layout,
            taxels=len(taxels),
            success=float(self._weights @ won),
            felt=float(self._weights @ felt),
            success_interval=interval,
            start_closing=self.wait(taxels),
        )

    def random(self, n: int, pool: Pool, rng: np.random.Generator) -> Row:
        """Return means over random sets of `n` taxels, or as many as find room."""
        sets = [self._won_and_felt(drawn(n, pool, rng)) for _ in range(RANDOM_SETS)]
        success, felt = (np.mean(sets, axis=0) @ self._weights).tolist()
        return Row("random", n, success, felt)

    def difference(self, a: Sequence[int], b: Sequence[int]) -> statistics.Estimate:
        """Return by how much the success of `a` is above that of `b` in the same starts, with its
        interval."""
        won = [self._won_and_felt(taxels)[0].astype(float) for taxels in (a, b)]
        return self._mean(won[0] - won[1])

    def _won_and_felt(self, taxels: Sequence[int]) -> tuple[Array, Array]:
        """Tell of each start, bool (n,): does it succeed? Is it felt?"""
        starts = self._test[self.wait(taxels)]
        return cover.successes(starts, taxels), cover.felt(starts, taxels)

    def _mean(self, scores: Array) -> statistics.Estimate:
        return statistics.mean(len(scores) * self._weights * scores, self._counts)


def drawn(n: int, pool: Pool, rng: np.random.Generator) -> list[int]:
    """Draw columns: the kept taxels, and `n` random ones that do not overlap."""
    kept, free = pool.columns[: pool.n_kept], pool.columns[pool.n_kept :]
    if pool.overlap is None:
        return kept + rng.choice(free, n, replace=False).tolist()
    taxels = list(range(pool.n_kept))
    for taxel in pool.n_kept + rng.permutation(len(free)):
        if len(taxels) < pool.n_kept + n and not pool.overlap[taxel, taxels].any():
            taxels.append(int(taxel))
    return [pool.columns[taxel] for taxel in taxels]


def _require_use(starts: Starts, wait: float | None, pool: Pool, workers: int) -> None:
    """Raise ValueError where touch has nothing to win."""
    n, rate, senses = min(pool.flags.starts, 100), 0.0, dict[str, None]()
    for scene in pool.scenes:
        blind = gate.examine(
            pool.env, scene.waiting(wait), n, max(1, n // 20), 0, workers,
            senses=("joints", "sight"),
        )  # fmt: skip
        best = max(blind, key=lambda each: each.rate)
        rate += scene.weight * best.rate
        senses[best.name] = None
    worth = cover.value(starts, pool.columns)
    if worth - rate < gate.TELLS:
        raise ValueError(
            f"scene: touch cannot help here: a hand that goes by {' or '.join(senses)} succeeds in "
            f"{rate:.2f} of the starts, one that feels with the whole skin in {worth:.2f}"
        )
