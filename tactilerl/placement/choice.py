"""Taxels for handovers: chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
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
from .prices import knee
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
    difference: tuple[float, float, float] | None = None
    """Success less that of the layout that is the best in those, and its 95 % interval."""
    price: float | None = None
    """Price of the chosen taxels and their boards."""
    is_knee: bool = False
    """True for the set from which on more taxels, or more money, gain little."""
    sensor: str | None = None
    threshold: float | None = None
    """Force from which a taxel fires, N; None for what the layout says."""


class Use(NamedTuple):
    """Say what touch has to beat."""

    sensor: str | None
    threshold: float | None
    """Force from which a taxel fires, N; None for what the layout says."""
    blind: float
    """Success of the best scripted hand without touch, in unseen starts: the mean over scenes."""
    blind_hand: str
    """Name of that hand, in each scene if they differ."""
    start_closing: float | None
    """Share by which it is closed while it waits."""

    @property
    def at(self) -> str:
        """Sensor and threshold, as a part of a sentence."""
        name = f" with {self.sensor}" if self.sensor else ""
        return name + ("" if self.threshold is None else f" at {self.threshold:g} N")

    def rows(self, rows: Sequence[Row]) -> list[Row]:
        """Return those of its sensor and threshold."""
        return [row for row in rows if (row.sensor, row.threshold) == self[:2]]


@dataclass(frozen=True)
class Design:
    """Hold the taxels that were chosen, and say how good they are."""

    pool: Pool
    choice: ByWait
    """The starts to choose from."""
    test: ByWait
    """Other starts, on which everything is judged."""
    chosen: dict[float, list[int]]
    """Columns of the skin by number of taxels, or with a budget by price; those that the hand has
    already come on top."""
    best: str | None
    """The layout with the most success in the starts to choose from, of those to compare with."""
    rows: list[Row]
    """Rows for each sensor and threshold after the other."""
    uses: list[Use]
    """Uses of touch for each of these. The fields before `rows` are of the first."""
    against: dict[str | None, statistics.Estimate] = field(default_factory=dict)
    """Success of each other sensor's best set less that of the first's, in the same starts."""

    def sentences(self) -> list[str]:
        """Say for each sensor whether touch pays and from which set on, and which sensor is better."""
        said = []
        for use in self.uses:
            chosen = [row for row in use.rows(self.rows) if row.layout == "chosen"]
            paying = [row for row in chosen if gate.pays(row.success, use.blind)]
            row = paying[0] if paying else max(chosen, key=lambda row: row.success)
            taxels = _taxels(row.taxels, row.price)
            verdict = f"Touch {'pays' if paying else 'does not pay'}{use.at}"
            if paying and len(chosen) > 1:
                verdict += f" from {taxels} on"
            said.append(
                f"{verdict}: with {taxels} chosen the hand succeeds in {row.success:.2f} of the "
                f"starts, the best one without touch ({use.blind_hand}, as the gate finds it) in "
                f"{use.blind:.2f}."
            )
            most = chosen[-1]
            for row in chosen:
                if row.is_knee:
                    said.append(
                        f"The knee is at {_taxels(row.taxels, row.price)}: {row.success:.2f}; "
                        f"{_taxels(most.taxels, most.price)} reach {most.success:.2f}."
                    )
        for sensor, difference in self.against.items():
            said.append(
                "Best set of {}, success less that of {} in the same starts: {:+.2f} ({:+.2f} to "
                "{:+.2f}).".format(sensor, self.uses[0].sensor, *difference)
            )
        return said

    def layout(self, key: float) -> Layout:
        """Return the layout of a chosen set, with the taxels that were there already."""
        pool, columns = self.pool, self.chosen[key]
        n = len(columns) - len(pool.existing)
        scenes = ", ".join(pool.scenes)
        about = f"{_taxels(n)} placed by tactilerl for {scenes}"
        return layouts.of_taxels(pool.skin.take(columns), pool.hand, about)

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
                f"{key:g}": [
                    place._asdict() for place in places.of(pool.skin.take(columns))
                ]
                for key, columns in self.chosen.items()
            },
        }


def _taxels(n: int, price: float | None = None) -> str:
    """Return how many taxels, and what they cost."""
    cost = "" if price is None else f" for {price:g}"
    return f"{n} {'taxel' if n == 1 else 'taxels'}{cost}"


def design(flags: DesignFlags, workers: int, tick: Tick = lambda *_: None) -> Design:
    """Choose taxels by which a hand succeeds that closes at the first touch.

    `tick` is called after every episode, and with a number after as many. Raise ValueError for a scene
    in which nothing is handed over, and where flags do not go together.
    """
    pools = Pool.of(flags)
    choice = _played(pools[0], CHOICE, flags.starts, workers, tick)
    # The same candidates for all ways to wait.
    early = np.any([starts.early for starts in choice.values()], axis=0)
    pools = [pool.without(early) for pool in pools]
    blind, uses = cache(partial(_blind, pools[0], workers, tick)), []
    for pool in pools:
        rates = {wait: cover.value(choice[wait], pool.columns) for wait in choice}
        wait = max(rates, key=rates.__getitem__)
        sensor = pool.sensor
        uses.append(Use(sensor.name, sensor.threshold, *blind(wait), wait))
    test = _played(pools[0], TEST, flags.test_starts, workers, tick)
    designs = [
        _judged(use, pool, choice, test) for use, pool in zip(uses, pools, strict=True)
    ]
    judge = Judge(choice, test, pools[0])
    first, *others = [each.chosen[max(each.chosen)] for each in designs]
    against = {
        pool.sensor.name: judge.difference(columns, first)
        for pool, columns in zip(pools[1:], others, strict=True)
        if len(flags.sensor) > 1
    }
    rows = [row for each in designs for row in each.rows]
    return replace(designs[0], rows=rows, uses=uses, against=against)


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

    It is chosen in the starts from which the gate chooses it, and judged where taxels are.
    The success is the mean over scenes, each with the hand that is best there.
    """
    flags = pool.flags
    searched, _ = gate.numbers(flags.seed, 0, _search(flags))
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


def _played(pool: Pool, first: int, n: int, workers: int, tick: Tick) -> ByWait:
    """Play `n` starts of each scene with the whole skin, for each way to wait."""
    flags, numbers = pool.flags, _numbers(pool.flags, first, n)
    played: ByWait = {}
    for wait in flags.waits:
        scenes = [waiting(scene, wait) for scene in pool.scenes.values()]
        played[wait] = record(
            pool.env, scenes, pool.skin, pool.delays, numbers, workers, partial(tick, START)
        )  # fmt: skip
    return played


def _judged(use: Use, pool: Pool, choice: ByWait, test: ByWait) -> Design:
    """Return what is chosen for one sensor and threshold, beside what it is compared with."""
    judge = Judge(choice, test, pool)
    references = pool.references
    best = max(
        references, key=lambda name: judge.waits(references[name])[0], default=None
    )
    rows = [_without(use, len(judge))]
    rows += [judge.row(name, columns) for name, columns in references.items()]
    rows.append(judge.row("whole skin", pool.columns))
    picks = _picks(choice, pool)
    chosen: dict[float, list[int]] = {}
    at = knee(
        [0.0, *(pick.n if pick.price is None else pick.price for pick in picks)],
        [use.blind, *(pick.chosen.value for pick in picks)],
    )
    for index, pick in enumerate(picks, 1):
        columns = [pool.columns[i] for i in pick.chosen.taxels]
        key = pick.n if pool.flags.budget is None else pick.price
        chosen[key or 0.0] = columns
        row = replace(
            judge.row("chosen", columns),
            taxels=pick.n,
            price=pick.price,
            is_knee=index == at < len(picks),
            chosen_from=pick.chosen.value,
            difference=judge.difference(columns, references[best]) if best else None,
        )
        rows += [row, judge.random(pick)]
    rows = [replace(row, sensor=use.sensor, threshold=use.threshold) for row in rows]
    return Design(pool, choice, test, chosen, best, rows, [])


def _without(use: Use, n: int) -> Row:
    """Return the row of the best hand without touch, judged on `n` starts."""
    rate, interval = use.blind, _interval(use.blind, n)
    return Row(
        layout="no touch", taxels=0, success=rate, felt=0.0, worst=rate,
        success_interval=interval, worst_interval=interval, start_closing=use.start_closing,
    )  # fmt: skip


class Pick(NamedTuple):
    """Hold a chosen set of taxels: how many are bought, on how many boards (0: any), for how much."""

    n: int
    boards: int
    price: float | None
    chosen: cover.Chosen


def _picks(choice: ByWait, pool: Pool) -> list[Pick]:
    """Choose the best set of each size that is asked for, of all ways to wait.

    Within a budget these are the sets that no cheaper one reaches. Raise ValueError where there is no
    room for as many taxels as are asked for.
    """
    losses = pool.losses.members[:, pool.columns] if pool.flags.survives else None
    n_existing, budget, picks = len(pool.existing), pool.flags.budget, []
    for n, boards in pool.sizes():
        sets = []
        for starts in choice.values():
            starts = replace(starts, fires=starts.fires[:, pool.columns])
            asked = (
                n + n_existing,
                list(range(n_existing)),
                partial(pool.fits, boards),
                losses,
            )
            sets.append(cover.choose(starts, *asked))
        chosen = max(sets, key=lambda chosen: chosen[1:])
        placed = [pool.columns[i] for i in chosen.taxels[n_existing:]]
        if len(placed) < n and budget is None:
            raise ValueError(
                f"taxels: found {n}, allowed up to {len(placed)}; there is no room for more of this "
                "radius"
            )
        price = pool.prices.of(placed) if pool.prices else None
        picks.append(Pick(len(placed), boards, price, chosen))
    if budget is None:
        return picks
    better: list[Pick] = []
    picks.sort(key=lambda pick: (-(pick.price or 0.0), pick.chosen[1:]), reverse=True)
    for pick in picks:
        if not better or pick.chosen[1:] > better[-1].chosen[1:]:
            better.append(pick)
    return better


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

    def random(self, pick: Pick) -> Row:
        """Return means over random sets of as many taxels, or as many as find room."""
        n, fits = pick.n, partial(self._pool.fits, pick.boards)
        rng = np.random.default_rng([self._pool.flags.seed, n])
        sets = [drawn(n, self._pool, fits, rng) for _ in range(RANDOM_SETS)]
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


def drawn(n: int, pool: Pool, fits: cover.Fits, rng: np.random.Generator) -> list[int]:
    """Draw columns: those that the hand has, and up to `n` random ones that find room."""
    n_existing, columns = len(pool.existing), pool.columns
    taxels = list(range(n_existing))
    for taxel in n_existing + rng.permutation(len(pool.free)):
        if len(taxels) < n_existing + n and fits(taxels)[taxel]:
            taxels.append(int(taxel))
    return [columns[taxel] for taxel in taxels]
