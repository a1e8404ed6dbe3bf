"""Taxels as places on a hand, and the skin of a whole hand."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Annotated, Any, NamedTuple

import numpy as np

from ..envs import validation
from ..envs.hands import Hand, Surface
from ..envs.hands.geometry import placed, posed
from ..envs.layouts import Layout, Patch, Taxels, load, mm

Spacing = Annotated[float, "[0.5, 50]"]
"""Distance of the taxels of a dense skin, mm."""


DIGITS = {name: f"{name} finger" for name in ("index", "middle", "ring", "little")}
SEGMENTS = {
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


def at_start(hand: Hand) -> Any:
    """Return MuJoCo's data of the hand alone, as it is at the start."""
    angles = zip(hand.joints, hand.start_positions(), strict=True)
    return posed(hand.build().compile(), dict(angles))


def described(taxels: Taxels, hand: Hand) -> list[str]:
    """Return where the taxels are in the words of a workshop, from the middle of their segments."""
    data = at_start(hand)
    digits = [surface for surface in hand.surfaces if surface.segment != "palm"]
    aims = {
        "thumb": [surface for surface in digits if surface.digit == "thumb"][-1:],
        "fingers": [surface for surface in digits if surface.digit != "thumb"][:1],
    }

    def side(surface: Surface, column: float) -> str:
        """Tell on which side of a surface a column is."""
        name = "fingers" if surface.digit == "thumb" else "thumb"
        middle = placed(data, surface.link, surface.centre)
        across = placed(data, surface.link, surface.centre + surface.across) - middle
        for aim in aims[name]:
            ahead = (placed(data, aim.link, aim.centre) - middle) @ across
            return f"{'towards' if column * ahead > 0 else 'away from'} the {name}"
        return "to the right" if column > 0 else "to the left"

    words = []
    for place in of(taxels):
        surface, row, column = hand.surfaces[place.surface], place.row, place.column
        digit, ends = DIGITS.get(surface.digit, surface.digit), ("tip", "palm")
        parts = [digit, SEGMENTS.get(surface.segment, surface.segment)]
        if surface.segment == "palm":
            parts, ends = ["palm", f"under the {digit}"], ("fingers", "wrist")
        if row:
            parts.append(f"{abs(row):.3g} mm towards the {ends[row < 0]}")
        if column:
            parts.append(f"{abs(column):.3g} mm {side(surface, column)}")
        words.append(", ".join(parts if row or column else [*parts, "in the middle"]))
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
        if surface.place(row, column):
            yield 1e3 * row, 1e3 * column
