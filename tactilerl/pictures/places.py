"""Taxels as places on a hand, and the skin of a whole hand."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np

from ..envs import validation
from ..envs.hands import Hand, Surface
from ..envs.hands.geometry import placed, posed
from ..envs.layouts import Layout, Patch, Taxels, load, mm

Spacing = Annotated[float, "[0.5, 50]"]
"""Distance of the taxels of a dense skin, mm."""


DIGIT_WORDS = {name: f"{name} finger" for name in ("index", "middle", "ring", "little")}
SEGMENT_WORDS = {
    "proximal": "base segment",
    "middle": "middle segment",
    "distal": "tip",
}


class Place(NamedTuple):
    """A taxel's place on a hand. Lengths in mm, for these are the figures of a layout file."""

    surface: int
    """Index in the hand's surfaces."""
    row: float
    column: float
    radius: float
    height: float
    """Height of a taxel that is given as a point, over the middle of the surface's grid."""


def of(taxels: Taxels) -> list[Place]:
    """Return where the taxels are, in their order."""
    figures = zip(taxels.surfaces.tolist(), taxels.offsets, taxels.radii, strict=True)
    return [
        Place(index, mm(row), mm(column), mm(radius), mm(height))
        for index, (row, column, height), radius in figures
    ]


def described(taxels: Taxels, hand: Hand) -> list[str]:
    """Return where the taxels are in the words of a workshop, from the middle of their segments."""
    model, start = hand.build().compile(), hand.start_positions()
    data = posed(model, dict(zip(hand.joints, start, strict=True)))
    fingers = [s for s in hand.surfaces if s.segment != "palm" and s.digit != "thumb"]
    thumb = [s for s in hand.surfaces if s.segment != "palm" and s.digit == "thumb"]

    def distance(surface: Surface, column: float, other: Surface) -> float:
        """Return how far a column, mm, of a surface is from the middle of another one, m."""
        there = np.add(surface.centre, 1e-3 * column * surface.across)
        middle = placed(data, other.link, other.centre)
        return float(np.linalg.norm(placed(data, surface.link, there) - middle))

    def side(surface: Surface, column: float) -> str:
        if not (thumb and fingers):
            return "to the right" if column > 0 else "to the left"
        aim, name = (
            (fingers[0], "fingers")
            if surface.digit == "thumb"
            else (thumb[-1], "thumb")
        )
        is_near = distance(surface, column, aim) < distance(surface, -column, aim)
        return f"{'towards' if is_near else 'away from'} the {name}"

    words = []
    for place in of(taxels):
        surface, row, column = hand.surfaces[place.surface], place.row, place.column
        digit = DIGIT_WORDS.get(surface.digit, surface.digit)
        parts = [digit, SEGMENT_WORDS.get(surface.segment, surface.segment)]
        ends = "the tip", "the palm"
        if surface.segment == "palm":
            parts = ["palm"] if digit == "palm" else ["palm", f"under the {digit}"]
            ends = "the fingers", "the wrist"
        if row:
            parts.append(f"{abs(row):.3g} mm towards {ends[row < 0]}")
        if column:
            parts.append(f"{abs(column):.3g} mm {side(surface, column)}")
        if not (row or column):
            parts.append("in the middle")
        words.append(", ".join(parts))
    return words


def skin(name: str, hand: Hand) -> Taxels:
    """Return a layout's taxels, or those of a dense skin such as "2mm".

    That is a grid over the palmar side of the whole hand, with every segment and a flat palm around the
    bases of the fingers; its taxels have the radius of the hand's own. Raise ValueError and
    FileNotFoundError where there is none.
    """
    if "\n" in name or not name.endswith("mm"):
        return load(name).place(hand)
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

    `spacing` and `radius` are in m. The tip of a capsule is round and its taxels stand as on a
    cylinder: rows go on over the tip as long as a taxel still reaches the skin under it.
    """
    begin, end, half_width = surface.span
    if surface.segment == "distal" and surface.bone is not None:
        end += np.sqrt((half_width + radius) ** 2 - half_width**2)
    rows = np.arange(np.ceil(begin / spacing), np.floor(end / spacing) + 1) * spacing
    beside = np.floor(half_width / spacing)
    columns = np.clip(np.arange(-beside, beside + 1) * spacing, -half_width, half_width)
    for row, column in product(rows.tolist(), columns.tolist()):
        if not surface.is_gap(row, column):
            yield 1e3 * row, 1e3 * column
