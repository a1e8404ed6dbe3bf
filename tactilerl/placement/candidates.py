"""What a design is asked: for which scenes, and which taxels may be chosen."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from scipy.spatial.distance import cdist

from ..envs import hands, layouts, scenes, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import Hand
from ..envs.layouts import Taxels
from ..envs.state import Array
from ..envs.validation import require_known
from ..machine import WorkerCount
from ..pictures import places
from .recording import Skin

BESIDE_EACH_OTHER = 0.9
"""Distance of two sensors that just fit beside each other, in sums of their radii; a chord is shorter
than the skin under it."""


@dataclass(frozen=True)
class DesignFlags:
    """Which taxels may be chosen, by what, and from which starts."""

    scene: tuple[str, ...] = ("handover_anywhere",)
    """One or more named scenes, or scenes' .toml files, in which an object is handed over."""
    env: str = ""
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file; default: the first scene's."""
    simulator: str = ""
    """Physics engine: mujoco or pybullet; default: the scene's."""
    taxels: str = "4"
    """How many taxels the hand may have: a number, or a range such as 1..12."""
    skin: str = "4mm"
    """What to choose from: the spacing of a grid over all surfaces, a layout, or a layout file."""
    radius: Annotated[float, "[0.1, 20]"] | None = None
    """Radius of the taxels, mm, of which no two then overlap; default: the hand's own, or that of the
    layout."""
    only: tuple[str, ...] = ()
    """Only on these segments, digits, or segments of digits, such as palm distal index.middle."""
    leave_out: tuple[str, ...] = ()
    """Not on these, named likewise."""
    keep: str = ""
    """A layout whose taxels the hand has already; they count."""
    weights: tuple[Annotated[float, "(0, inf)"], ...] = ()
    """How much each scene counts; default: all alike."""
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
    weight: float
    """Its share of all scenes; they sum to 1."""

    def waiting(self, closing: float | None) -> GraspConfig:
        """Return the scene with a hand that is so far closed while it waits; None for as it is."""
        if closing is None:
            return self.config
        return replace(self.config, start_closing=closing)


def candidates(flags: DesignFlags, hand: Hand) -> Taxels:
    """Return what may be chosen; ValueError where nothing may."""
    segments = {surface.segment for surface in hand.surfaces}
    names_of = [
        {at.segment, f"{at.digit}.{at.segment}", *({at.digit} - segments)}
        for at in hand.surfaces
    ]
    require_known((*flags.only, *flags.leave_out), set().union(*names_of))
    taxels = places.skin(flags.skin, hand)
    if flags.radius is not None:
        radius = 1e-3 * flags.radius
        points = (point._replace(radius=radius) for point in taxels.points)
        taxels = replace(taxels, points=tuple(points))
    is_allowed = [
        (not flags.only or not names.isdisjoint(flags.only))
        and names.isdisjoint(flags.leave_out)
        for names in names_of
    ]
    left = [i for i, surface in enumerate(taxels.surfaces) if is_allowed[surface]]
    if not left:
        asked = f"--only {' '.join(flags.only)} --not {' '.join(flags.leave_out)}"
        raise ValueError(f"skin: found {flags.skin} with {asked}: no taxel is left")
    return taxels.take(left)


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
    n_kept: int
    beside: dict[str, list[int]]
    """Columns of the layouts to compare with, by name."""
    early: tuple[str, ...] = ()
    """Names of candidates that were left out."""

    @classmethod
    def of(cls, flags: DesignFlags) -> Pool:
        """Do as the flags say; ValueError where scenes do not go together, or one asks for what the
        hand does not have."""
        env, chosen_scenes = _scenes(flags)
        hand = hands.get(env)
        free = candidates(flags, hand)
        beside = {name: layouts.load(name).place(hand) for name in flags.beside}
        kept = [layouts.load(flags.keep).place(hand)] if flags.keep else []
        skin = Skin.of([free, *beside.values(), *kept])
        kept_columns = [column for taxels in kept for column in skin.columns(taxels)]
        pool = cls(
            flags=flags,
            env=env,
            scenes=chosen_scenes,
            hand=hand,
            skin=skin,
            columns=list(dict.fromkeys([*kept_columns, *skin.columns(free)])),
            n_kept=len(kept_columns),
            beside={name: skin.columns(taxels) for name, taxels in beside.items()},
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
        taxels = self.taxels
        apart = cdist(taxels.positions, taxels.positions)
        needed = BESIDE_EACH_OTHER * (taxels.radii[:, None] + taxels.radii)
        is_same_link = taxels.link_index[:, None] == taxels.link_index
        is_other = ~np.eye(len(taxels), dtype=bool)
        return np.asarray(is_same_link & (apart < needed) & is_other)

    def without(self, early: Array) -> Pool:
        """Leave out candidates that are `early`, bool (m,) of the skin's taxels; ValueError where too
        few are left."""
        kept, free = self.columns[: self.n_kept], self.columns[self.n_kept :]
        left = [column for column in free if not early[column]]
        if (most := self.flags.numbers[-1]) > len(left):
            allowed = f"up to the {len(left)} that may be chosen"
            raise ValueError(f"taxels: found {most}, allowed {allowed}")
        names = (self.skin.taxels.names[column] for column in free if early[column])
        return replace(self, columns=[*kept, *left], early=tuple(names))


def _scenes(flags: DesignFlags) -> tuple[str, list[Scene]]:
    """Return the hand and its scenes; ValueError where they do not go together."""
    weights = flags.weights or (1.0,) * len(flags.scene)
    if len(weights) != len(flags.scene):
        allowed = f"{len(flags.scene)}, one for each of the scenes"
        raise ValueError(f"weights: found {len(weights)}, allowed {allowed}")
    loaded = [scenes.load(name) for name in flags.scene]
    hand = flags.env or loaded[0].env
    if not hands.is_hand(hand):
        raise ValueError(f"env: found {hand!r}, allowed: {hands.allowed()}")
    simulator = {"simulator": flags.simulator} if flags.simulator else {}
    chosen = []
    for name, scene, weight in zip(flags.scene, loaded, weights, strict=True):
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
        chosen.append(Scene(name, config, weight / sum(weights)))
    return hand, chosen
