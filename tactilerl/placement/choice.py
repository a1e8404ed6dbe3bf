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
Tick = Callable[..., None]
START = 3  # episodes that take as long as a recorded start


@dataclass(frozen=True)
class Row:
    """Say how good a set of taxels is, in starts from which none was chosen."""

    layout: str
    """A layout, "whole skin", "chosen", "random": the mean of random sets, or "no touch": the best
    scripted hand without."""
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
    """Share by which the hand is closed while it waits; None for as the scene has it."""
    chosen_from: float | None = None
    """Success in the starts from which these taxels were chosen."""
    chosen_worst: float | None = None
    """The same after the worst loss, where they were chosen for that."""
    difference: tuple[float, float, float] | None = None
    """Success less that of the layout that is the best in those, and its 95 % interval."""
    threshold: float | None = None
    """Force from which a taxel fires, N; None for what the scene or the layout says."""


class Use(NamedTuple):
    """Say what touch has to win."""

    threshold: float | None
    """Force from which a taxel fires, N; None for what the scene or the layout says."""
    touch: float
    """Success of a hand that feels with all candidates, in the starts to choose from."""
    blind: float
    """Success of the best scripted hand without touch, in the others: the mean over scenes."""
    blind_hand: str
    """Name of that hand, in each scene if they differ."""
    start_closing: float | None
    """Share by which all of these are closed while they wait."""


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
    """The layout with the most success in the starts to choose from, of those to compare with."""
    rows: list[Row]
    """Rows for each threshold after the other."""
    uses: list[Use]
    """Uses of touch for each threshold. The fields before `rows` are of the first."""

    def sentences(self) -> list[str]:
        """Say for each threshold whether touch pays, and from how many chosen taxels on."""
        said = []
        for use in self.uses:
            rows = [row for row in self.rows if row.threshold == use.threshold]
            chosen = [row for row in rows if row.layout == "chosen"]
            paying = [row for row in chosen if gate.pays(row.success, use.blind)]
            row = paying[0] if paying else max(chosen, key=lambda row: row.success)
            at = "" if row.threshold is None else f" at {row.threshold:g} N"
            verdict = f"Touch does not pay{at}"
            if paying:
                verdict = f"Touch pays{at}"
                if len(chosen) > 1:
                    verdict += f" from {row.taxels} {_taxels(row.taxels)} on"
            said.append(
                f"{verdict}: with {row.taxels} chosen {_taxels(row.taxels)} the hand succeeds in "
                f"{row.success:.2f} of the starts, the best one without touch ({use.blind_hand}) in "
                f"{use.blind:.2f}."
            )
        if len(self.uses) > 1:
            uses = {use.threshold or 0.0: (use.touch, use.blind) for use in self.uses}
            said.append(f"With all candidates: {gate.where_touch_stops(uses)}")
        return said

    def layout(self, n: int) -> Layout:
        """Return a layout of `n` taxels, and those that were there already."""
        about = f"{n} {_taxels(n)} placed by tactilerl for "
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
            "verdict": " ".join(self.sentences()),
            "places": {
                n: [place._asdict() for place in places.of(pool.skin.take(columns))]
                for n, columns in self.chosen.items()
            },
        }


def _taxels(n: int) -> str:
    """Return the word for `n` of them."""
    return "taxel" if n == 1 else "taxels"


def design(flags: DesignFlags, workers: int, tick: Tick = lambda *_: None) -> Design:
    """Choose taxels by which a hand succeeds that closes at the first touch.

    `tick` is called after every episode, and with a number after as many. Raise ValueError where touch
    cannot help, or for a scene in which nothing is handed over.
    """
    pool = Pool.of(flags)
    choices = _played(pool, CHOICE, flags.starts, workers, tick)
    # The same candidates for all ways to wait.
    pools = [
        pool.without(np.any([starts.early for starts in choice.values()], axis=0))
        for choice in choices
    ]
    blind, uses = cache(partial(_blind, pool, workers, tick)), []
    for threshold, choice, each in zip(flags.thresholds, choices, pools, strict=True):
        rates = {wait: cover.value(choice[wait], each.columns) for wait in choice}
        wait = max(rates, key=rates.__getitem__)
        uses.append(Use(threshold, rates[wait], *blind(wait), wait))
    if not any(gate.pays(use.touch, use.blind) for use in uses):
        best = max(uses, key=lambda use: use.touch)
        raise ValueError(
            "scene: touch cannot help here: the best hand without touch "
            f"({best.blind_hand}) succeeds in {best.blind:.2f} of the starts, one that feels with all "
            f"candidates in {best.touch:.2f}"
        )
    tests = _played(pool, TEST, flags.test_starts, workers, tick)
    designs = [
        _judged(*parts) for parts in zip(uses, pools, choices, tests, strict=True)
    ]
    rows = [row for each in designs for row in each.rows]
    return replace(designs[0], rows=rows, uses=uses)


def n_played(flags: DesignFlags) -> int:
    """Return the number of episodes that a design plays, more or less."""
    n_starts = len(flags.waits) * (flags.starts + flags.test_starts)
    n_senses = len(gate.BLIND) - 1  # for most scenes let nobody see
    n_blind = n_senses * gate.n_played(flags.test_starts, _search(flags))
    return len(flags.scene) * (START * n_starts + n_blind)


def _blind(
    pool: Pool, workers: int, tick: Tick, wait: float | None
) -> tuple[float, str]:
    """Return the success of the best scripted hand without touch, and which it is.

    It is chosen in a tenth of as many starts, as the gate's is, and judged where taxels are.
    The success is the mean over scenes, each with the hand that is best there.
    """
    flags = pool.flags
    searched = _numbers(flags, CHOICE, _search(flags))
    compared = _numbers(flags, TEST, flags.test_starts)
    examine = partial(
        gate.examine, pool.env, searched=searched, compared=compared, workers=workers, tick=tick,
        senses=gate.BLIND,
    )  # fmt: skip
    scenes = [waiting(scene, wait) for scene in pool.scenes.values()]
    found = [gate.without_touch(examine(scene)) for scene in scenes]
    rate = sum(hand.rate for hand in found) / len(found)
    return rate, ", ".join(dict.fromkeys(hand.name for hand in found))


def _search(flags: DesignFlags) -> int:
    """Return how many starts each candidate of a sense plays: with 200 starts as many as the gate's."""
    return max(1, flags.starts // 10)


def _numbers(flags: DesignFlags, first: int, n: int) -> range:
    """Return the numbers of `n` starts, of those that begin with `first`."""
    first += 2 * gate.SEARCH * flags.seed
    return range(first, first + n)


def _played(pool: Pool, first: int, n: int, workers: int, tick: Tick) -> list[ByWait]:
    """Play `n` starts of each scene with the whole skin, for each way to wait.

    Return them for each threshold.
    """
    flags, numbers = pool.flags, _numbers(pool.flags, first, n)
    played: list[ByWait] = [{} for _ in flags.thresholds]
    for wait in flags.waits:
        scenes = [waiting(scene, wait) for scene in pool.scenes.values()]
        recordings = record(
            pool.env, scenes, pool.skin, numbers, workers, partial(tick, START), flags.thresholds
        )  # fmt: skip
        for by_wait, starts in zip(played, recordings, strict=True):
            by_wait[wait] = starts
    return played


def _judged(use: Use, pool: Pool, choice: ByWait, test: ByWait) -> Design:
    """Return what is chosen for one threshold, beside what it is compared with."""
    judge = Judge(choice, test, pool)
    references = pool.references
    best = max(
        references, key=lambda name: judge.waits(references[name])[0], default=None
    )
    rows = [_without(use, len(judge))]
    rows += [judge.row(name, columns) for name, columns in references.items()]
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
            difference=judge.difference(columns, references[best]) if best else None,
        )
        rng = np.random.default_rng([pool.flags.seed, n])
        rows += [row, judge.random(n, rng)]
    rows = [replace(row, threshold=use.threshold) for row in rows]
    return Design(pool, choice, test, chosen, best, rows, [])


def _without(use: Use, n: int) -> Row:
    """Return the row of the best hand without touch, judged on `n` starts."""
    rate, interval = use.blind, _interval(use.blind, n)
    return Row(
        layout="no touch", taxels=0, success=rate, felt=0.0, worst=rate,
        success_interval=interval, worst_interval=interval, start_closing=use.start_closing,
    )  # fmt: skip


def _choose(choice: ByWait, pool: Pool, n: int) -> cover.Chosen:
    """Choose the best `n` taxels of all ways to wait."""
    losses = pool.losses.members[:, pool.columns] if pool.flags.survives else None
    sets = []
    for starts in choice.values():
        starts = replace(starts, fires=starts.fires[:, pool.columns])
        n_all, existing = n + len(pool.existing), range(len(pool.existing))
        sets.append(cover.choose(starts, n_all, existing, pool.overlap, losses))
    return max(sets, key=lambda chosen: (chosen.worst, chosen.value))


class Judge:
    """Say what sets of taxels win in starts from which none of them was chosen.

    A set waits as suited it best in those to choose from.
    """

    def __init__(self, choice: ByWait, test: ByWait, pool: Pool) -> None:
        """Take starts to choose from and to judge on, and what may be lost."""
        self._choice, self._test, self._pool = choice, test, pool
        self._losses = pool.losses.members
        rng, n_scenes = np.random.default_rng(0), len(pool.scenes)
        n = len(self) // n_scenes
        # Within each scene: which ones there are is not by chance.
        counts = [statistics.resample(rng, n, N_RESAMPLES) for _ in range(n_scenes)]
        self._counts = np.vstack(counts)

    def __len__(self) -> int:
        """Return how many starts it judges on."""
        return len(next(iter(self._test.values())))

    def waits(self, taxels: Sequence[int]) -> tuple[float, float | None]:
        """Return the best score in the starts to choose from, and how far the hand is closed for it."""
        losses = self._losses if self._pool.flags.survives else self._losses[:0]
        scores = {
            wait: round(cover.score(starts, taxels, losses), 12)
            for wait, starts in self._choice.items()
        }
        wait = max(scores, key=scores.__getitem__)
        return scores[wait], wait

    def row(self, layout: str, taxels: Sequence[int]) -> Row:
        """Return success, with its interval, share felt, and success after the worst loss.

        Which loss is the worst is found in the starts to choose from: in these, the least of several
        shares would be too low, and its interval as well. A set that was chosen for its worst loss has
        none there that stands out; for it, the least share is nearer to the truth, and not too high.
        """
        _, wait = self.waits(taxels)
        starts = self._test[wait]
        is_for_losses = layout == "chosen" and self._pool.flags.survives
        found_in = starts if is_for_losses else self._choice[wait]
        _, lost = cover.worst_loss(found_in, taxels, self._losses)
        left = list(taxels)
        if lost is not None:
            left = cover.without(taxels, self._losses[lost])
        worst = cover.value(starts, left)
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
            cover.successes(self._test[self.waits(taxels)[1]], taxels).astype(float)
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
