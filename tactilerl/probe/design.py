"""Where do a hand's taxels go? Chosen from some starts, judged on others, beside other layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np

from .. import statistics
from ..envs import hands, layouts, scenes, tasks, typed
from ..envs.choices import require_known
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import Hand
from ..envs.layouts import Layout, Taxels
from ..envs.objects import bounds
from ..envs.state import Array
from ..pictures import places
from ..runs.config import WorkerCount
from . import cover, gate
from .cover import Aim
from .recording import Recording, Skin, record

CHOICE, TEST = 500_000, 750_000  # starts to choose from, to judge on, and of the gate are all different
MOST = 250_000
BESIDE = tuple("123456")
RANDOM_SETS = 20
FEW = 20  # starts, to say where arrivals are felt
MADE = "placed by tactilerl"
"""Stands in the description of every layout that was designed."""


@dataclass(frozen=True)
class DesignFlags:
    """Which taxels may be chosen, by what, and from which starts."""

    scene: tuple[str, ...] = ("handover_anywhere",)
    """One or more named scenes, or scenes' .toml files."""
    env: str = ""
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file; default: the first scene's."""
    simulator: str = ""
    """Physics engine: mujoco or pybullet; default: the scene's."""
    taxels: str = "4"
    """How many taxels the hand may have: a number, or a range such as 1..12."""
    skin: str = "4mm"
    """What to choose from: the spacing of a grid over all surfaces, a layout, or a layout file."""
    radius: Annotated[float, "[0.1, 20]"] | None = None
    """Radius of the taxels, mm; default: the hand's own, or that of the layout."""
    only: tuple[str, ...] = ()
    """Only on these segments, digits, or segments of digits, such as palm distal index.middle."""
    leave_out: tuple[str, ...] = ()
    """Not on these, named likewise."""
    keep: str = ""
    """A layout whose taxels the hand has already; they count."""
    weights: tuple[Annotated[float, "(0, inf)"], ...] = ()
    """How much each scene counts; default: all alike."""
    redundancy: Annotated[int, "[1, 10]"] = 1
    """By how many taxels a start is to be felt in time: any but one of them may be dead."""
    taxel_dead: Annotated[float, "[0, 1)"] = 0.0
    """Probability that a taxel is dead."""
    false_on: Annotated[float, "[0, 1)"] = 0.0
    """Probability that a taxel fires in a step without being touched."""
    beside: tuple[str, ...] = BESIDE
    """Layouts to compare with."""
    starts: Annotated[int, f"[1, {MOST}]"] = 200
    """Starts of each scene to choose from."""
    test_starts: Annotated[int, f"[2, {MOST}]"] = 200
    """Other starts of each scene, on which everything is judged."""
    seed: Annotated[int, "[0, 999]"] = 0
    """Random seed of the starts."""
    workers: WorkerCount = None
    """Starts played side by side; default: one per free core. Results do not depend on it."""

    @property
    def numbers(self) -> range:
        """How many taxels, from and to."""
        try:
            low, high = bounds("taxels", self.taxels)
            whole = int(low), int(high)
        except (ValueError, OverflowError):
            whole = low, high = 0, 1
        if whole != (low, high) or not 1 <= low <= high <= 9999:
            raise ValueError(f"taxels: found {self.taxels!r}, allowed a number from 1 up, or LOW..HIGH")
        return range(whole[0], whole[1] + 1)

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        typed.require(type(self), vars(self))
        if self.numbers and self.redundancy > 1 and (self.taxel_dead or self.false_on):
            raise ValueError("redundancy: found with taxel_dead or false_on, allowed one of both")

    @property
    def aim(self) -> Aim:
        return Aim(self.redundancy, self.taxel_dead, self.false_on)


ASKED = sorted(typed.names(DesignFlags) - {"workers"})


@dataclass(frozen=True)
class Scene:
    """One of the scenes to design for."""

    name: str
    config: GraspConfig
    weight: float
    """Of all scenes; they sum to 1."""


@dataclass(frozen=True)
class Design:
    """What was chosen, and how good it is."""

    hand: Hand
    pool: Taxels
    chosen: dict[int, list[int]]
    """By number of taxels, indices in the pool, without those that were there already."""
    kept: list[int]
    worth: Array
    """(m,) of each of the pool alone: the share of starts that it wins, or bits a grasp."""
    result: dict[str, Any]
    """As JSON has it."""

    def layout(self, n: int) -> Layout:
        """A layout of `n` taxels, and those that were there already."""
        taxels = self.pool.take(sorted([*self.chosen[n], *self.kept]))
        where = ", ".join(self.result["scenes"])
        return layouts.of_taxels(taxels, self.hand, f"{n} taxel{'s' * (n > 1)} {MADE} for {where}")


def read_scenes(flags: DesignFlags) -> tuple[str, list[Scene]]:
    """The hand, and its scenes; ValueError where they do not go together."""
    if not flags.scene or len(set(flags.scene)) < len(flags.scene):
        raise ValueError(f"scene: found {list(flags.scene)}, allowed one or more, each once")
    weights = flags.weights or (1.0,) * len(flags.scene)
    if len(weights) != len(flags.scene):
        raise ValueError(f"weights: found {len(weights)}, allowed one for each of the scenes")
    every = [scenes.load(name) for name in flags.scene]
    hand = flags.env or every[0].env
    if not hands.is_hand(hand):
        raise ValueError(f"env: found {hand!r}, allowed: {hands.allowed()}")
    found = []
    for name, named, weight in zip(flags.scene, every, weights, strict=True):
        if not flags.env and named.env != hand:
            raise ValueError(
                f"scene: found {name} of {named.env}, allowed scenes of one hand, or --env"
            )
        choices = {"simulator": flags.simulator} if flags.simulator else {}
        config = setup(hand, **{**named.on(hand), **choices})
        typed.validate(config)
        found.append(Scene(name, config, weight / sum(weights)))
    return hand, found


def is_timing(found: Sequence[Scene]) -> bool:
    """Is the question when to close? Where an object is handed over; elsewhere it is whether a grasp
    will hold. ValueError where the scenes' tasks differ in that."""
    handed = {tasks.TASKS[scene.config.task].giver is not None for scene in found}
    if len(handed) > 1:
        raise ValueError("scene: found handovers beside other tasks, allowed one kind")
    return handed.pop()


def candidates(flags: DesignFlags, hand: Hand) -> Taxels:
    """What may be chosen; ValueError where nothing may."""
    segments = {surface.segment for surface in hand.surfaces}
    own = [
        {surface.segment, f"{surface.digit}.{surface.segment}", *({surface.digit} - segments)}
        for surface in hand.surfaces
    ]
    require_known((*flags.only, *flags.leave_out), set().union(*own))
    taxels = places.skin(flags.skin, hand)
    if flags.radius is not None:
        resized = (point._replace(radius=1e-3 * flags.radius) for point in taxels.points)
        taxels = replace(taxels, points=tuple(resized))
    is_allowed = [
        (not flags.only or not names.isdisjoint(flags.only)) and names.isdisjoint(flags.leave_out)
        for names in own
    ]
    left = [taxel for taxel, surface in enumerate(taxels.surfaces) if is_allowed[surface]]
    if not left:
        chosen = " ".join([*flags.only, *(f"--not {name}" for name in flags.leave_out)])
        raise ValueError(f"only: found {chosen!r}, which leaves no taxel of the skin {flags.skin}")
    if (most := flags.numbers[-1]) > len(left):
        raise ValueError(f"taxels: found {most}, allowed up to the {len(left)} that may be chosen")
    return taxels.take(left)


def design(
    flags: DesignFlags, workers: int, show: Callable[[int, int], None] = lambda done, of: None
) -> Design:
    """Choose taxels for handovers. `show` is told how many starts are played, of how many.

    ValueError where nothing may be chosen, nobody feels a start in time, or touch cannot help.
    """
    name, found = read_scenes(flags)
    if not is_timing(found):
        raise ValueError("scene: found no handover")
    hand = hands.get(name)
    kept = layouts.load(flags.keep).place(hand) if flags.keep else None
    pool = candidates(flags, hand)
    beside = {layout: layouts.load(layout).place(hand) for layout in flags.beside}
    skin = Skin.of([pool, *beside.values(), *([kept] if kept else [])], hand)
    columns = list(dict.fromkeys([*(skin.columns(kept) if kept else []), *skin.columns(pool)]))
    n_kept = len(kept) if kept else 0
    total, done = len(found) * (flags.starts + flags.test_starts), iter(range(1, 10**9))

    def played(scene: Scene, first: int, n: int) -> Recording:
        numbers = range(2 * gate.SEARCH * flags.seed + first, 2 * gate.SEARCH * flags.seed + first + n)
        every = flags.false_on > 0
        tick = lambda: show(next(done), total)  # noqa: E731
        return record(name, scene.config, skin, numbers, workers, every, tick)

    choice = [played(scene, CHOICE, flags.starts) for scene in found]
    test = [played(scene, TEST, flags.test_starts) for scene in found]
    early = np.any([each.early() for each in choice], axis=0)
    columns = [c for i, c in enumerate(columns) if i < n_kept or not early[c]]
    starts = _joined(choice, found, columns)
    _require_felt(starts, name, found[0].config, hand, workers)
    own = skin.taxels.take(columns)
    aim, rng = flags.aim, np.random.default_rng(flags.seed)
    judge = _Judge(test, found, aim)
    rows, chosen = [judge.row(layout, skin.columns(taxels)) for layout, taxels in beside.items()], {}
    rows.append(judge.row("whole skin", columns))
    best = max(rows[: len(beside)], key=lambda row: row["success"], default=None)
    for n in flags.numbers:
        picked = cover.choose(starts, n + n_kept, aim, range(n_kept))
        chosen[n] = [i for i in picked.taxels if i >= n_kept]
        row = judge.row("chosen", [columns[i] for i in picked.taxels])
        row |= {"taxels": n, "chosen_from": picked.value, "bound": picked.bound}
        if best is not None:
            other = skin.columns(beside[best["layout"]])
            row["difference"] = judge.difference([columns[i] for i in picked.taxels], other)
        rows.append(row)
        rows.append(judge.random(n, columns, n_kept, rng))
    result = {
        "question": "timing",
        "env": name,
        "simulator": found[0].config.simulator,
        "scenes": [scene.name for scene in found],
        "asking": {name: value for name, value in asdict(flags).items() if name in ASKED},
        "candidates": len(columns) - n_kept,
        "early": [skin.taxels.names[c] for c in np.flatnonzero(early) if c in skin.columns(pool)],
        "hopeless": float(np.mean([~each.succeeds.any(axis=1) for each in test])),
        "beside": None if best is None else best["layout"],
        "rows": rows,
        "places": {n: [asdict(place) for place in places.of(own.take(chosen[n]))] for n in chosen},
    }
    return Design(hand, own, chosen, list(range(n_kept)), starts.weights @ starts.good, result)


def _joined(
    recordings: Sequence[Recording], found: Sequence[Scene], columns: list[int]
) -> cover.Starts:
    parts = [
        each.starts(columns, np.full(len(each.fires), scene.weight / len(each.fires)))
        for each, scene in zip(recordings, found, strict=True)
    ]
    names = typed.names(cover.Starts)
    return cover.Starts(**{name: np.concatenate([vars(p)[name] for p in parts]) for name in names})


class _Judge:
    """What sets of taxels win in starts from which none of them was chosen."""

    def __init__(self, test: Sequence[Recording], found: Sequence[Scene], aim: Aim) -> None:
        self._test, self._aim = test, aim
        self._every = _joined(test, found, list(range(test[0].fires.shape[1])))
        rng = np.random.default_rng(0)
        self._counts = statistics.resample(rng, len(self._every), 10_000)

    def row(self, layout: str, taxels: list[int]) -> dict[str, Any]:
        """Success and share felt, with intervals."""
        row: dict[str, Any] = {"layout": layout, "taxels": len(taxels)}
        for name, scores in (("success", self._scores(taxels)), ("felt", self._felt(taxels))):
            row[name] = float(self._every.weights @ scores)
            row[f"{name}_interval"] = self._interval(scores)
        return row

    def random(
        self, n: int, columns: list[int], n_kept: int, rng: np.random.Generator
    ) -> dict[str, Any]:
        """Means over random sets of as many."""
        sets = [
            columns[:n_kept] + rng.choice(columns[n_kept:], n, replace=False).tolist()
            for _ in range(RANDOM_SETS)
        ]
        success, felt = (
            float(self._every.weights @ np.mean([of(taxels) for taxels in sets], axis=0))
            for of in (self._scores, self._felt)
        )
        return {"layout": "random", "taxels": n, "success": success, "felt": felt}

    def difference(self, a: list[int], b: list[int]) -> dict[str, Any]:
        """By how much `a` is above `b` in the same starts, with intervals."""
        pairs = {"success": self._scores(a) - self._scores(b), "felt": self._felt(a) - self._felt(b)}
        n, weights = len(self._every), self._every.weights
        return {
            name: list(statistics.mean(n * weights * gained, self._counts))
            for name, gained in pairs.items()
        }

    def _felt(self, taxels: list[int]) -> Array:
        return np.concatenate([each.felt(taxels) for each in self._test]).astype(float)

    def _scores(self, taxels: list[int]) -> Array:
        return cover.scores(self._every, np.array([taxels], int), self._aim)[:, 0]

    def _interval(self, scores: Array) -> list[float]:
        """Wilson's where starts succeed or not and count alike, else the bootstrap's."""
        n, weights = len(scores), self._every.weights
        if np.allclose(weights, 1 / n) and np.isin(scores, (0.0, 1.0)).all():
            return list(statistics.wilson_interval(round(scores.sum()), n))
        return list(statistics.mean(n * weights * scores, self._counts)[1:])


def _require_felt(
    starts: cover.Starts, name: str, scene: GraspConfig, hand: Hand, workers: int
) -> None:
    """ValueError where no candidate feels anything in time, or touch has nothing to win."""
    if not starts.good.any():
        skin = Skin.of([places.skin("6mm", hand)], hand)
        seen = record(name, scene, skin, range(CHOICE, CHOICE + FEW), workers)
        places_felt = sorted(
            f"{hand.surfaces[place.surface].digit}.{hand.surfaces[place.surface].segment}"
            for place, column in skin.index.items()
            if seen.succeeds[np.arange(FEW), seen.fires[:, column]].any()
        )
        where = ", ".join(dict.fromkeys(places_felt)) or "nothing of the hand in time"
        raise ValueError(
            f"skin: no taxel feels any start in time; arrivals meet {where}, where it has none"
        )
    n = min(len(starts), 100)
    without = gate.examine(name, scene, n, max(1, n // 20), 0, workers, senses=("joints", "sight"))
    whole = cover.value(starts, range(starts.fires.shape[1]))
    best = max(without, key=lambda each: each.rate)
    if whole - best.rate < gate.TELLS:
        raise ValueError(
            f"scene: touch cannot help here: a reflex by {best.name} succeeds in {best.rate:.2f} of "
            f"the starts, one that feels with the whole skin in {whole:.2f}"
        )
