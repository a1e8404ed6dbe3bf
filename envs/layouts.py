"""Taxel layouts as data: the paper's six, designs from the literature, and users' files.

A layout says which taxels each phalanx carries, in rows (towards the fingertip) and columns.
The six of the paper are in units of the hand's pitch, so that each hand gets its own
distances; files are in millimetres. `place` puts a layout on a hand.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from . import toml_files
from .hands import DIGITS, SEGMENTS, Array, Hand, Surface

FINGERS = DIGITS[1:]
NAMED = Path(__file__).with_name("layout_files")


@dataclass(frozen=True)
class Taxels:
    """Taxels on one hand. `links` holds each body once; `link_index` maps taxels to it."""

    links: tuple[str, ...]
    link_index: Array
    """(n,) int."""
    positions: Array
    """(n, 3), link frame, m."""
    radii: Array
    """(n,), m."""
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Patch:
    """Taxels on some surfaces: (row, column) offsets, in pitches when `radius` is None, else m."""

    digits: tuple[str, ...]
    segments: tuple[str, ...]
    offsets: tuple[tuple[float, float], ...]
    radius: float | None = None
    large: bool = False
    """Use the hand's large radius (layout 6)."""


@dataclass(frozen=True)
class Layout:
    """A named set of patches."""

    name: str
    description: str
    patches: tuple[Patch, ...]

    def place(self, hand: Hand) -> Taxels:
        """The taxels of this layout on `hand`; ValueError when the hand cannot carry them."""
        links: list[str] = []
        index, positions, radii, names = [], [], [], []
        for surface in hand.surfaces:
            for patch in self.patches:
                if surface.digit not in patch.digits or surface.segment not in patch.segments:
                    continue
                row_pitch, column_pitch, radius = _scale(patch, surface, hand)
                if surface.link not in links:
                    links.append(surface.link)
                for row, column in patch.offsets:
                    index.append(links.index(surface.link))
                    positions.append(surface.place(row * row_pitch, column * column_pitch))
                    radii.append(radius)
                    names.append(f"{surface.digit}.{surface.segment}[{_label(patch, row, column)}]")
        if not names:
            raise ValueError(f"layout {self.name!r} puts no taxel on the {hand.name} hand")
        return Taxels(tuple(links), np.array(index), np.array(positions), np.array(radii), tuple(names))


def left_out(layout: Layout, hand: Hand) -> list[str]:
    """Where a layout wants taxels and the hand has no surface: names such as thumb.palm."""
    there = {(surface.digit, surface.segment) for surface in hand.surfaces}
    wanted = (place for p in layout.patches for place in product(p.digits, p.segments))
    return [
        f"{digit}.{segment}"
        for digit, segment in dict.fromkeys(wanted)
        if (digit, segment) not in there
    ]


def _scale(patch: Patch, surface: Surface, hand: Hand) -> tuple[float, float, float]:
    """(row pitch, column pitch, radius) in m of a patch on one surface."""
    if patch.radius is not None:
        return 1.0, 1.0, patch.radius
    pitch = hand.pitch
    radius = pitch.large_radius if patch.large else pitch.radius
    return pitch.rows.get(surface.segment, 0.0), pitch.column, radius


def _label(patch: Patch, row: float, column: float) -> str:
    """Where on its phalanx a taxel is, in pitches, or in mm."""
    if patch.radius is None:
        return f"{row:+g},{column:+g}"
    return f"{1e3 * row:+g},{1e3 * column:+g} mm"


CENTRE = ((0.0, 0.0),)
CORNERS = ((1.0, -1.0), (1.0, 1.0), (-1.0, -1.0), (-1.0, 1.0))
EDGES = ((1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, 0.0))
# Paper, Fig. 2 and Results: per phalanx, and four on the palm at the bases of the fingers.
PAPER = {
    "1": ("3 x 3 grid", CENTRE + CORNERS + EDGES),
    "2": ("corners and centre", CENTRE + CORNERS),
    "3": ("corners", CORNERS),
    "4": ("centre and edge midpoints", CENTRE + EDGES),
    "5": ("small centre", CENTRE),
    "6": ("large centre", CENTRE),
}


def paper_layout(name: str) -> Layout:
    """One of the paper's configurations 1-6 (139, 79, 64, 79, 19, 19 taxels)."""
    description, offsets = PAPER[name]
    phalanges = Patch(DIGITS, SEGMENTS, tuple(sorted(offsets)), large=name == "6")
    return Layout(name, description, (phalanges, Patch(FINGERS, ("palm",), CENTRE)))


def names() -> tuple[str, ...]:
    """Layouts that can be asked for by name."""
    return (*PAPER, *sorted(path.stem for path in NAMED.glob("*.toml")))


def load(name: str) -> Layout:
    """A layout by number, by name, or from a .toml file.

    Raises ValueError naming what is wrong with the file, and FileNotFoundError.
    """
    if name in PAPER:
        return paper_layout(name)
    if name.endswith(".toml"):
        return _read(Path(name))
    path = NAMED / f"{name}.toml"
    if Path(name).name != name or not os.path.isfile(path):
        meant = f"did you mean {name}.toml? " if os.path.isfile(f"{name}.toml") else ""
        raise ValueError(
            f"unknown layout {name!r}; {meant}allowed: {', '.join(names())} or the path of a .toml file"
        )
    return _read(path)


def _read(path: Path) -> Layout:
    data = toml_files.read(path, "layout file")
    try:
        return parse(data, path.stem)
    except ValueError as error:
        raise ValueError(f"layout file {path}: {error}") from None


def parse(data: dict[str, Any], name: str) -> Layout:
    """A layout from the content of a file (docs/guides/layouts.md)."""
    _only(data, {"description", "patch"}, "the file")
    patches = data.get("patch")
    if not isinstance(patches, list) or not patches:
        raise ValueError("needs at least one [[patch]] table")
    parsed = tuple(_patch(patch, f"patch {i + 1}") for i, patch in enumerate(patches))
    _require_distinct(parsed)
    return Layout(name, str(data.get("description", "")), parsed)


def _require_distinct(patches: tuple[Patch, ...]) -> None:
    """ValueError when two patches put a taxel in the same place."""
    seen: dict[tuple[str, str, tuple[float, float]], int] = {}
    for number, patch in enumerate(patches, 1):
        for place in product(set(patch.digits), set(patch.segments), patch.offsets):
            if place in seen:
                digit, segment, (row, column) = place
                raise ValueError(
                    f"patch {number}: {digit}.{segment} has a taxel at "
                    f"[{1e3 * row:g}, {1e3 * column:g}] mm already, from patch {seen[place]}"
                )
            seen[place] = number


def _patch(data: Any, where: str) -> Patch:
    if not isinstance(data, dict):
        raise ValueError(f"{where}: found {data!r}, expected a table")
    _only(data, {"digits", "segments", "offsets_mm", "radius_mm"}, where)
    digits = _choices(data.get("digits"), DIGITS, f"{where}: digits")
    segments = _choices(data.get("segments"), (*SEGMENTS, "palm"), f"{where}: segments")
    radius = data.get("radius_mm")
    if radius is None or not _is_number(radius) or not 0.1 <= radius <= 20:
        raise ValueError(f"{where}: radius_mm: found {radius!r}, allowed a number from 0.1 to 20")
    offsets = data.get("offsets_mm")
    if not isinstance(offsets, list) or not offsets:
        raise ValueError(f"{where}: offsets_mm: found {offsets!r}, expected [[row, column], ...]")
    for offset in offsets:
        if not isinstance(offset, list) or len(offset) != 2 or not all(map(_is_number, offset)):
            raise ValueError(f"{where}: offsets_mm: found {offset!r}, expected [row, column] in mm")
        if max(abs(value) for value in offset) > 50:
            raise ValueError(f"{where}: offsets_mm: found {offset!r}, allowed up to 50 mm")
    if len({tuple(offset) for offset in offsets}) < len(offsets):
        raise ValueError(f"{where}: offsets_mm: the same [row, column] is given twice")
    metres = tuple((1e-3 * row, 1e-3 * column) for row, column in offsets)
    return Patch(digits, segments, metres, 1e-3 * radius)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9


def _only(data: dict[str, Any], allowed: set[str], where: str) -> None:
    unknown = sorted(set(data) - allowed)
    if unknown:
        raise ValueError(f"{where}: unknown key {unknown[0]!r}; allowed: {', '.join(sorted(allowed))}")


def _choices(value: Any, allowed: tuple[str, ...], where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise ValueError(f"{where}: found {value!r}, expected a list of: {', '.join(allowed)}")
    for item in value:
        if item not in allowed:
            raise ValueError(f"{where}: found {item!r}, allowed: {', '.join(allowed)}")
    return tuple(value)
