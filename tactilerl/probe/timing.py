"""Taxels for handovers: chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

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

CHOICE, TEST = 500_000, 750_000  # starts to choose from, to judge on, and of the gate are all different
RANDOM_SETS = 20
FEW = 20  # starts, to say where arrivals are felt


def design(pool: Pool, workers: int, show: Callable[[int, int], None]) -> Design:
    """Choose taxels; ValueError where nobody feels a start in time, or touch cannot help."""
    flags, done = pool.flags, iter(range(1, 10**9))
    total = len(pool.scenes) * (pool.n_starts + flags.test_starts)

    def played(first: int, n: int) -> Starts:
        first += 2 * gate.SEARCH * flags.seed
        numbers, every = range(first, first + n), flags.false_on > 0
        tick = lambda: show(next(done), total)  # noqa: E731
        parts = [
            vars(record(pool.env, one.config, pool.skin, numbers, workers, every, tick, one.weight))
            for one in pool.scenes
        ]
        return Starts(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})

    choice = played(CHOICE, pool.n_starts)
    pool = pool.without(choice.early)
    starts = choice.take(pool.columns)
    _require_felt(starts, pool, workers)
    judge = _Judge(played(TEST, flags.test_starts), flags.aim)
    rng = np.random.default_rng(flags.seed)
    beside = {name: pool.skin.columns(taxels) for name, taxels in pool.beside.items()}
    rows = [judge.row(name, columns) for name, columns in beside.items()]
    best = max(rows, key=lambda row: row["success"], default=None)
    rows.append(judge.row("whole skin", pool.columns))
    chosen = {}
    for n in flags.numbers:
        picked = cover.choose(
            starts, n + pool.n_kept, flags.aim, range(pool.n_kept), overlap=pool.overlap
        )
        chosen[n] = [i for i in picked.taxels if i >= pool.n_kept]
        own = [pool.columns[i] for i in picked.taxels]
        row = judge.row("chosen", own)
        row |= {"taxels": n, "chosen_from": picked.value, "bound": picked.bound}
        if best is not None:
            row["difference"] = judge.difference(own, beside[best["layout"]])
        rows += [row, judge.random(n, pool, rng)]
    about = {
        "question": "timing",
        "hopeless": float(np.mean(~judge.starts.succeeds.any(axis=1))),
        "beside": best and best["layout"],
        "rows": rows,
    }
    return pool.design(chosen, starts.worth, about)


class _Judge:
    """What sets of taxels win in starts from which none of them was chosen."""

    def __init__(self, starts: Starts, aim: Aim) -> None:
        self.starts, self._aim = starts, aim
        self._counts = statistics.resample(np.random.default_rng(0), len(starts), 10_000)

    def row(self, layout: str, taxels: list[int]) -> dict[str, Any]:
        """Success and share felt, with intervals."""
        row: dict[str, Any] = {"layout": layout, "taxels": len(taxels)}
        for name, scores in self._scores(taxels).items():
            row[name] = float(self.starts.weights @ scores)
            row[f"{name}_interval"] = self._interval(scores)
        return row

    def random(self, n: int, pool: Pool, rng: np.random.Generator) -> dict[str, Any]:
        """Means over random sets of the same size, or as many of it as find room."""
        every = [self._scores(_drawn(n, pool, rng)) for _ in range(RANDOM_SETS)]
        means = {name: np.mean([scores[name] for scores in every], axis=0) for name in every[0]}
        shares = {name: float(self.starts.weights @ scores) for name, scores in means.items()}
        return {"layout": "random", "taxels": n, **shares}

    def difference(self, a: list[int], b: list[int]) -> dict[str, Any]:
        """By how much `a` is above `b` in the same starts, with intervals."""
        others = self._scores(b)
        return {name: list(self._mean(own - others[name])) for name, own in self._scores(a).items()}

    def _scores(self, taxels: list[int]) -> dict[str, Array]:
        """(n,) of each start: does it succeed, or how probably? Is it felt?"""
        success = cover.scores(self.starts, np.array([taxels], int), self._aim)[:, 0]
        return {"success": success, "felt": self.starts.felt(taxels).astype(float)}

    def _interval(self, scores: Array) -> list[float]:
        """Wilson's where starts succeed or not and count alike, else the bootstrap's."""
        n = len(scores)
        if np.allclose(self.starts.weights, 1 / n) and np.isin(scores, (0.0, 1.0)).all():
            return list(statistics.wilson_interval(round(scores.sum()), n))
        return list(self._mean(scores)[1:])

    def _mean(self, scores: Array) -> statistics.Estimate:
        return statistics.mean(len(scores) * self.starts.weights * scores, self._counts)


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


def _require_felt(starts: Starts, pool: Pool, workers: int) -> None:
    """ValueError where no candidate feels anything in time, or touch has nothing to win."""
    name, scene, hand = pool.env, pool.scenes[0].config, pool.hand
    if not starts.good.any():
        skin = Skin.of([places.skin("6mm", hand)])
        seen = record(name, scene, skin, range(CHOICE, CHOICE + FEW), workers).worth > 0
        felt = {hand.surfaces[place.surface] for place, column in skin.index.items() if seen[column]}
        where = ", ".join(sorted(f"{surface.digit}.{surface.segment}" for surface in felt))
        where = where or "nothing of the hand in time"
        raise ValueError(
            f"skin: no taxel feels any start in time; arrivals meet {where}, where it has none"
        )
    n = min(len(starts), 100)
    without = gate.examine(name, scene, n, max(1, n // 20), 0, workers, senses=("joints", "sight"))
    whole = cover.value(starts, range(starts.fires.shape[1]))
    best = max(without, key=lambda each: each.rate)
    if whole - best.rate < gate.TELLS:
        raise ValueError(
            f"scene: touch cannot help here: a hand that goes by {best.name} succeeds in "
            f"{best.rate:.2f} of the starts, one that feels with the whole skin in {whole:.2f}"
        )
