"""Read the flags of a design: its scenes, and the taxels that may be chosen."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..envs import hands, layouts, scenes, sensors, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import Hand, Surface
from ..envs.hands.geometry import placed
from ..envs.layouts import Taxels
from ..envs.observations import TaxelFaults
from ..envs.sensors import Cost
from ..envs.state import Array
from ..envs.validation import Newtons, require_known
from ..machine import WorkerCount
from ..pictures import places
from . import cover
from .prices import Prices

TOUCHING = 1e-6  # m by which two sensors may overlap, so that those that just fit do
ANGLES = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
"""Directions in which the margin of a taxel is looked at, rad."""
KINDS = ("taxel", "digit", "segment")
INTACT: dict[str, Any] = {"touch": "on", **asdict(TaxelFaults())}
"""Fields of a scene whose recording serves all its taxels, whichever of them there are."""


class Kind(NamedTuple):
    """A kind of sensor, as far as a design takes it into account; what is None nobody said."""

    name: str | None
    radius: float | None
    threshold: float | None
    delay: float
    cost: Cost | None


@dataclass(frozen=True)
class DesignFlags:
    """Options of a design: which taxels may be chosen, by what, and from which starts."""

    scene: tuple[str, ...] = ("handover_anywhere",)
    """One or more named scenes, or scenes' .toml files, in which an object is handed over; all count
    alike."""
    env: str = ""
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file; default: the first scene's."""
    simulator: str = ""
    """Physics engine: mujoco or pybullet; default: the scene's."""
    sensor: tuple[str, ...] = ()
    """Sensors, by name or .toml file: their radius, threshold, delay and price. With several, each has
    a table of its own, on the same starts."""
    budget: Annotated[float, "(0, inf)"] | None = None
    """Money for taxels and boards, in the currency of the sensor's [cost]; the table also shows what
    smaller sums buy."""
    boards: str = ""
    """What one board may serve: taxel, digit, segment, or a .toml file with a [[group]] for each;
    default: the whole hand."""
    taxels: str = ""
    """Number of taxels to place, or a range such as 1..12; default: 4, or 1..12 with --budget."""
    skin: str = "4mm"
    """Candidates: the spacing of a grid over all surfaces, a layout, or a layout file."""
    radius: Annotated[float, "[0.1, 20]"] | None = None
    """Radius of your sensors, mm. With it, no two chosen ones overlap along the skin. Default: the
    sensor's; else the hand's own, or that of the layout."""
    margin: Annotated[float, "[0, 50]"] = 0.0
    """Smallest distance of a taxel from each edge of its segment, mm, so that a housing fits."""
    only: tuple[str, ...] = ()
    """Only on these segments, digits, or segments of digits, such as palm distal index.middle."""
    leave_out: tuple[str, ...] = ()
    """Not on these, named as for --only."""
    keep: str = ""
    """A layout whose taxels the hand already has; the chosen ones are added to them."""
    taxel_threshold: tuple[Newtons, ...] = ()
    """Force from which a taxel fires, N; default: the sensor's, the scene's, or any touch. With
    several, there is a table for each."""
    survives: str = ""
    """Maximise success after the worst loss of what fails together: taxel, digit, segment, or a .toml
    file with a [[group]] for each."""
    start_closing: tuple[Annotated[float, "[0, 1)"], ...] = ()
    """How far the hand is closed while it waits, from open (0) to closed (1); default: the scene's.
    With several, each set of taxels uses its best."""
    beside: tuple[str, ...] = tuple("123456")
    """Layouts to compare with."""
    starts: Annotated[int, "[1, 250000]"] = 200
    """Starts of each scene to choose from."""
    test_starts: Annotated[int, "[2, 250000]"] = 200
    """Other starts of each scene, on which everything is judged."""
    seed: Annotated[int, "[0, 999]"] = 0
    """Random seed of the starts."""
    workers: WorkerCount = None
    """Starts played side by side; default: one per free core. Results do not depend on it."""

    def kinds(self, scene: GraspConfig) -> list[Kind]:
        """Return all sensors to compare, each with every threshold; what none says is the scene's."""
        kinds = []
        for name, force in product(
            self.sensor or ("",), self.taxel_threshold or (None,)
        ):
            file = vars(sensors.load(name)) if name else {}
            known = file.get
            if known("delay") is None:
                file["delay"] = scene.taxel_delay * scene.control_dt
            thresholds = force, known("threshold"), scene.taxel_threshold
            kinds.append(
                Kind(
                    name=known("name"),
                    radius=1e-3 * self.radius if self.radius else known("radius"),
                    threshold=next((x for x in thresholds if x is not None), None),
                    delay=file["delay"],
                    cost=known("cost"),
                )
            )
        return kinds

    @property
    def waits(self) -> tuple[float | None, ...]:
        """Ways to wait: shares by which the hand is closed; None for as each scene has it."""
        return self.start_closing or (None,)

    @property
    def numbers(self) -> range:
        """Numbers of taxels; ValueError where that is no range."""
        asked = self.taxels or ("4" if self.budget is None else "1..12")
        match = re.fullmatch(r"(\d{1,4})(?:\.\.(\d{1,4}))?", asked)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= low <= high:
            allowed = "a number from 1 up, or LOW..HIGH"
            raise ValueError(f"taxels: found {self.taxels!r}, allowed {allowed}")
        return range(low, high + 1)

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        validation.require(type(self), vars(self))
        if not self.scene:
            raise ValueError("scene: found none, allowed one or more handovers")
        _ = self.numbers
        for name in ("scene", "sensor", "taxel_threshold", "start_closing", "beside"):
            require_distinct(name, getattr(self, name))


def require_distinct(name: str, values: Sequence[object]) -> None:
    """Raise ValueError where one of the values is there twice."""
    for value, n in Counter(values).items():
        if n > 1:
            raise ValueError(f"{name}: found {value} {n} times, allowed once")


def scenes_of(flags: DesignFlags) -> tuple[str, dict[str, GraspConfig]]:
    """Return the hand and its scenes by name; ValueError where they do not go together."""
    env, configs = flags.env or scenes.load(flags.scene[0]).env, {}
    if not hands.is_hand(env):
        raise ValueError(f"env: found {env!r}, allowed: {hands.allowed()}")
    simulator = {"simulator": flags.simulator} if flags.simulator else {}
    for name in flags.scene:
        scene = scenes.load(name)
        if not flags.env and scene.env != env:
            allowed = "scenes of one hand, or --env"
            raise ValueError(f"scene: found {name} of {scene.env}, allowed {allowed}")
        config = configs[name] = setup(env, **{**scene.on(env), **simulator})
        validation.validate(waiting(config, flags.waits[0]))
        if tasks.TASKS[config.task].giver is None:
            raise ValueError(
                f"scene: found {name}, whose object lies on the ground, allowed handovers; "
                f"what touch can win there says tactilerl gate --scene {name}"
            )
        for field, usual in INTACT.items():
            if (value := getattr(config, field)) != usual:
                raise ValueError(
                    f"scene: found {name} with {field} {value}, allowed {usual}: a recording cannot "
                    "know which taxels that strikes; --survives designs for the worst loss"
                )
    for field in ("taxel_threshold", "taxel_delay"):
        if len(found := {getattr(config, field) for config in configs.values()}) > 1:
            raise ValueError(f"scene: found {field} {found}, allowed the same in all")
    return env, configs


def waiting(scene: GraspConfig, wait: float | None) -> GraspConfig:
    """Return a scene with a hand that is so far closed while it waits; None for as it is."""
    return scene if wait is None else replace(scene, start_closing=wait)


def candidates(flags: DesignFlags, hand: Hand) -> Taxels:
    """Return the taxels that may be chosen; ValueError where there are none."""
    segments = {surface.segment for surface in hand.surfaces}
    names = [
        {*_names(surface), *({surface.digit} - segments)} for surface in hand.surfaces
    ]
    require_known((*flags.only, *flags.leave_out), set().union(*names))
    is_allowed = [
        (not flags.only or not answers.isdisjoint(flags.only))
        and answers.isdisjoint(flags.leave_out)
        for answers in names
    ]
    taxels, margin = places.skin(flags.skin, hand), 1e-3 * flags.margin
    spots = zip(taxels.surfaces.tolist(), taxels.offsets, strict=True)
    allowed = [
        i
        for i, (index, (row, column, _)) in enumerate(spots)
        if is_allowed[index] and has_margin(hand.surfaces[index], row, column, margin)
    ]
    if not allowed:
        where = "that --only, --not and --margin allow"
        raise ValueError(f"skin: found no place of {flags.skin} {where}")
    return taxels.take(allowed)


def fitted(taxels: Taxels, **changes: float | None) -> Taxels:
    """Return taxels with another radius, m, or threshold, N, where that is given."""
    given: Any = {name: x for name, x in changes.items() if x is not None}
    points = tuple(point._replace(**given) for point in taxels.points)
    return replace(taxels, points=points)


def _names(surface: Surface) -> set[str]:
    """Return the names of a surface: a segment, and a digit's segment."""
    return {surface.segment, f"{surface.digit}.{surface.segment}"}


def has_margin(surface: Surface, row: float, column: float, margin: float) -> bool:
    """Tell whether a place is at least `margin` m from every edge of its surface.

    Edges are those that one sees from the palmar side.
    """
    if not margin:
        return True
    low, high, half_width = surface.span
    if surface.segment == "distal" and surface.bone is not None:
        high += half_width  # a fingertip is round
    if not low + margin <= row <= high - margin or abs(column) > half_width - margin:
        return False
    around = zip(
        row + margin * np.sin(ANGLES), column + margin * np.cos(ANGLES), strict=True
    )
    return not any(surface.is_gap(*place) for place in around)


def overlap(hand: Hand, taxels: Taxels) -> Array:
    """Return which two sensors do not fit beside each other on the open hand, bool (n, n).

    The skin between two taxels turns like an arc: of the line between them, the part in the direction
    in which their normals differ is a chord. That is exact on planes, cylinders and spheres.
    """
    data = places.at_start(hand)
    points = np.array([placed(data, p.link, p.position) for p in taxels.points])
    normals = np.array(
        [placed(data, p.link, p.normal) - data.body(p.link).xpos for p in taxels.points]
    )
    near = cKDTree(points).query_pairs(2 * taxels.radii.max(), output_type="ndarray")
    first, second = near.T
    apart, turned = points[first] - points[second], normals[first] - normals[second]
    half_turns = np.clip(np.linalg.norm(turned, axis=1) / 2, 1e-9, 1.0)
    chords = (apart * turned).sum(axis=1) / (2 * half_turns)
    longer = np.arcsin(half_turns) / half_turns
    squared = (apart**2).sum(axis=1) + chords**2 * (longer**2 - 1)
    is_too_near = (
        np.sqrt(squared) < taxels.radii[first] + taxels.radii[second] - TOUCHING
    )
    overlapping = np.zeros((len(taxels), len(taxels)), bool)
    overlapping[first, second] = overlapping[second, first] = is_too_near
    return overlapping


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
    if kind == "taxel":
        return Groups(taxels.names, np.eye(len(taxels), dtype=bool))
    if kind in KINDS:
        parts = [
            "palm" if surface.segment == "palm"
            else surface.digit if kind == "digit"
            else f"{surface.digit}.{surface.segment}"
            for surface in surfaces
        ]  # fmt: skip
        names = tuple(dict.fromkeys(parts))
        return Groups(names, np.array(parts) == np.array(names)[:, None])
    if not kind.endswith(".toml"):
        allowed = f"{', '.join(KINDS)}, or a .toml file"
        raise ValueError(f"{flag}: found {kind!r}, allowed {allowed}")
    path = Path(kind)
    content = validation.read(path, "file of groups")
    with validation.blamed(f"file of groups {path}"):
        groups, rows = validation.fill(GroupFile, content).group, []
        segments = set().union(*(_names(surface) for surface in hand.surfaces))
        if not groups:
            raise ValueError("group: found none, allowed one or more")
        for group in groups:
            require_known(group.digits, hand.digits)
            require_known(group.segments, segments)
            require_known(group.taxels, taxels.names)
            rows.append(
                [
                    name in group.taxels
                    or (surface.digit in group.digits and surface.segment != "palm")
                    or not _names(surface).isdisjoint(group.segments)
                    for name, surface in zip(taxels.names, surfaces, strict=True)
                ]
            )
        return Groups(tuple(group.name for group in groups), np.array(rows, bool))


def joined(
    sets: Sequence[Taxels], delays: Sequence[float]
) -> tuple[Taxels, Array, list[list[int]]]:
    """Return the taxels of all sets, each place, threshold and delay once, in the order of places.

    Return with it the delay of each, s, and which of them are those of each set.
    """
    sizes = [len(taxels) for taxels in sets]
    points = [point for taxels in sets for point in taxels.points]
    surfaces = np.concatenate([taxels.surfaces for taxels in sets])
    offsets = np.concatenate([taxels.offsets for taxels in sets])
    every = Taxels(tuple(points), surfaces, offsets)
    late = np.repeat(delays, sizes)
    keys = np.column_stack([places.of(every), every.thresholds, late])
    _, firsts, columns = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    parts = np.split(columns.reshape(-1), np.cumsum(sizes)[:-1])
    return (
        every.take(firsts.tolist()),
        late[firsts],
        [part.tolist() for part in parts],
    )


@dataclass(frozen=True)
class Pool:
    """Hold a hand in some scenes, its skin, and which taxels of the skin are whose."""

    flags: DesignFlags
    env: str
    scenes: dict[str, GraspConfig]
    hand: Hand
    sensor: Kind
    """The sensor that may be bought."""
    skin: Taxels
    """All taxels that anything is asked of, with whatever sensor."""
    delays: Array
    """(m,) by how much each is read late, s."""
    existing: list[int]
    """Columns (indices in the skin) of the taxels that the hand has already."""
    free: list[int]
    """Columns of those that may be chosen."""
    references: dict[str, list[int]]
    """Columns of the layouts to compare with, by name."""
    losses: Groups
    prices: Prices | None = None
    """None where the sensor's file says none."""
    early: tuple[str, ...] = ()
    """Names of candidates that were left out."""

    @classmethod
    def of(cls, flags: DesignFlags) -> list[Pool]:
        """Do as the flags say, for each sensor.

        Raise ValueError where scenes do not go together, or one asks for what the hand does not have.
        """
        env, scenes = scenes_of(flags)
        hand = hands.get(env)
        compared = flags.kinds(next(iter(scenes.values())))
        sets = []
        named = [layouts.load(name).place(hand) for name in flags.beside]
        free = candidates(flags, hand)
        existing = layouts.load(flags.keep).place(hand) if flags.keep else free.take([])
        for sensor in compared:
            own = fitted(free, radius=sensor.radius)
            sets += [
                fitted(taxels, threshold_N=sensor.threshold)
                for taxels in (existing, own, *named)
            ]
        n = len(sets) // len(compared)
        late = np.repeat([sensor.delay for sensor in compared], n)
        skin, delays, columns = joined(sets, late.tolist())
        losses = groups_of(flags.survives or "taxel", hand, skin, "survives")
        # Whatever its size, no taxel is chosen where there is one.
        spots = [(p.link, *map(layouts.mm, p.position)) for p in skin.points]
        pools = []
        for sensor, first in zip(compared, range(0, len(sets), n), strict=True):
            there, allowed, *beside = columns[first : first + n]
            taken = {spots[column] for column in there}
            pool = cls(
                flags=flags,
                env=env,
                scenes=scenes,
                hand=hand,
                sensor=sensor,
                skin=skin,
                delays=delays,
                existing=there,
                free=[column for column in allowed if spots[column] not in taken],
                references=dict(zip(flags.beside, beside, strict=True)),
                losses=losses,
            )
            pools.append(replace(pool, prices=pool.priced()))
        return pools

    def __post_init__(self) -> None:
        """Raise ValueError where too few taxels may be chosen, or the budget buys none."""
        self.sizes()
        most = self.flags.numbers[-1]
        if self.flags.budget is None and most > len(self.free):
            allowed = f"up to the {len(self.free)} that may be chosen"
            raise ValueError(f"taxels: found {most}, allowed {allowed}")

    def priced(self) -> Prices | None:
        """Return what taxels cost; ValueError for a budget without, or a taxel that no board serves."""
        boards, cost = self.flags.boards, self.sensor.cost
        if cost is None:
            for flag in ("budget", "boards"):
                if value := getattr(self.flags, flag):
                    raise ValueError(
                        f"{flag}: found {value}, allowed with a --sensor that has a [cost]"
                    )
            return None
        groups = np.zeros(len(self.skin), int)
        if boards:
            _, members = groups_of(boards, self.hand, self.skin, "boards")
            for column in self.free:
                if (n := members[:, column].sum()) != 1:
                    raise ValueError(
                        f"boards: found {self.skin.names[column]} in {n} of the groups of {boards}, "
                        "allowed in one"
                    )
            groups = members.argmax(axis=0)
        return Prices(cost, groups)

    @property
    def columns(self) -> list[int]:
        """Columns of the taxels that the hand has already, then of those that may be chosen."""
        return [*self.existing, *self.free]

    @cached_property
    def overlap(self) -> Array | None:
        """(m, m) bool, of its columns: which two do not fit beside each other?

        None where nobody said how large the sensors are.
        """
        if self.sensor.radius is None:
            return None
        return overlap(self.hand, self.skin.take(self.columns))

    def sizes(self) -> list[tuple[int, int]]:
        """Return how many taxels, and on how many boards, sets may have; 0 boards: any number."""
        flags = self.flags
        if self.prices is None or flags.budget is None:
            return [(n, 0) for n in flags.numbers]
        return self.prices.sizes(self.free, flags.numbers, flags.budget)

    def fits(self, boards: int, taxels: Sequence[int]) -> Array:
        """Tell which others of its columns find room beside some of them, and on 0 (any) boards."""
        is_free = cover.others(len(self.columns), taxels)
        if self.overlap is not None:
            is_free &= ~self.overlap[list(taxels)].any(axis=0)
        if boards and self.prices is not None:
            n = len(self.existing)
            bought = [self.columns[taxel] for taxel in taxels if taxel >= n]
            is_free &= self.prices.fits(bought, boards)[self.columns]
        return is_free

    def without(self, early: Array) -> Pool:
        """Leave out candidates that are `early`, bool (m,) of the skin's taxels."""
        return replace(
            self,
            free=[column for column in self.free if not early[column]],
            early=tuple(
                self.skin.names[column] for column in self.free if early[column]
            ),
        )
