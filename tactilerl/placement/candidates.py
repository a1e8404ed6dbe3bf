"""Read the flags of a design: its scenes, the taxels that may be chosen, and what they cost."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from ..envs import hands, layouts, scenes, sensors, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import Hand, Point, Surface
from ..envs.hands.geometry import placed
from ..envs.layouts import Layout, Patch, Taxels
from ..envs.observations import TaxelFaults
from ..envs.sensors import Cost
from ..envs.state import Array
from ..envs.validation import Newtons, require_known
from ..machine import WorkerCount
from ..pictures import hand_map

Spacing = Annotated[float, "[0.5, 50]"]
"""Distance of the taxels of a dense skin, mm."""
TOUCHING = 1e-6  # m by which two sensors may overlap, so that those that just fit do
INTACT: dict[str, Any] = {"touch": "on", **asdict(TaxelFaults())}
"""Fields of a scene whose recording serves all its taxels, whichever of them there
are."""


@dataclass(frozen=True)
class DesignFlags:
    """Options of a design: which taxels may be chosen, by what, and from which starts."""

    scene: tuple[str, ...] = ("handover_anywhere",)
    """One or more named scenes, or scenes' .toml files, in which an object is handed
    over; all count alike."""
    env: str = ""
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file; default: the
    first scene's."""
    sensor: str = ""
    """A sensor, by name or .toml file: its radius, threshold, delay and price."""
    budget: Annotated[float, "(0, inf)"] | None = None
    """Money for taxels and boards, in the currency of the sensor's [cost]; the table
    also shows what smaller sums buy."""
    boards: str = ""
    """What one board may serve: taxel, digit, segment, or a .toml file with a [[group]]
    for each; default: the whole hand."""
    taxels: str = ""
    """Number of taxels to place, or a range such as 1..12; default: 4, or 1..12 with
    --budget."""
    skin: str = "4mm"
    """Candidates: the spacing of a grid over all surfaces, a layout, or a layout
    file."""
    radius: Annotated[float, "[0.1, 20]"] | None = None
    """Radius of your sensors, mm. With it, no two chosen ones overlap. Default: the
    sensor's, or that of the first scene; else the hand's own, or that of the layout."""
    margin: Annotated[float, "[0, 50]"] = 0.0
    """Smallest distance of a taxel from each edge of its segment, mm, so that a housing
    fits."""
    only: tuple[str, ...] = ()
    """Only on these segments, digits, or segments of digits, such as palm distal
    index.middle."""
    keep: str = ""
    """A layout whose taxels the hand already has; the chosen ones are added to them."""
    taxel_threshold: Newtons | None = None
    """Force from which a taxel fires, N; default: the sensor's, the first scene's, or
    any touch."""
    survives: str = ""
    """Maximise success after the worst loss of what fails together: taxel, digit,
    segment, or a .toml file with a [[group]] for each."""
    start_closing: tuple[Annotated[float, "[0, 1)"], ...] = ()
    """How far the hand is closed while it waits, from open (0) to closed (1); default:
    as in the first scene. With several, each set of taxels uses its best."""
    beside: tuple[str, ...] = tuple("123456")
    """Layouts to compare with."""
    starts: Annotated[int, "[1, 250000]"] = 200
    """Starts of each scene to choose from."""
    test_starts: Annotated[int, "[2, 250000]"] = 200
    """Other starts of each scene, on which everything is judged."""
    seed: Annotated[int, "[0, 999]"] = 0
    """Random seed of the starts."""
    workers: WorkerCount = None
    """Starts played side by side; default: one per free core. Results do not depend on
    it."""

    @property
    def choices(self) -> dict[str, Any]:
        """The fields of the scenes that these flags choose: which sensor their taxels are."""
        said = {
            "sensor": self.sensor or None,
            "taxel_radius": self.radius and 1e-3 * self.radius,
            "taxel_threshold": self.taxel_threshold,
        }
        return {name: value for name, value in said.items() if value is not None}

    @property
    def numbers(self) -> range:
        """Numbers of taxels; ValueError where that is no range."""
        asked = self.taxels or ("4" if self.budget is None else "1..12")
        match = re.fullmatch(r"(\d{1,4})(?:\.\.(\d{1,4}))?", asked)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= low <= high:
            allowed = "a number from 1 to 9999, or LOW..HIGH"
            raise ValueError(f"taxels: found {self.taxels!r}, allowed {allowed}")
        return range(low, high + 1)

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        validation.require(type(self), vars(self))
        if not self.scene:
            raise ValueError("scene: found none, allowed one or more handovers")
        _ = self.numbers


def scenes_of(flags: DesignFlags) -> tuple[str, dict[str, GraspConfig]]:
    """Return the hand and its scenes by name, with the sensor that may be bought.

    Raise ValueError where a design cannot be made in one.
    """
    env, configs = flags.env or scenes.load(flags.scene[0]).env, {}
    for name in flags.scene:
        config = setup(env, **scenes.load(name).on(env))
        for wait in flags.start_closing or [config.start_closing]:
            validation.validate(replace(config, start_closing=wait))
        if tasks.TASKS[config.task].giver is None:
            raise ValueError(
                f"scene: found {name}, whose object lies on the ground, allowed handovers; "
                f"`tactilerl gate --scene {name}` says what touch can win there"
            )
        if config != replace(config, **INTACT):
            raise ValueError(
                f"scene: found {name}, where touch is off or taxels fail at random, which no recording "
                "can know; --survives designs for the worst loss"
            )
        configs[name] = sensors.choose(config, flags.choices)
    return env, configs


def candidates(flags: DesignFlags, hand: Hand) -> Taxels:
    """Return the taxels that may be chosen; ValueError where there are none."""
    segments = {surface.segment for surface in hand.surfaces}
    names = [
        _names(surface)
        # The palm under a digit is not part of it.
        | ({surface.digit} - segments if surface.segment != "palm" else set())
        for surface in hand.surfaces
    ]
    require_known(flags.only, set().union(*names))
    is_allowed = [not flags.only or bool(each & {*flags.only}) for each in names]
    taxels, margin = skin(flags.skin, hand), 1e-3 * flags.margin
    spots = zip(taxels.surfaces.tolist(), taxels.offsets, strict=True)
    allowed = [
        i
        for i, (index, (row, column, _)) in enumerate(spots)
        if is_allowed[index]
        and (not margin or has_margin(hand.surfaces[index], row, column, margin))
    ]
    if not allowed:
        where = "that --only and --margin allow"
        raise ValueError(f"skin: found no place of {flags.skin} {where}")
    return taxels.take(allowed)


def skin(name: str, hand: Hand) -> Taxels:
    """Return a layout's taxels, or those of a dense skin such as "2mm".

    That is a grid over the palmar side of the whole hand, with every segment and a flat
    palm around the bases of the fingers; its taxels have the radius of the hand's own.
    Raise ValueError and FileNotFoundError where there is none.
    """
    if "\n" in name or not name.endswith("mm"):
        return layouts.load(name).place(hand)
    try:
        spacing = validation.require_type(float(name[:-2]), Spacing, "skin")
    except ValueError:
        raise ValueError(
            f"skin: found {name!r}, allowed a layout, or a spacing from 0.5mm to 50mm"
        ) from None
    patches, radius = [], hand.pitch.radius
    for surface in hand.surfaces:
        offsets = tuple(_grid(surface, 1e-3 * spacing, radius))
        names = (surface.digit,), (surface.segment,)
        patches.append(Patch(*names, offsets, 1e3 * radius))
    return Layout(name, "", tuple(patches)).place(hand)


def _grid(
    surface: Surface, spacing: float, radius: float
) -> Iterator[tuple[float, float]]:
    """Yield (row, column) in mm of as many as the surface carries, through its middle.

    `spacing` and `radius` are in m. The tip of a capsule is round and its taxels stand
    as on a cylinder: rows go on over the tip as long as a taxel still reaches the skin
    under it.
    """
    begin, end, half_width = surface.span
    if surface.segment == "distal" and surface.bone is not None:
        end += np.sqrt((half_width + radius) ** 2 - half_width**2)
    rows = np.arange(np.ceil(begin / spacing), np.floor(end / spacing) + 1) * spacing
    beside = np.floor(half_width / spacing)
    columns = np.clip(np.arange(-beside, beside + 1) * spacing, -half_width, half_width)
    for row, column in product(rows.tolist(), columns.tolist()):
        if surface.place(row, column):
            yield 1e3 * row, 1e3 * column


def _names(surface: Surface) -> set[str]:
    """Return the names of a surface: a segment, and a digit's segment."""
    return {surface.segment, f"{surface.digit}.{surface.segment}"}


def has_margin(surface: Surface, row: float, column: float, margin: float) -> bool:
    """Tell whether a place is at least `margin` m from every edge of its surface.

    Edges are those that one sees from the palmar side.
    """
    low, high, half_width = surface.span
    if surface.segment == "distal" and surface.bone is not None:
        high += half_width  # a fingertip is round
    around = [(row + step, column) for step in (-margin, margin)]
    around += [(row, column + step) for step in (-margin, margin)]
    return all(
        low <= r <= high and abs(c) <= half_width and surface.place(r, c) is not None
        for r, c in around
    )


def fitted(taxels: Taxels, **changes: float | None) -> Taxels:
    """Return taxels with another radius, m, or threshold, N, where that is given."""
    given: Any = {name: x for name, x in changes.items() if x is not None}
    points = tuple(point._replace(**given) for point in taxels.points)
    return replace(taxels, points=points)


def joined(sets: Sequence[Taxels]) -> tuple[Taxels, list[list[int]]]:
    """Return the taxels of all sets, one set after the other, and the indices of each set's.

    One that has the name of a taxel in another place gets a number behind its name.
    """
    points, spots = list[Point](), dict[str, Any]()
    for point in (point for taxels in sets for point in taxels.points):
        spot, name, n = spot_of(point), point.name, 1
        while spots.setdefault(name, spot) != spot:
            n += 1
            name = f"{point.name} {n}"
        points.append(point._replace(name=name))
    surfaces = np.concatenate([taxels.surfaces for taxels in sets])
    offsets = np.concatenate([taxels.offsets for taxels in sets])
    ends = np.cumsum([len(taxels) for taxels in sets])
    parts = np.split(np.arange(len(points)), ends[:-1])
    taxels = Taxels((*points,), surfaces, offsets)
    return taxels, [part.tolist() for part in parts]


def spot_of(point: Point) -> Any:
    """Return what taxels in one place have in common, whatever their size."""
    return point.link, *map(layouts.mm, point.position)


def overlap(hand: Hand, taxels: Taxels) -> Array:
    """Return which two sensors do not fit beside each other on the open hand, bool (n, n)."""
    data = hand_map.at_start(hand)
    points = np.array([placed(data, p.link, p.position) for p in taxels.points])
    least = np.add.outer(taxels.radii, taxels.radii) - TOUCHING
    return np.asarray(cdist(points, points) < least)


class Groups(NamedTuple):
    """List taxels that fail together, or share a board."""

    names: tuple[str, ...]
    members: Array
    """(g, m) bool: which taxels of the skin are in each."""


@dataclass(frozen=True)
class GroupTable:
    """One [[group]] of a file: taxels, digits or segments, by name."""

    name: str
    taxels: tuple[str, ...] = ()
    digits: tuple[str, ...] = ()
    segments: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroupFile:
    """All that a file of groups may say."""

    group: tuple[GroupTable, ...]


def groups_of(kind: str, hand: Hand, taxels: Taxels, flag: str) -> Groups:
    """Return each taxel, digit or segment (the palm is one) as a group, or the groups of a file.

    Raise ValueError naming what is wrong with the `flag`, and FileNotFoundError.
    """
    surfaces = [hand.surfaces[index] for index in taxels.surfaces.tolist()]
    digits = ["palm" if s.segment == "palm" else s.digit for s in surfaces]
    on = zip(digits, surfaces, strict=True)
    segments = ["palm" if d == "palm" else f"{d}.{s.segment}" for d, s in on]
    parts = {"taxel": list(taxels.names), "digit": digits, "segment": segments}
    if kind in parts:
        names = tuple(dict.fromkeys(parts[kind]))
        return Groups(names, np.array(parts[kind]) == np.array(names)[:, None])
    if not kind.endswith(".toml"):
        allowed = f"{', '.join(parts)}, or a .toml file"
        raise ValueError(f"{flag}: found {kind!r}, allowed {allowed}")
    path = Path(kind)
    content = validation.read(path, "file of groups")
    with validation.blamed(f"file of groups {path}"):
        groups = validation.fill(GroupFile, content).group
        if not groups:
            raise ValueError("group: found none, allowed one or more")
        for group in groups:
            require_known(group.digits, hand.digits)
            require_known(group.segments, set().union(*map(_names, hand.surfaces)))
            require_known(group.taxels, taxels.names)
            if not (group.taxels or group.digits or group.segments):
                raise ValueError(
                    f"group {group.name!r}: found no taxel, digit or segment"
                )
    members = [
        [
            name in group.taxels
            or digit in group.digits
            or not _names(surface).isdisjoint(group.segments)
            for name, digit, surface in zip(taxels.names, digits, surfaces, strict=True)
        ]
        for group in groups
    ]
    return Groups(tuple(group.name for group in groups), np.array(members))


@dataclass(frozen=True)
class Prices:
    """Say what sets of taxels cost: each one, and each board that reads some of one group."""

    cost: Cost
    groups: Array
    """(m,) int: each taxel's group. A board serves one group only."""

    @property
    def channels(self) -> int:
        """Number of taxels that a board reads."""
        return self.cost.channels or len(self.groups)

    def _counts(self, taxels: Sequence[int]) -> Array:
        """Return how many of some taxels are in each group (g,)."""
        return np.bincount(self.groups[list(taxels)], minlength=self.groups.max() + 1)

    def of(self, taxels: Sequence[int]) -> float:
        """Return the price of some taxels and their boards."""
        boards = np.ceil(self._counts(taxels) / self.channels).sum()
        return self._price(len(taxels), int(boards))

    def _price(self, n: int, boards: int) -> float:
        return round(self.cost.each * n + self.cost.board * boards, 6)

    def fits(self, taxels: Sequence[int], boards: int) -> Array:
        """Tell which taxels go on to no more than some boards beside these, bool (m,)."""
        counts = self._counts(taxels)
        needs_another = counts % self.channels == 0
        used = np.ceil(counts / self.channels).sum()
        return np.asarray(used + needs_another[self.groups] <= boards)

    def sizes(
        self, taxels: Sequence[int], numbers: range, budget: float
    ) -> list[tuple[int, int]]:
        """Return the numbers of taxels, of these, and of boards that some money buys.

        Raise ValueError where that is not even the least of the `numbers`.
        """
        n_groups, sizes = len(np.unique(self.groups[list(taxels)])), []
        for n in numbers:
            most = min(n, n_groups + max(0, n - n_groups) // self.channels)
            fewest = -(-n // self.channels) if self.cost.board else most
            sizes += [(n, boards) for boards in range(fewest, most + 1)]
        if (least := self._price(*sizes[0])) > budget:
            n, boards = sizes[0]
            raise ValueError(
                f"budget: found {budget:g}, allowed {least:g} or more, the price of "
                f"{n} of these sensors and {boards} of their boards"
            )
        return [size for size in sizes if self._price(*size) <= budget]


def priced(flags: DesignFlags, hand: Hand, skin: Taxels, free: Array) -> Prices | None:
    """Return what taxels cost; None where nobody says it.

    Raise ValueError for a budget then, and for one that may be chosen and that no board
    serves.
    """
    cost = sensors.load(flags.sensor).cost if flags.sensor else None
    if cost is None:
        for flag in ("budget", "boards"):
            if value := getattr(flags, flag):
                raise ValueError(
                    f"{flag}: found {value}, allowed with a --sensor that has a [cost]"
                )
        return None
    if not flags.boards:
        return Prices(cost, np.zeros(len(skin), int))
    _, members = groups_of(flags.boards, hand, skin, "boards")
    for index in np.flatnonzero(free).tolist():
        if (n := members[:, index].sum()) != 1:
            raise ValueError(
                f"boards: found {skin.names[index]} in {n} of the groups of {flags.boards}, allowed in "
                "one"
            )
    return Prices(cost, members.argmax(axis=0))


@dataclass(frozen=True)
class Pool:
    """Hold a hand in some scenes, and which taxels of its skin are whose. They go by their index."""

    flags: DesignFlags
    env: str
    scenes: dict[str, GraspConfig]
    hand: Hand
    skin: Taxels
    """First those that the hand has already, then candidates, then layouts to compare
    with."""
    existing: list[int]
    """Taxels that the hand has already."""
    free: Array
    """(n,) bool: which of these and of the candidates may be chosen?"""
    references: dict[str, list[int]]
    """Taxels of the layouts to compare with, by name."""
    losses: Groups
    prices: Prices | None = None
    """None where the sensor's file says none."""
    overlap: Array | None = None
    """(n, n) bool: which two do not fit beside each other? None where nobody said their
    radius."""
    early: tuple[str, ...] = ()
    """Names of candidates that were left out."""

    @classmethod
    def of(cls, flags: DesignFlags) -> Pool:
        """Do as the flags say; ValueError for an invalid one, and where they do not go together."""
        flags.validate()
        env, scenes = scenes_of(flags)
        hand = hands.get(env)
        first = next(iter(scenes.values()))
        fit = fitted(candidates(flags, hand), radius=first.taxel_radius)
        there = layouts.load(flags.keep).place(hand) if flags.keep else fit.take([])
        named = [layouts.load(name).place(hand) for name in flags.beside]
        skin, (existing, chosen_from, *beside) = joined([there, fit, *named])
        skin = fitted(skin, threshold_N=first.taxel_threshold)
        # Whatever its size, no taxel is chosen where there is one.
        spots = [*map(spot_of, skin.points)]
        taken = {spots[index] for index in existing}
        own = existing + chosen_from
        free = np.array([spots[i] not in taken for i in own])
        pool = cls(
            flags=flags,
            env=env,
            scenes=scenes,
            hand=hand,
            skin=skin,
            existing=existing,
            free=free,
            references=dict(zip(flags.beside, beside, strict=True)),
            losses=groups_of(flags.survives or "taxel", hand, skin, "survives"),
            prices=priced(flags, hand, skin, free),
            overlap=overlap(hand, skin.take(own)) if first.taxel_radius else None,
        )
        pool.sizes()  # raises where none can be had
        if pool.needed > free.sum():
            allowed = f"up to the {free.sum()} that may be chosen"
            raise ValueError(f"taxels: found {pool.needed}, allowed {allowed}")
        return pool

    @property
    def first(self) -> GraspConfig:
        """The first scene: its sensor is that of all."""
        return next(iter(self.scenes.values()))

    @property
    def waits(self) -> tuple[float, ...]:
        """Ways to wait: shares by which the hand is closed."""
        return self.flags.start_closing or (self.first.start_closing,)

    @property
    def needed(self) -> int:
        """Number of taxels that must be chosen: within a budget, the least that is asked for."""
        return self.flags.numbers[-1 if self.flags.budget is None else 0]

    @property
    def to_survive(self) -> Array:
        """(g, m) bool: the losses after which a choice is to succeed; none where nobody asked."""
        members = self.losses.members
        return members if self.flags.survives else members[:0]

    @property
    def whole(self) -> list[int]:
        """All that the hand can have: what it has, and all that may be chosen."""
        return [*self.existing, *np.flatnonzero(self.free).tolist()]

    def sizes(self) -> list[tuple[int, int]]:
        """Return how many taxels, and on how many boards, sets may have; 0 boards: any number."""
        numbers, budget = self.flags.numbers, self.flags.budget
        if not self.free.any():
            raise ValueError("skin: found no place that may still be chosen")
        if self.prices is None or budget is None:
            return [(n, 0) for n in numbers]
        return self.prices.sizes(np.flatnonzero(self.free).tolist(), numbers, budget)

    def fits(self, boards: int, taxels: Sequence[int]) -> Array:
        """Tell which others find room beside some of them, and on 0 (any) boards, bool (n,)."""
        is_free = self.free.copy()
        is_free[list(taxels)] = False
        if self.overlap is not None:
            is_free &= ~self.overlap[list(taxels)].any(axis=0)
        if boards and self.prices is not None:
            bought = [taxel for taxel in taxels if taxel not in self.existing]
            is_free &= self.prices.fits(bought, boards)[: len(is_free)]
        return is_free

    def without(self, early: Array) -> Pool:
        """Leave out candidates that are `early`, bool (m,) of the whole skin."""
        is_early = self.free & early[: len(self.free)]
        names = tuple(self.skin.names[i] for i in np.flatnonzero(is_early))
        return replace(self, free=self.free & ~is_early, early=names)
