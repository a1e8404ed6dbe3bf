"""Taxels as places on a hand, and the skin of a whole hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..envs.hands import Hand, Surface
from ..envs.layouts import Layout, Patch, Taxels, load, mm


@dataclass(frozen=True, order=True)
class Place:
    """One taxel. Lengths in mm, for these are the figures of a layout file."""

    surface: int
    """Index in the hand's surfaces."""
    row: float
    column: float
    radius: float
    height: float = 0.0
    """Height of a taxel that is given as a point, over the middle of the surface's grid."""


def of(taxels: Taxels) -> list[Place]:
    """Return where the taxels are, in their order."""
    figures = zip(taxels.surfaces.tolist(), taxels.offsets, taxels.radii, strict=True)
    return [
        Place(index, mm(row), mm(column), mm(radius), mm(height))
        for index, (row, column, height), radius in figures
    ]


def skin(name: str, hand: Hand) -> Taxels:
    """Return a layout's taxels, or those of a dense skin such as "2mm".

    Raise ValueError and FileNotFoundError where there is none.
    """
    if "\n" in name or not name.endswith("mm"):
        return load(name).place(hand)
    try:
        spacing = float(name[:-2])
    except ValueError:
        raise ValueError(
            f"skin: found {name!r}, allowed a layout, or a spacing such as 2mm"
        ) from None
    return dense_skin(hand, 1e-3 * spacing).place(hand)


def dense_skin(hand: Hand, spacing: float) -> Layout:
    """Return a grid of taxels every `spacing` m over the palmar side of the whole hand.

    It covers every segment and a flat palm around the bases of the fingers; taxels have the radius
    of the hand's own. Raise ValueError for a spacing beyond 0.5 to 50 mm.
    """
    if not 0.0005 <= spacing <= 0.05:
        raise ValueError(f"skin: found {1e3 * spacing:g} mm, allowed from 0.5 to 50 mm")
    patches, radius = [], hand.pitch.radius
    for surface in hand.surfaces:
        offsets = _grid(surface, spacing, radius)
        patches.append(Patch((surface.digit,), (surface.segment,), offsets, radius))
    return Layout(
        f"{1e3 * spacing:g}mm", f"a taxel every {1e3 * spacing:g} mm", tuple(patches)
    )


def _grid(
    surface: Surface, spacing: float, radius: float
) -> tuple[tuple[float, float], ...]:
    """Return as many rows and columns as the surface carries, through its middle.

    The tip of a capsule is round and its taxels stand as on a cylinder: rows go on over the tip as
    long as a taxel of `radius` m still reaches the skin under it.
    """
    begin, end, half_width = surface.span
    if surface.segment == "distal" and surface.bone is not None:
        end += np.sqrt((half_width + radius) ** 2 - half_width**2)
    rows = np.arange(np.ceil(begin / spacing), np.floor(end / spacing) + 1) * spacing
    beside = np.floor(half_width / spacing)
    columns = np.clip(np.arange(-beside, beside + 1) * spacing, -half_width, half_width)
    every = ((float(row), float(column)) for row in rows for column in columns)
    return tuple(place for place in every if not surface.is_gap(*place))
