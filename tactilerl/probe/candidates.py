"""What a design is asked: for which scenes, which taxels may be chosen; and what it answers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from scipy.spatial.distance import cdist

from ..envs import hands, layouts, scenes, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import Hand
from ..envs.layouts import Layout, Taxels
from ..envs.state import Array
from ..envs.validation import require_known
from ..machine import WorkerCount
from ..pictures import places
from .cover import Aim
from .recording import Skin

MOST = 250_000  # starts
USUAL = {True: 200, False: 2_000}  # handovers, or grasps
BESIDE = tuple("123456")
BESIDE_EACH_OTHER = (
    0.9  # share of the sum of radii; a chord is shorter than the skin under it
)
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
    redundancy: Annotated[int, "[1, 10]"] = 1
    """How many taxels must feel a start in time; all but one of them may be dead."""
    taxel_dead: Annotated[float, "[0, 1)"] = 0.0
    """Probability that a taxel is dead."""
    taxel_false_on: Annotated[float, "[0, 1)"] = 0.0
    """Probability that a taxel fires in a step without being touched."""
    start_closing: tuple[Annotated[float, "[0, 1)"], ...] = ()
    """How far the hand is closed while it waits; of several, each set of taxels has what works best for
    it; default: the scene's."""
    beside: tuple[str, ...] = BESIDE
    """Layouts to compare with."""
    starts: Annotated[int, f"[1, {MOST}]"] | None = None
    """Starts of each scene to choose from; default: 200 handovers or 2,000 grasps."""
    test_starts: Annotated[int, f"[2, {MOST}]"] = 200
    """Other starts of each handover, on which everything is judged; of grasps, each is predicted from
    taxels that were chosen without it."""
    seed: Annotated[int, "[0, 999]"] = 0
    """Random seed of the starts."""
    workers: WorkerCount = None
    """Starts played side by side; default: one per free core. Results do not depend on it."""

    @property
    def numbers(self) -> range:
        """How many taxels, from and to."""
        found = re.fullmatch(r"(\d{1,4})(?:\.\.(\d{1,4}))?", self.taxels)
        low, high = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
        if not 1 <= low <= high:
            raise ValueError(
                f"taxels: found {self.taxels!r}, allowed a number from 1 up, or LOW..HIGH"
            )
        return range(low, high + 1)

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        validation.require(type(self), vars(self))
        if len(set(self.start_closing)) < len(self.start_closing):
            raise ValueError(
                f"start_closing: found {list(self.start_closing)}, allowed each once"
            )
        _ = self.numbers  # ValueError where it is no range
        if self.redundancy > 1 and (self.taxel_dead or self.taxel_false_on):
            raise ValueError(
                "redundancy: found with taxel_dead or taxel_false_on, allowed one of both"
            )

    @property
    def aim(self) -> Aim:
        return Aim(self.redundancy, self.taxel_dead, self.taxel_false_on)


@dataclass(frozen=True)
class Scene:
    """One of the scenes to design for."""

    name: str
    config: GraspConfig
    weight: float
    """Of all scenes; they sum to 1."""

    def waiting(self, closing: float | None) -> GraspConfig:
        """With a hand that is so far closed while it waits; None for as the scene has it."""
        return (
            self.config
            if closing is None
            else replace(self.config, start_closing=closing)
        )


def candidates(flags: DesignFlags, hand: Hand) -> Taxels:
    """What may be chosen; ValueError where nothing may."""
    segments = {surface.segment for surface in hand.surfaces}
    own = [
        {
            surface.segment,
            f"{surface.digit}.{surface.segment}",
            *({surface.digit} - segments),
        }
        for surface in hand.surfaces
    ]
    require_known((*flags.only, *flags.leave_out), set().union(*own))
    taxels = places.skin(flags.skin, hand)
    if flags.radius is not None:
        resized = (
            point._replace(radius=1e-3 * flags.radius) for point in taxels.points
        )
        taxels = replace(taxels, points=tuple(resized))
    is_allowed = [
        (not flags.only or not names.isdisjoint(flags.only))
        and names.isdisjoint(flags.leave_out)
        for names in own
    ]
    left = [
        taxel for taxel, surface in enumerate(taxels.surfaces) if is_allowed[surface]
    ]
    if not left:
        name, but = ("only", "--not ") if flags.only else ("not", "")
        chosen = " ".join(
            [*flags.only, *(f"{but}{left_out}" for left_out in flags.leave_out)]
        )
        raise ValueError(
            f"{name}: found {chosen!r}, which leaves no taxel of the skin {flags.skin}"
        )
    _require_enough(flags, left)
    return taxels.take(left)


def _require_enough(flags: DesignFlags, left: Sequence[int]) -> None:
    if (most := flags.numbers[-1]) > len(left):
        raise ValueError(
            f"taxels: found {most}, allowed up to the {len(left)} that may be chosen"
        )


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
        about = (
            f"{n} taxel{'s' * (n > 1)} {MADE} for {', '.join(self.result['scenes'])}"
        )
        if (closing := self.waits_at(n)) is not None:
            about += f", waiting {closing:g} closed"
        return layouts.of_taxels(taxels, self.hand, about)

    def waits_at(self, n: int) -> float | None:
        """How far the hand with `n` taxels is closed while it waits; None for as the scene has it."""
        rows = (
            row
            for row in self.result["rows"]
            if row["layout"] == "chosen" and row["taxels"] == n
        )
        return next(
            (row["start_closing"] for row in rows if "start_closing" in row), None
        )


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
    """Of the skin's taxels: those that the hand has already, then those that may be chosen."""
    n_kept: int
    beside: dict[str, Taxels]
    """Layouts to compare with."""
    early: tuple[str, ...] = ()
    """Names of candidates that were left out."""

    @classmethod
    def of(cls, flags: DesignFlags) -> Pool:
        """As the flags say; ValueError where scenes do not go together, or one asks for what the hand
        does not have."""
        env, found = _scenes(flags)
        hand = hands.get(env)
        free = candidates(flags, hand)
        beside = {name: layouts.load(name).place(hand) for name in flags.beside}
        kept = [layouts.load(flags.keep).place(hand)] if flags.keep else []
        skin = Skin.of([free, *beside.values(), *kept])
        own = [column for taxels in kept for column in skin.columns(taxels)]
        columns = list(dict.fromkeys([*own, *skin.columns(free)]))
        return cls(flags, env, found, hand, skin, columns, len(own), beside)

    @property
    def is_timing(self) -> bool:
        """Is the question when to close? Where an object is handed over; elsewhere it is whether a
        grasp will hold."""
        return tasks.TASKS[self.scenes[0].config.task].giver is not None

    @cached_property
    def overlap(self) -> Array | None:
        """(m, m) bool, of its columns: which two do not fit beside each other? None where nobody said
        how large the sensors are."""
        if self.flags.radius is None:
            return None
        taxels = self.skin.taxels.take(self.columns)
        apart = cdist(taxels.positions, taxels.positions)
        needed = BESIDE_EACH_OTHER * (taxels.radii[:, None] + taxels.radii)
        is_same_link = taxels.link_index[:, None] == taxels.link_index
        return np.asarray(
            is_same_link & (apart < needed) & ~np.eye(len(taxels), dtype=bool)
        )

    @property
    def n_starts(self) -> int:
        """How many to choose from."""
        return self.flags.starts or USUAL[self.is_timing]

    def without(self, early: Array) -> Pool:
        """Without candidates that are `early`, bool (m,) of the skin's taxels; ValueError where too few
        are left."""
        kept, free = self.columns[: self.n_kept], self.columns[self.n_kept :]
        left = [column for column in free if not early[column]]
        _require_enough(self.flags, left)
        names = tuple(
            self.skin.taxels.names[column] for column in free if early[column]
        )
        return replace(self, columns=[*kept, *left], early=names)

    def design(
        self, chosen: dict[int, list[int]], worth: Array, about: dict[str, Any]
    ) -> Design:
        """What was `chosen`, by number of taxels, as indices of the columns, with what is said `about`
        it."""
        own, names = (
            self.skin.taxels.take(self.columns),
            validation.names(DesignFlags) - {"workers"},
        )
        asked = {
            name: value for name, value in asdict(self.flags).items() if name in names
        }
        result = {
            "env": self.env,
            "simulator": self.scenes[0].config.simulator,
            "scenes": [scene.name for scene in self.scenes],
            "asking": asked | {"starts": self.n_starts},
            "candidates": len(self.columns) - self.n_kept,
            "early": list(self.early),
            **about,
            "places": {
                n: [asdict(place) for place in places.of(own.take(chosen[n]))]
                for n in chosen
            },
        }
        return Design(self.hand, own, chosen, list(range(self.n_kept)), worth, result)


def _scenes(flags: DesignFlags) -> tuple[str, list[Scene]]:
    """The hand, and its scenes; ValueError where they do not go together."""
    if not flags.scene or len(set(flags.scene)) < len(flags.scene):
        raise ValueError(
            f"scene: found {list(flags.scene)}, allowed one or more, each once"
        )
    weights = flags.weights or (1.0,) * len(flags.scene)
    if len(weights) != len(flags.scene):
        raise ValueError(
            f"weights: found {len(weights)}, allowed one for each of the scenes"
        )
    every = [scenes.load(name) for name in flags.scene]
    hand = flags.env or every[0].env
    if not hands.is_hand(hand):
        raise ValueError(f"env: found {hand!r}, allowed: {hands.allowed()}")
    choices, found = {"simulator": flags.simulator} if flags.simulator else {}, []
    for name, named, weight in zip(flags.scene, every, weights, strict=True):
        if not flags.env and named.env != hand:
            raise ValueError(
                f"scene: found {name} of {named.env}, allowed scenes of one hand, or --env"
            )
        config = setup(hand, **{**named.on(hand), **choices})
        validation.validate(config)
        if flags.start_closing and config.actions == "all":
            allowed = "allowed only with scenes whose actions are fingers or grip"
            raise ValueError(
                f"start_closing: found {list(flags.start_closing)}, {allowed}"
            )
        found.append(Scene(name, config, weight / sum(weights)))
    if len({tasks.TASKS[scene.config.task].giver is None for scene in found}) > 1:
        raise ValueError("scene: found handovers beside other tasks, allowed one kind")
    return hand, found
