"""Taxels as places on a hand: from a layout to its places, from places to a layout's file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from .envs.hands import Hand, Surface
from .envs.layouts import Layout, Patch, Taxels

DIGITS_OF_MM = 4  # a place is known to 0.1 µm: more than enough to tell two taxels apart


@dataclass(frozen=True, order=True)
class Place:
    """One taxel. Lengths in mm, for these are the figures of a layout file."""

    surface: int
    """Index in the hand's surfaces."""
    row: float
    column: float
    radius: float


def of(taxels: Taxels, hand: Hand) -> list[Place]:
    """Where the taxels are, in their order: the inverse of `Surface.place`."""
    by_name = {f"{s.digit}.{s.segment}": i for i, s in enumerate(hand.surfaces)}
    places = []
    for name, position, radius in zip(taxels.names, taxels.positions, taxels.radii, strict=True):
        index = by_name[name.partition("[")[0]]
        row, column = offset(hand.surfaces[index], position)
        places.append(Place(index, *(_mm(value) for value in (row, column, float(radius)))))
    return places


def offset(surface: Surface, position: np.ndarray) -> tuple[float, float]:
    """(row, column) in m of a point on a surface."""
    along, palmar = np.array(surface.along), np.array(surface.palmar)
    from_centre = position - np.array(surface.centre)
    return float(from_centre @ along), float(from_centre @ np.cross(palmar, along))


def _mm(metres: float) -> float:
    return round(1e3 * metres, DIGITS_OF_MM) + 0.0  # no -0.0


def dense_skin(hand: Hand, spacing: float) -> Layout:
    """A grid of `spacing` m over the whole palmar half of every phalanx, and the paper's taxels on
    the palm; all of the radius of the hand's own. ValueError for a spacing that is none."""
    if not 0.0005 <= spacing <= 0.05:
        raise ValueError(f"skin: found {1e3 * spacing:g} mm, allowed from 0.5 to 50 mm")
    patches, radius = [], hand.pitch.radius
    for surface in hand.surfaces:
        offsets = ((0.0, 0.0),) if surface.bone is None else _grid(surface, spacing, radius)
        patches.append(Patch((surface.digit,), (surface.segment,), offsets, radius))
    return Layout(f"{1e3 * spacing:g}mm", f"a taxel every {1e3 * spacing:g} mm", tuple(patches))


def _grid(phalanx: Surface, spacing: float, radius: float) -> tuple[tuple[float, float], ...]:
    """As many rows and columns as the bone and its radius carry, through the centre.

    A fingertip is round and its taxels stand as on a cylinder: rows go on over the tip as long as a
    taxel of `radius` m still reaches the skin under it.
    """
    assert phalanx.bone is not None
    assert phalanx.radius is not None
    begin, end = sorted(offset(phalanx, np.array(point))[0] for point in phalanx.bone)
    if phalanx.segment == "distal":
        end += np.sqrt((phalanx.radius + radius) ** 2 - phalanx.radius**2)
    rows = np.arange(np.ceil(begin / spacing), np.floor(end / spacing) + 1) * spacing
    beside = np.floor(phalanx.radius / spacing)
    columns = np.clip(np.arange(-beside, beside + 1) * spacing, -phalanx.radius, phalanx.radius)
    return tuple((float(row), float(column)) for row in rows for column in columns)


def layout(places: list[Place], hand: Hand, name: str, description: str) -> Layout:
    """The layout that has a taxel in each of these places."""
    patches = []
    for (index, radius), group in groupby(sorted(places, key=_patch), key=_patch):
        surface = hand.surfaces[index]
        offsets = tuple((1e-3 * place.row, 1e-3 * place.column) for place in group)
        patches.append(Patch((surface.digit,), (surface.segment,), offsets, 1e-3 * radius))
    return Layout(name, description, tuple(patches))


def toml(places: list[Place], hand: Hand, description: str) -> str:
    """The same as the text of a layout file."""
    lines = [f"description = {json.dumps(description, ensure_ascii=False)}"]
    for (index, radius), group in groupby(sorted(places, key=_patch), key=_patch):
        surface = hand.surfaces[index]
        offsets = ", ".join(f"[{place.row:g}, {place.column:g}]" for place in group)
        lines += ["", "[[patch]]", f'digits = ["{surface.digit}"]']
        lines += [f'segments = ["{surface.segment}"]', f"offsets_mm = [{offsets}]"]
        lines.append(f"radius_mm = {radius:g}")
    return "\n".join(lines) + "\n"


def _patch(place: Place) -> tuple[int, float]:
    return place.surface, place.radius
