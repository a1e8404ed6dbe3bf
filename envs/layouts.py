"""Taxel layouts as data: the paper's six, designs from the literature, and users' files.

A layout says which taxels each segment carries, in rows (towards the fingertip) and
columns, or gives them as points on links. The six of the paper are in units of the
hand's pitch, so that each hand gets its own distances; patches of files are in
millimetres. `place` puts a layout on a hand.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, product
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from . import taxel_files, validation
from .hands import DIGITS, SEGMENTS, Hand, Pitch, Point, Surface
from .state import Array
from .taxel_files import require_distinct
from .validation import Newtons, require_one_of

MODEL = "model"
"""The layout of the sensors that a hand's own model has."""
LOOKED_FOR = (
    "looked for sites with MuJoCo's <touch>, and what is fixed to a link and called sensor, taxel, "
    "tactile, touch or fsr"
)
Millimetres = Annotated[float, "[-50, 50]"]
Count = Annotated[int, "[1, 100]"]
MIN_DISTANCE = 1e-7  # m: nearer places are the same
LAYOUT_FOLDER = Path(__file__).with_name("layout_files")


@dataclass(frozen=True)
class Taxels:
    """Taxels on one hand, and where each is on it."""

    points: tuple[Point, ...]
    surfaces: Array
    """(n,) int, of the hand's surfaces."""
    offsets: Array
    """(n, 3), m: row and column on that surface, and 0; of points the height over its
    middle, not 0."""

    def __len__(self) -> int:
        """Return how many taxels these are."""
        return len(self.points)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the taxels, unique within a layout."""
        return tuple(point.name for point in self.points)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """The bodies that carry them, each once."""
        return tuple(dict.fromkeys(point.link for point in self.points))

    @cached_property
    def link_index(self) -> Array:
        """(n,) int, of `links`."""
        return np.array([self.links.index(point.link) for point in self.points], int)

    @cached_property
    def positions(self) -> Array:
        """(n, 3), link frame, m."""
        return np.array([point.position for point in self.points])

    @cached_property
    def normals(self) -> Array:
        """(n, 3) outward, link frame."""
        return np.array([point.normal for point in self.points])

    @cached_property
    def radii(self) -> Array:
        """(n,), m."""
        return np.array([point.radius for point in self.points])

    @cached_property
    def thresholds(self) -> Array:
        """(n,) forces from which they fire, N; 0: any touch."""
        return np.array([point.threshold_N or 0.0 for point in self.points])

    def resized(self, radius: float) -> Taxels:
        """Return these taxels, all with a radius in m."""
        points = tuple(point._replace(radius=radius) for point in self.points)
        return replace(self, points=points)

    def take(self, chosen: Sequence[int]) -> Taxels:
        """Return the taxels with these indices."""
        points, indices = tuple(self.points[i] for i in chosen), list(chosen)
        return Taxels(points, self.surfaces[indices], self.offsets[indices])


@dataclass(frozen=True)
class Patch:
    """Taxels on some surfaces: (row, column) offsets, in pitches when `radius_mm` is None, else mm."""

    digits: tuple[str, ...] | None
    """None: all; on the palm all but the thumb."""
    segments: tuple[str, ...] | None
    """None: all but the palm."""
    offsets: tuple[tuple[float, float], ...]
    radius_mm: float | None = None
    threshold_N: float | None = None
    """Force from which they fire, N; None: any touch."""
    large: bool = False
    """Use the hand's large radius (layout 6)."""

    def is_on(self, digit: str, segment: str) -> bool:
        """Return whether it puts taxels there."""
        digits = self.digits or [digit]
        if segment == "palm":
            if self.digits and "palm" in digits:  # whatever digit that is the palm of
                return True
            if self.segments is None or (self.digits is None and digit == "thumb"):
                return False
        return digit in digits and segment in (self.segments or [segment])

    def spots(
        self, surface: Surface, pitch: Pitch
    ) -> Iterator[tuple[tuple[float, float], Point]]:
        """Yield (row, column) in m of each of its taxels on a surface, and the taxel without a place.

        Names have them in pitches or in mm.
        """
        for row, column in self.offsets:
            place = f"{row:+g},{column:+g}"
            if self.radius_mm is None:
                offset = (
                    row * pitch.rows.get(surface.segment, 0.0),
                    column * pitch.columns.get(surface.link, 0.0),
                )
                radius = pitch.large_radius if self.large else pitch.radius
            else:
                offset, radius = (1e-3 * row, 1e-3 * column), 1e-3 * self.radius_mm
                place += " mm"
            name = f"{surface.digit}.{surface.segment}[{place}]"
            yield offset, Point(surface.link, (), (), radius, name, self.threshold_N)


@dataclass(frozen=True)
class PatchTable:
    """One [[patch]] of a layout file."""

    radius_mm: Annotated[float, "[0.1, 20]"]
    offsets_mm: tuple[tuple[Millimetres, Millimetres], ...] | None = None
    digits: tuple[str, ...] | None = None
    segments: tuple[str, ...] | None = None
    threshold_N: Newtons | None = None
    rows: Count = 1
    columns: Count = 1
    pitch_mm: Annotated[float, "[0.1, 50]"] | None = None
    """Distance between the middles of neighbours in an array of rows and columns."""

    def patch(self) -> Patch:
        """Return the patch that it says; ValueError unless it has either offsets or an array."""
        is_array = bool(self.pitch_mm) or (self.rows, self.columns) != (1, 1)
        if bool(self.offsets_mm) == is_array or is_array != bool(self.pitch_mm):
            raise ValueError(
                "patch: needs either offsets_mm or rows, columns, pitch_mm"
            )
        if () in (self.digits, self.segments):
            raise ValueError(
                "patch: found an empty list of digits or segments; left out, it means all"
            )
        pitch = self.pitch_mm or 0.0
        places = self.offsets_mm or product(
            (pitch * (row - (self.rows - 1) / 2) for row in range(self.rows)),
            (pitch * (col - (self.columns - 1) / 2) for col in range(self.columns)),
        )
        where = self.digits, self.segments, tuple(places)
        return Patch(*where, self.radius_mm, self.threshold_N)


@dataclass(frozen=True)
class LayoutFile:
    """All that a layout file may say."""

    description: str = ""
    partial: bool = False
    """True: a hand may lack places that it names."""
    patch: tuple[PatchTable, ...] = ()
    taxel: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class Layout:
    """A named set of patches and points."""

    name: str
    description: str
    patches: tuple[Patch, ...]
    taxels: tuple[Point, ...] = ()
    partial: bool = False

    @property
    def is_model(self) -> bool:
        """True if it stands for the sensors of the hand's model; every file has taxels of its own."""
        return not (self.patches or self.taxels)

    def place(self, hand: Hand) -> Taxels:
        """Return the taxels of this layout on `hand`; ValueError when the hand cannot carry them."""
        self._require_digits(hand)
        placed = []
        for index, offset, point in self.on_grids(hand):
            surface = hand.surfaces[index]
            if place := surface.place(*offset):
                position, normal = (tuple(vector.tolist()) for vector in place)
                point = point._replace(position=position, normal=normal)
                placed.append((point, index, (*offset, 0.0)))
        taxels = hand.sensors.points if self.is_model else self.taxels
        placed += [_on_surface(point, hand) for point in taxels]
        if not self.is_model:
            with validation.blamed(f"layout {self.name!r}"):
                require_distinct([point for point, *_ in placed])
        if not placed:
            why = f": {str(hand.sensors) or LOOKED_FOR}" if self.is_model else ""
            raise ValueError(
                f"layout {self.name!r} puts no taxel on the {hand.name} hand{why}"
            )
        every, surfaces, offsets = zip(*placed, strict=True)
        return Taxels(every, np.array(surfaces), np.array(offsets))

    def __str__(self) -> str:
        """Return what stands for it in a configuration, where a name or a path usually does."""
        return self.name if self.is_model or self in PAPER.values() else self.toml()

    def toml(self) -> str:
        """Return the text of a layout file, exact to the last digit."""
        lines = [f"description = {validation.quoted(self.description)}"]
        lines += ["partial = true"] if self.partial else []
        for patch in self.patches:
            lines += ["", "[[patch]]"]
            lines += [
                f"{key.replace('offsets', 'offsets_mm')} = {validation.quoted(value)}"
                for key, value in vars(patch).items()
                if value is not None and value is not False
            ]
        for point in self.taxels:
            lines += ["", *point.toml()]
        return "\n".join(lines) + "\n"

    def on_grids(self, hand: Hand) -> Iterator[tuple[int, tuple[float, float], Point]]:
        """Yield every taxel of a patch, whether or not there is something of the link.

        The parts are index of the surface, (row, column) on it in m, and the taxel
        without a place.
        """
        for index, surface in enumerate(hand.surfaces):
            for patch in self.patches:
                if patch.is_on(surface.digit, surface.segment):
                    for offset, point in patch.spots(surface, hand.pitch):
                        yield index, offset, point

    def _require_digits(self, hand: Hand) -> None:
        """Raise ValueError for a digit or a segment that no hand has, or only others."""
        digits = dict.fromkeys((*DIGITS, *hand.digits, "palm"))
        names = (surface.segment for surface in hand.surfaces)
        segments = dict.fromkeys((*SEGMENTS, *names, "palm"))
        where = f"layout {self.name!r}"
        for patch in self.patches:
            for digit in patch.digits or ():
                require_one_of(digits, digit, where)
            for segment in patch.segments or ():
                require_one_of(segments, segment, where)


def _on_surface(
    point: Point, hand: Hand
) -> tuple[Point, int, tuple[float, float, float]]:
    """Return the point with a normal, which of the hand's surfaces it is on, and where.

    Points of a body that is part of a link are on that link.
    """
    frame = hand.welded.get(point.link)
    if frame is not None:
        normal = point.normal and frame.direction(point.normal)
        place = frame.point(point.position)
        point = point._replace(link=frame.link, position=place, normal=normal)
    position, surfaces = np.array(point.position), hand.surfaces
    on_link = [i for i, surface in enumerate(surfaces) if surface.link == point.link]
    links = dict.fromkeys(surface.link for surface in surfaces)
    require_one_of(links, point.link, f"taxel {point.name!r}: link")
    index = min(on_link, key=lambda i: np.linalg.norm(position - surfaces[i].centre))
    if not point.normal:
        outward = surfaces[index].skin(position)[1]
        point = point._replace(normal=tuple(outward.tolist()))
    row, column, height = surfaces[index].offset(position)
    if abs(height) <= MIN_DISTANCE:
        height = MIN_DISTANCE  # 0 is of grids
    return point, index, (row, column, height)


def left_out(layout: Layout, hand: Hand) -> list[str]:
    """Return what a layout names and a hand lacks.

    That is a digit, or a segment of one (thumb.palm), and a taxel where a link of any
    shape has a gap (thumb.distal[+1,-1]). Raise ValueError for digits and segments
    unless the layout is partial.
    """
    there = {(surface.digit, surface.segment) for surface in hand.surfaces}
    there |= {(digit, "") for digit in hand.digits}
    wanted = [
        place
        for patch in layout.patches
        for place in product(patch.digits or (), patch.segments or ("",))
        for _ in patch.offsets
    ]
    lacking = [place for place in wanted if place not in there and place[0] != "palm"]
    names = dict.fromkeys(".".join(filter(None, place)) for place in lacking)
    if lacking and not layout.partial:
        n = len(wanted)
        raise ValueError(
            f"layout {layout.name!r}: {n - len(lacking)} of {n} placed: {', '.join(names)} are not on "
            "this hand; partial = true in the layout's file leaves them out"
        )
    grids = layout.on_grids(hand)
    gaps = [p.name for i, spot, p in grids if not hand.surfaces[i].place(*spot)]
    return [*names, *gaps]


def off_skin(taxels: Taxels, hand: Hand) -> list[str]:
    """Return names of the taxels that nothing carries.

    Those of grids lie beyond an edge of their segment; the spheres of points do not
    reach the skin of their link.
    """
    names, places = [], zip(taxels.surfaces.tolist(), taxels.offsets, strict=True)
    for point, (index, (row, column, height)) in zip(
        taxels.points, places, strict=True
    ):
        surface = hand.surfaces[index]
        low, high, half_width = surface.span
        distance = max(low - row, row - high)
        if surface.bone is not None:
            distance -= half_width  # its ends are round
        elif not surface.geoms:
            distance = max(distance, abs(column) - half_width)
        if height:
            distance = abs(surface.skin(np.array(point.position))[0])
        if distance > point.radius:
            names.append(point.name)
    return names


CENTRE = ((0.0, 0.0),)
CORNERS = ((1.0, -1.0), (1.0, 1.0), (-1.0, -1.0), (-1.0, 1.0))
EDGES = ((1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, 0.0))
# Paper, Fig. 2 and Results: per phalanx, and four on the palm at the bases of the
# fingers.
PALM = Patch(None, ("palm",), CENTRE)
PAPER = {
    name: Layout(
        name,
        about,
        (Patch(None, None, tuple(sorted(offsets)), large=name == "6"), PALM),
    )
    for name, about, offsets in (
        ("1", "3 x 3 grid", CENTRE + CORNERS + EDGES),
        ("2", "corners and centre", CENTRE + CORNERS),
        ("3", "corners", CORNERS),
        ("4", "centre and edge midpoints", CENTRE + EDGES),
        ("5", "small centre", CENTRE),
        ("6", "large centre", CENTRE),
    )
}
"""The paper's configurations 1-6 (139, 79, 64, 79, 19, 19 taxels)."""


def names() -> tuple[str, ...]:
    """Layouts that can be asked for by name."""
    return (*PAPER, *sorted(path.stem for path in LAYOUT_FOLDER.glob("*.toml")))


def short(name: str) -> str:
    """Return what a layout is called where there is little room."""
    return "own" if "\n" in name else Path(name).stem


def is_file(name: str) -> bool:
    """Return True if the name of a layout is the path of a file."""
    return "\n" not in name and Path(name).suffix in (".toml", ".csv")


def load(name: str) -> Layout:
    """Return a layout by number or name, or from a file or the text of a TOML file.

    Files are TOML, or points as CSV (`taxel_files`). Raises ValueError naming what is
    wrong with the file, and FileNotFoundError.
    """
    if name in PAPER:
        return PAPER[name]
    if name == MODEL:
        return Layout(MODEL, "the touch sensors that the hand's model has", ())
    if "\n" in name:
        with validation.blamed("layout"):
            return parse(tomllib.loads(name), "own")
    path = Path(name)
    if path.suffix == ".csv":
        return Layout(path.stem, f"points of {name}", (), taxel_files.read(path))
    if not name.endswith(".toml"):
        path = LAYOUT_FOLDER / f"{name}.toml"
        if name not in names():
            allowed = ", ".join((*names(), MODEL, "FILE.toml", "FILE.csv"))
            raise ValueError(f"unknown layout {name!r}; allowed: {allowed}")
    data = validation.read(path, "layout file")
    with validation.blamed(f"layout file {path}"):
        return parse(data, path.stem)


def parse(data: dict[str, Any], name: str) -> Layout:
    """Return a layout from the content of a file (docs/guides/layouts.md)."""
    file = validation.fill(LayoutFile, data)
    if not (file.patch or file.taxel):
        raise ValueError("needs at least one [[patch]] or [[taxel]] table")
    points = tuple(taxel_files.point(table, i) for i, table in enumerate(file.taxel, 1))
    patches = tuple(table.patch() for table in file.patch)
    return Layout(name, file.description, patches, points, file.partial)


def of_taxels(taxels: Taxels, hand: Hand, description: str) -> Layout:
    """Return the layout with these taxels: in patches those that lie on grids, the others as points."""
    on_grids, points, patches = [], [], []
    for point, index, offset in zip(
        taxels.points, taxels.surfaces.tolist(), taxels.offsets, strict=True
    ):
        row, column, height = map(mm, offset)
        if height:
            points.append(point)
        else:
            kind = index, mm(point.radius), point.threshold_N or 0.0
            on_grids.append((*kind, row, column))
    for kind, group in groupby(sorted(on_grids), key=lambda taxel: taxel[:3]):
        index, radius, threshold = kind
        surface = hand.surfaces[index]
        offsets = tuple((row, column) for *_, row, column in group)
        names = (surface.digit,), (surface.segment,)
        patches.append(Patch(*names, offsets, radius, threshold or None))
    return Layout("", description, tuple(patches), tuple(points))


def mm(metres: float) -> float:
    """Return a length in mm, to 0.1 µm: more than enough to tell two taxels apart."""
    return round(1e3 * float(metres), 4) + 0.0  # no -0.0
