"""Taxels for handovers: chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from .. import statistics
from ..envs.state import Array
from ..pictures import places
from . import cover, gate
from .candidates import Design, Pool
from .cover import Aim, Starts
from .recording import Skin, record

CHOICE, TEST = (
    500_000,
    750_000,
)  # starts to choose from, to judge on, and of the gate are all different
RANDOM_SETS = 20
FEW = 20  # starts, to say where arrivals are felt
ByWait = dict[float | None, Starts]
"""Starts by how far the hand is closed while it waits; None for as the scene has it."""


def design(pool: Pool, workers: int, show: Callable[[int, int], None]) -> Design:
    """Choose taxels; ValueError where nobody feels a start in time, or touch cannot help."""
    flags, done = pool.flags, itertools.count(1)
    n_recordings = len(pool.scenes) * max(1, len(flags.start_closing))
    total = n_recordings * (pool.n_starts + flags.test_starts)
    tick = lambda: show(next(done), total)  # noqa: E731
    choice = _played(pool, CHOICE, pool.n_starts, workers, tick)
    # The same candidates for all ways to wait.
    pool = pool.without(np.any([starts.early for starts in choice.values()], axis=0))
    _require_felt(choice, pool, workers)
    test = _played(pool, TEST, flags.test_starts, workers, tick)
    judge = _Judge(choice, test, flags.aim, len(pool.scenes))
    beside = {name: pool.skin.columns(taxels) for name, taxels in pool.beside.items()}
    rows = [judge.row(name, columns) for name, columns in beside.items()]
    best = max(rows, key=lambda row: row["success"], default=None)
    rows.append(judge.row("whole skin", pool.columns))
    chosen: dict[int, list[int]] = {}
    for n in flags.numbers:
        picked = _choose(choice, pool, n)
        chosen[n] = [i for i in picked.taxels if i >= pool.n_kept]
        own = [pool.columns[i] for i in picked.taxels]
        row = judge.row("chosen", own)
        row |= {"taxels": n, "chosen_from": picked.value, "bound": picked.bound}
        if best is not None:
            row["difference"] = judge.difference(own, beside[best["layout"]])
        rows += [row, judge.random(n, pool, np.random.default_rng([flags.seed, n]))]
    about = {
        "question": "timing",
        "hopeless": judge.hopeless,
        "beside": best and best["layout"],
        "rows": rows,
    }
    largest = choice[judge.wait(own)]
    return pool.design(chosen, largest.take(pool.columns).worth, about)


def _played(
    pool: Pool, first: int, n: int, workers: int, tick: Callable[[], None]
) -> ByWait:
    """`n` starts of each scene with the whole skin, for each way to wait."""
    flags, found = pool.flags, dict[float | None, Starts]()
    first += 2 * gate.SEARCH * flags.seed
    numbers, every = range(first, first + n), flags.taxel_false_on > 0
    for wait in flags.start_closing or (None,):
        parts = []
        for one in pool.scenes:
            scene = one.waiting(wait)
            starts = record(
                pool.env, scene, pool.skin, numbers, workers, every, tick, one.weight
            )
            parts.append(vars(starts))
        joined = {
            name: np.concatenate([part[name] for part in parts]) for name in parts[0]
        }
        found[wait] = Starts(**joined)
    return found


def _choose(choice: ByWait, pool: Pool, n: int) -> cover.Chosen:
    """The best `n` taxels of all ways to wait, and the bound of all."""
    aim, kept = pool.flags.aim, range(pool.n_kept)
    found = [
        cover.choose(
            starts.take(pool.columns), n + pool.n_kept, aim, kept, overlap=pool.overlap
        )
        for starts in choice.values()
    ]
    bounds = [one.bound for one in found if one.bound is not None]
    best = max(found, key=lambda one: one.value)
    return best._replace(bound=max(bounds) if len(bounds) == len(found) else None)


class _Judge:
    """What sets of taxels win in starts from which none of them was chosen. A set waits as suited it
    best in those to choose from."""

    def __init__(
        self, choice: ByWait, test: ByWait, aim: Aim, n_scenes: int = 1
    ) -> None:
        self.test, self._choice, self._aim = test, choice, aim
        self._weights = next(iter(test.values())).weights
        rng, n = np.random.default_rng(0), len(self._weights) // n_scenes
        # Within each scene: which ones there are is not by chance.
        self._counts = np.vstack(
            [statistics.resample(rng, n, 10_000) for _ in range(n_scenes)]
        )

    def wait(self, taxels: list[int]) -> float | None:
        """How far the hand is closed meanwhile; None for as the scene has it."""
        return max(
            self._choice, key=lambda w: cover.value(self._choice[w], taxels, self._aim)
        )

    @property
    def hopeless(self) -> float:
        """Share of the starts in which the hand fails at whichever touch it closes."""
        can = np.any(
            [starts.succeeds.any(axis=1) for starts in self.test.values()], axis=0
        )
        return float(self._weights @ ~can)

    def row(self, layout: str, taxels: list[int]) -> dict[str, Any]:
        """Success and share felt, with intervals."""
        row: dict[str, Any] = {"layout": layout, "taxels": len(taxels)}
        if (wait := self.wait(taxels)) is not None:
            row["start_closing"] = wait
        for name, scores in self._scores(taxels).items():
            row[name] = float(self._weights @ scores)
            row[f"{name}_interval"] = self._interval(scores)
        return row

    def random(self, n: int, pool: Pool, rng: np.random.Generator) -> dict[str, Any]:
        """Means over random sets of the same size, or as many of it as find room."""
        every = [self._scores(_drawn(n, pool, rng)) for _ in range(RANDOM_SETS)]
        means = {
            name: np.mean([scores[name] for scores in every], axis=0)
            for name in every[0]
        }
        shares = {name: float(self._weights @ scores) for name, scores in means.items()}
        return {"layout": "random", "taxels": n, **shares}

    def difference(self, a: list[int], b: list[int]) -> dict[str, Any]:
        """By how much `a` is above `b` in the same starts, with intervals."""
        others = self._scores(b)
        return {
            name: list(self._mean(own - others[name]))
            for name, own in self._scores(a).items()
        }

    def _scores(self, taxels: list[int]) -> dict[str, Array]:
        """(n,) of each start: does it succeed, or how probably? Is it felt?"""
        starts = self.test[self.wait(taxels)]
        success = cover.scores(starts, np.array([taxels], int), self._aim)[:, 0]
        return {"success": success, "felt": starts.felt(taxels).astype(float)}

    def _interval(self, scores: Array) -> list[float]:
        """Wilson's where starts succeed or not and count alike, else the bootstrap's."""
        n = len(scores)
        if np.allclose(self._weights, 1 / n) and np.isin(scores, (0.0, 1.0)).all():
            return list(statistics.wilson_interval(round(scores.sum()), n))
        return list(self._mean(scores)[1:])

    def _mean(self, scores: Array) -> statistics.Estimate:
        return statistics.mean(len(scores) * self._weights * scores, self._counts)


def _drawn(n: int, pool: Pool, rng: np.random.Generator) -> list[int]:
    """Columns of the kept taxels and of `n` random ones that do not overlap."""
    kept, free = pool.columns[: pool.n_kept], pool.columns[pool.n_kept :]
    if pool.overlap is None:
        return kept + rng.choice(free, n, replace=False).tolist()
    drawn = list(range(pool.n_kept))
    for taxel in pool.n_kept + rng.permutation(len(free)):
        if len(drawn) < pool.n_kept + n and not pool.overlap[taxel, drawn].any():
            drawn.append(int(taxel))
    return [pool.columns[taxel] for taxel in drawn]


def _require_felt(choice: ByWait, pool: Pool, workers: int) -> None:
    """ValueError where no candidate feels anything in time, or touch has nothing to win."""
    name, hand = pool.env, pool.hand
    worth = {wait: cover.value(starts, pool.columns) for wait, starts in choice.items()}
    wait = max(worth, key=worth.__getitem__)
    starts = choice[wait].take(pool.columns)
    if not starts.good.any():
        skin = Skin.of([places.skin("6mm", hand)])
        scene, numbers = pool.scenes[0].waiting(wait), range(CHOICE, CHOICE + FEW)
        seen = record(name, scene, skin, numbers, workers).worth > 0
        felt = {
            hand.surfaces[place.surface]
            for place, column in skin.index.items()
            if seen[column]
        }
        where = ", ".join(
            sorted(f"{surface.digit}.{surface.segment}" for surface in felt)
        )
        where = where or "nothing of the hand in time"
        raise ValueError(
            f"skin: no taxel feels any start in time; arrivals meet {where}, where it has none"
        )
    n, without = min(pool.n_starts, 100), list[gate.Found]()
    for one in pool.scenes:
        scene = one.waiting(wait)
        found = gate.examine(
            name, scene, n, max(1, n // 20), 0, workers, senses=("joints", "sight")
        )
        without.append(max(found, key=lambda each: each.rate))
    rate = sum(
        one.weight * best.rate for one, best in zip(pool.scenes, without, strict=True)
    )
    if worth[wait] - rate < gate.TELLS:
        sense = " or ".join(dict.fromkeys(best.name for best in without))
        raise ValueError(
            f"scene: touch cannot help here: a hand that goes by {sense} succeeds in {rate:.2f} of the "
            f"starts, one that feels with the whole skin in {worth[wait]:.2f}"
        )
