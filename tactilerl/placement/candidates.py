"""What a design is asked: for which scenes, and which taxels may be chosen."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..envs import hands, layouts, scenes, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import Hand, Point, Surface
from ..envs.hands.geometry import placed, posed
from ..envs.layouts import Taxels
from ..envs.observations import TaxelFaults
from ..envs.state import Array
from ..envs.validation import Newtons, require_known
from ..machine import WorkerCount
from ..pictures import places
from .recording import Skin

TOUCHING = 1e-6  # m by which two sensors may overlap, so that those that just fit do
AROUND = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
"""Directions in which the margin of a taxel is looked at, rad."""
KINDS_OF_LOSS = ("taxel", "digit", "segment")


@dataclass(frozen=True)
class DesignFlags:
    """Which taxels may be chosen, by what, and from which starts."""

    scene: tuple[str, ...] = ("handover_anywhere",)
    """One or more named scenes, or scenes' .toml files, in which an object is handed over; all count
    alike."""
    env: str = ""
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file; default: the first scene's."""
    simulator: str = ""
    """Physics engine: mujoco or pybullet; default: the scene's."""
    taxels: str = "4"
    """How many taxels the hand may have: a number, or a range such as 1..12."""
    skin: str = "4mm"
    """What to choose from: the spacing of a grid over all surfaces, a layout, or a layout file."""
    radius: Annotated[float, "[0.1, 20]"] | None = None
    """Radius of the taxels, mm, of which no two then overlap along the skin; default: the hand's own,
    or that of the layout."""
    margin: Annotated[float, "[0, 50]"] = 0.0
    """Least distance of a taxel from each edge of its segment, mm, so that a housing fits."""
    only: tuple[str, ...] = ()
    """Only on these segments, digits, or segments of digits, such as palm distal index.middle."""
    leave_out: tuple[str, ...] = ()
    """Not on these, named likewise."""
    keep: str = ""
    """A layout whose taxels the hand has already; they count."""
    taxel_threshold: tuple[Newtons, ...] = ()
    """Force from which a taxel fires, N; of several, each has rows of its own, and what is said is at
    which touch stops paying; default: the scene's, or any touch."""
    survives: str = ""
    """Maximise success after the worst loss of any one taxel, digit or segment, or of any one group of
    a file: taxel, digit, segment, or a .toml file with a [[group]] for each."""
    start_closing: tuple[Annotated[float, "[0, 1)"], ...] = ()
    """How far the hand is closed while it waits; of several, each set of taxels has what works best
    for it; default: the scene's."""
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

    @property
    def numbers(self) -> range:
        """How many taxels, from and to; ValueError where that is no range."""
        match = re.fullmatch(r"(\d{1,4})(?:\.\.(\d{1,4}))?", self.taxels)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= low <= high:
            allowed = "a number from 1 up, or LOW..HIGH"
            raise ValueError(f"taxels: found {self.taxels!r}, allowed {allowed}")
        return range(low, high + 1)

    @property
    def n_played(self) -> int:
        """How many starts are played."""
        n_recordings = len(self.scene) * max(1, len(self.start_closing))
        return n_recordings * (self.starts + self.test_starts)

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        validation.require(type(self), vars(self))
        if not self.scene:
            raise ValueError("scene: found none, allowed one or more handovers")
        _ = self.numbers


@dataclass(frozen=True)
class Scene:
    """One of the scenes to design for."""

    name: str
    config: GraspConfig

    def waiting(self, closing: float | None) -> GraspConfig:
        """Return the scene with a hand that is so far closed while it waits; None for as it is."""
        if closing is None:
            return self.config
        return replace(self.config, start_closing=closing)


def candidates(flags: DesignFlags, hand: Hand) -> Taxels:
    """Return what may be chosen; ValueError where nothing may."""
    segments = {surface.segment for surface in hand.surfaces}
    names = [
        {*_names(surface), *({surface.digit} - segments)} for surface in hand.surfaces
    ]
    require_known((*flags.only, *flags.leave_out), set().union(*names))
    taxels = places.skin(flags.skin, hand)
    changes: dict[str, Any] = {}
    if flags.radius is not None:
        changes["radius"] = 1e-3 * flags.radius
    if len(flags.taxel_threshold) == 1:
        changes["threshold_N"] = flags.taxel_threshold[0]
    points = (point._replace(**changes) for point in taxels.points)
    taxels = replace(taxels, points=tuple(points))
    is_allowed = [
        (not flags.only or not answers.isdisjoint(flags.only))
        and answers.isdisjoint(flags.leave_out)
        for answers in names
    ]
    margin = 1e-3 * flags.margin
    spots = zip(taxels.surfaces.tolist(), taxels.offsets, strict=True)
    allowed = [
        i
        for i, (index, (row, column, _)) in enumerate(spots)
        if is_allowed[index]
        and (not margin or has_margin(hand.surfaces[index], row, column, margin))
    ]
    if not allowed:
        flags_given = f"--only {' '.join(flags.only)} --not {' '.join(flags.leave_out)}"
        if margin:
            flags_given += f" --margin {flags.margin:g}"
        raise ValueError(
            f"skin: found {flags.skin} with {flags_given}: no taxel is left"
        )
    return taxels.take(allowed)


def _names(surface: Surface) -> set[str]:
    """Return the names of a surface: a segment, and a digit's segment."""
    return {surface.segment, f"{surface.digit}.{surface.segment}"}


def has_margin(surface: Surface, row: float, column: float, margin: float) -> bool:
    """Tell whether a place is at least `margin` m from every edge of its surface, as one sees it from
    the palmar side."""
    low, high, half_width = surface.span
    if surface.segment == "distal" and surface.bone is not None:
        high += half_width  # a fingertip is round
    if not low + margin <= row <= high - margin or abs(column) > half_width - margin:
        return False
    around = zip(
        row + margin * np.sin(AROUND), column + margin * np.cos(AROUND), strict=True
    )
    return not any(surface.is_gap(*place) for place in around)


def overlap(hand: Hand, taxels: Taxels) -> Array:
    """Return which two sensors do not fit beside each other on the open hand, bool (n, n).

    The skin between two taxels turns like an arc: of the line between them, the part in the direction
    in which their normals differ is a chord. That is exact on planes, cylinders and spheres.
    """
    data = posed(
        hand.build().compile(),
        dict(zip(hand.joints, hand.start_positions(), strict=True)),
    )
    points = np.array([placed(data, p.link, p.position) for p in taxels.points])
    normals = np.array(
        [placed(data, p.link, p.normal) - data.body(p.link).xpos for p in taxels.points]
    )
    near = cKDTree(points).query_pairs(2 * taxels.radii.max(), output_type="ndarray")
    first, second = near.T
    apart, turned = points[first] - points[second], normals[first] - normals[second]
    half_turns = np.linalg.norm(turned, axis=1) / 2
    with np.errstate(invalid="ignore"):
        chords = np.nan_to_num((apart * turned).sum(axis=1) / (2 * half_turns))
        longer = np.nan_to_num(
            np.arcsin(np.minimum(half_turns, 1.0)) / half_turns, nan=1.0
        )
    squared = (apart**2).sum(axis=1) + chords**2 * (longer**2 - 1)
    is_too_near = (
        np.sqrt(squared) < taxels.radii[first] + taxels.radii[second] - TOUCHING
    )
    overlapping = np.zeros((len(taxels), len(taxels)), bool)
    overlapping[first, second] = overlapping[second, first] = is_too_near
    return overlapping


class Losses(NamedTuple):
    """What may fail, one at a time."""

    names: tuple[str, ...]
    members: Array
    """(g, m) bool: which taxels of the skin fail with each."""


@dataclass(frozen=True)
class GroupTable:
    """One [[group]] of a file: what fails together, by the names of taxels, digits or segments."""

    name: str
    taxels: tuple[str, ...] = ()
    digits: tuple[str, ...] = ()
    segments: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroupFile:
    """All that a file of groups may say."""

    group: tuple[GroupTable, ...]


def losses_of(survives: str, hand: Hand, taxels: Taxels) -> Losses:
    """Return what may fail: any one taxel, digit, segment (the palm is one), or group of a file.
    ValueError naming what is wrong with it, and FileNotFoundError."""
    on_surfaces = [hand.surfaces[index] for index in taxels.surfaces.tolist()]
    if survives == "taxel":
        return Losses(taxels.names, np.eye(len(taxels), dtype=bool))
    if survives in KINDS_OF_LOSS:
        parts = [
            "palm" if at.segment == "palm"
            else at.digit if survives == "digit"
            else f"{at.digit}.{at.segment}"
            for at in on_surfaces
        ]  # fmt: skip
        names = tuple(dict.fromkeys(parts))
        return Losses(names, np.array(parts) == np.array(names)[:, None])
    if not survives.endswith(".toml"):
        allowed = f"{', '.join(KINDS_OF_LOSS)}, or a .toml file"
        raise ValueError(f"survives: found {survives!r}, allowed {allowed}")
    path = Path(survives)
    content = validation.read(path, "file of groups")
    with validation.blamed(f"file of groups {path}"):
        groups = validation.fill(GroupFile, content).group
        segments = set().union(*(_names(surface) for surface in hand.surfaces))
        rows = []
        for group in groups:
            require_known(group.digits, hand.digits)
            require_known(group.segments, segments)
            require_known(group.taxels, taxels.names)
            rows.append(
                [
                    name in group.taxels
                    or (at.digit in group.digits and at.segment != "palm")
                    or not _names(at).isdisjoint(group.segments)
                    for name, at in zip(taxels.names, on_surfaces, strict=True)
                ]
            )
        return Losses(tuple(group.name for group in groups), np.array(rows, bool))


@dataclass(frozen=True)
class Pool:
    """What is asked: a hand in some scenes, all taxels that anything is asked of, and which of them are
    whose."""

    flags: DesignFlags
    env: str
    scenes: list[Scene]
    hand: Hand
    skin: Skin
    columns: list[int]
    """Which of the skin's taxels the hand has already, then those that may be chosen."""
    n_existing: int
    references: dict[str, list[int]]
    """Columns of the layouts to compare with, by name."""
    losses: Losses
    """What may fail, of the skin's taxels."""
    early: tuple[str, ...] = ()
    """Names of candidates that were left out."""

    @classmethod
    def of(cls, flags: DesignFlags) -> Pool:
        """Do as the flags say; ValueError where scenes do not go together, or one asks for what the
        hand does not have."""
        env, chosen_scenes = _scenes(flags)
        hand = hands.get(env)
        free = candidates(flags, hand)
        references = {name: layouts.load(name).place(hand) for name in flags.beside}
        existing = [layouts.load(flags.keep).place(hand)] if flags.keep else []
        skin = Skin.of([*existing, free, *references.values()])
        existing_columns = [c for taxels in existing for c in skin.columns(taxels)]
        taken = {_spot(skin.taxels.points[column]) for column in existing_columns}
        free_columns = [
            column
            for column in skin.columns(free)
            if _spot(skin.taxels.points[column]) not in taken
        ]
        pool = cls(
            flags=flags,
            env=env,
            scenes=chosen_scenes,
            hand=hand,
            skin=skin,
            columns=[*existing_columns, *free_columns],
            n_existing=len(existing_columns),
            references={
                name: skin.columns(taxels) for name, taxels in references.items()
            },
            losses=losses_of(flags.survives or "taxel", hand, skin.taxels),
        )
        return pool.without(np.zeros(len(skin.taxels), bool))

    @property
    def taxels(self) -> Taxels:
        """The taxels of its columns."""
        return self.skin.taxels.take(self.columns)

    @cached_property
    def overlap(self) -> Array | None:
        """(m, m) bool, of its columns: which two do not fit beside each other? None where nobody said
        how large the sensors are."""
        if self.flags.radius is None:
            return None
        return overlap(self.hand, self.taxels)

    def without(self, early: Array) -> Pool:
        """Leave out candidates that are `early`, bool (m,) of the skin's taxels; ValueError where too
        few are left."""
        n = self.n_existing
        existing, free = self.columns[:n], self.columns[n:]
        left = [column for column in free if not early[column]]
        if (most := self.flags.numbers[-1]) > len(left):
            allowed = f"up to the {len(left)} that may be chosen"
            raise ValueError(f"taxels: found {most}, allowed {allowed}")
        names = (self.skin.taxels.names[column] for column in free if early[column])
        return replace(self, columns=[*existing, *left], early=tuple(names))


def _spot(point: Point) -> tuple[str, float, float, float]:
    """Return where a taxel is, whatever its size: its link, and its place to the nearest 0.1 µm."""
    x, y, z = (layouts.mm(value) for value in point.position)
    return point.link, x, y, z


def _scenes(flags: DesignFlags) -> tuple[str, list[Scene]]:
    """Return the hand and its scenes; ValueError where they do not go together."""
    loaded = [scenes.load(name) for name in flags.scene]
    hand = flags.env or loaded[0].env
    if not hands.is_hand(hand):
        raise ValueError(f"env: found {hand!r}, allowed: {hands.allowed()}")
    simulator = {"simulator": flags.simulator} if flags.simulator else {}
    chosen = []
    for name, scene in zip(flags.scene, loaded, strict=True):
        if not flags.env and scene.env != hand:
            allowed = "scenes of one hand, or --env"
            raise ValueError(f"scene: found {name} of {scene.env}, allowed {allowed}")
        config = setup(hand, **{**scene.on(hand), **simulator})
        validation.validate(config)
        if tasks.TASKS[config.task].giver is None:
            raise ValueError(
                f"scene: found {name}, whose object lies on the ground, allowed handovers; "
                f"what touch can win there says tactilerl gate --scene {name}"
            )
        if flags.start_closing and config.actions == "all":
            allowed = "only with scenes whose actions are fingers or grip"
            found = list(flags.start_closing)
            raise ValueError(f"start_closing: found {found}, allowed {allowed}")
        _require_whole(name, config)
        chosen.append(Scene(name, config))
    return hand, chosen


def _require_whole(name: str, config: GraspConfig) -> None:
    """Raise ValueError for a scene whose taxels may fail in ways that no recording knows."""
    if config.touch != "on":
        raise ValueError(f"scene: found {name} with touch {config.touch}, allowed on")
    for fault in validation.names(TaxelFaults):
        if share := getattr(config, fault):
            raise ValueError(
                f"scene: found {name} with {fault} {share:g}, allowed 0: which taxel it strikes no "
                "recording knows; --survives designs for the worst loss"
            )
