"""Say where taxels are on a hand: as places, in words, and drawn on the hand unrolled.

Unrolled, it is a column a digit, seen from the palmar side, fingertips up: a right hand's
thumb is on the right.
"""

from __future__ import annotations

from collections.abc import Iterable
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from ..envs.hands import DIGITS, Hand, Surface
from ..envs.hands.geometry import placed, posed
from ..envs.layouts import Taxels, mm
from ..envs.state import Array

Box = tuple[float, float, float, float]
# All mm.
MARGIN = 6.0  # around all of it
EDGE = 3.0  # of a panel beyond the places of its outermost taxels
PANEL_GAP = 2 * EDGE + 2.0  # between the outermost places of two panels
LETTERS = 7.0  # the height of a label
LETTER_WIDTH = 0.55 * LETTERS  # of a letter on the mean
ROUND = 0.4  # radius of a panel's corners, of half its width
PAPER, PHALANX, TAXEL = (255, 255, 255), (224, 224, 224), (70, 90, 160)
LIT, LETTER = (255, 200, 0), (20, 20, 20)
FINGERS = {name: f"{name} finger" for name in ("index", "middle", "ring", "little")}
SEGMENTS = {
    "proximal": "base segment",
    "middle": "middle segment",
    "distal": "tip",
}


# -- places and words -----------------------------------------------------------------------


class Place(NamedTuple):
    """A taxel's place on a hand. Lengths in mm, for these are the figures of a layout file."""

    surface: int
    """Index in the hand's surfaces."""
    row: float
    column: float
    radius: float
    height: float
    """Height of a taxel that is given as a point, over the middle of the surface's
    grid."""


def places(taxels: Taxels) -> list[Place]:
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
        for aim in aims[name]:
            is_ahead = column * _beside(data, surface, aim) > 0
            return f"{'towards' if is_ahead else 'away from'} the {name}"
        return "to the left" if column > 0 else "to the right"  # as on the map

    words = []
    for place in places(taxels):
        surface, row, column = hand.surfaces[place.surface], place.row, place.column
        digit, ends = FINGERS.get(surface.digit, surface.digit), ("tip", "palm")
        parts = [digit, SEGMENTS.get(surface.segment, surface.segment)]
        if surface.segment == "palm":
            parts, ends = ["palm", f"under the {digit}"], ("fingers", "wrist")
        if row:
            parts.append(f"{abs(row):.3g} mm towards the {ends[row < 0]}")
        if column:
            parts.append(f"{abs(column):.3g} mm {side(surface, column)}")
        words.append(", ".join(parts if row or column else [*parts, "in the middle"]))
    return words


def _beside(data: Any, surface: Surface, other: Surface) -> float:
    """Return how far another surface lies in the direction of a surface's columns, m."""
    middle = placed(data, surface.link, surface.centre)
    across = placed(data, surface.link, surface.centre + surface.across) - middle
    return float((placed(data, other.link, other.centre) - middle) @ across)


# -- the map ---------------------------------------------------------------------------------


class Panel(NamedTuple):
    """Place a surface on the map; all lengths are in mm."""

    x: float
    y: float
    """Place of the centre of its taxels' grid; up is towards the fingertip."""
    half_width: float
    low: float
    high: float
    """Its ends, from there."""

    @property
    def box(self) -> Box:
        """Its left, lower, right and upper edge on the map."""
        x, y, half_width, low, high = self
        return (
            x - half_width - EDGE,
            y + low - EDGE,
            x + half_width + EDGE,
            y + high + EDGE,
        )


def panels(hand: Hand) -> list[Panel]:
    """Return a panel for each of the hand's surfaces.

    Digits stand side by side, their segments from the base up to the tip, and the palm
    below them.
    """
    spans = [np.multiply(1e3, surface.span).tolist() for surface in hand.surfaces]
    columns = _from_the_left(hand)
    middles: dict[str, float] = {}
    right = 0.0
    for digit in columns:
        half = LETTER_WIDTH * len(digit) / 2 - EDGE
        for surface, (*_, half_width) in zip(hand.surfaces, spans, strict=True):
            if surface.digit == digit:
                half = max(half, half_width)
        middles[digit] = right + half
        right += 2 * half + PANEL_GAP
    tops = dict.fromkeys(columns, 0.0)
    drawn = []
    for surface, (low, high, half_width) in zip(hand.surfaces, spans, strict=True):
        x = middles.get(surface.digit, (right - PANEL_GAP) / 2)
        if surface.segment == "palm":
            drawn.append(Panel(x, -PANEL_GAP - high, half_width, low, high))
            continue
        if surface.segment == "distal" and surface.bone is not None:
            high += half_width  # a fingertip is round
        y = tops[surface.digit] - low
        tops[surface.digit] = y + high + PANEL_GAP
        drawn.append(Panel(x, y, half_width, low, high))
    return drawn


def _from_the_left(hand: Hand) -> list[str]:
    """Return the digits in the order in which one sees them from the palmar side."""
    digits = sorted(hand.digits, key=lambda digit: (*DIGITS, digit).index(digit))
    bases = {surface.digit: surface for surface in reversed(hand.surfaces)}
    # Columns are counted to the left: `across` is palmar x along.
    leftward = _beside(at_start(hand), bases[digits[-1]], bases[digits[0]])
    return digits if leftward > 0.0 else digits[::-1]


class Unrolled:
    """Say where everything lies on the map of a hand, mm; up is towards the fingertips."""

    def __init__(self, hand: Hand) -> None:
        """Lay out the hand's surfaces and words.

        Each digit's name stands above its tip, and "palm" below the palm: `labels` has
        the words, and the middle (x, y) of the baseline of each.
        """
        self.panels, self.labels = panels(hand), list[tuple[str, float, float]]()
        palm = []
        for surface, panel in zip(hand.surfaces, self.panels, strict=True):
            if surface.segment == "palm":
                palm.append(panel)
            elif surface.segment == "distal":
                baseline = panel.y + panel.high + EDGE + LETTERS / 3
                self.labels.append((surface.digit, panel.x, baseline))
        below = min(panel.y + panel.low for panel in palm) - EDGE - LETTERS
        self.labels.append(("palm", sum(p.x for p in palm) / len(palm), below))
        lefts, lows, rights, tops = zip(*(p.box for p in self.panels), strict=True)
        margin = MARGIN - EDGE
        left, right = min(lefts) - margin, max(rights) + margin
        low, top = min(lows) - margin - LETTERS, max(tops) + margin + LETTERS
        self.extent = left, right, low, top

    def point(self, place: Place) -> tuple[float, float]:
        """Return where a taxel lies on the map, mm."""
        panel = self.panels[place.surface]
        return panel.x - place.column, panel.y + place.row  # columns go to the left


class TaxelMap:
    """Draw the unrolled hand with the taxels that fire lit."""

    def __init__(self, hand: Hand, taxels: Taxels, height: int) -> None:
        """Draw the hand and its taxels, `height` pixels high, for pictures to come."""
        from PIL import Image, ImageDraw

        drawn = Unrolled(hand)
        self._left, right, low, self._top = drawn.extent
        self._scale = height / (self._top - low)
        width = 2 * round(
            self._scale * (right - self._left) / 2
        )  # even: films want that
        self._blank = Image.new("RGB", (width, height), PAPER)
        draw = ImageDraw.Draw(self._blank)
        for panel in drawn.panels:
            radius = self._scale * (ROUND * panel.half_width + EDGE)
            draw.rounded_rectangle(self._pixels(*panel.box), radius, PHALANX)
        size = self._scale * LETTERS
        for text, x, y in drawn.labels:
            at = self._pixels(x, y, x, y)[:2]
            draw.text(at, text, LETTER, font_size=size, anchor="ms")
        self._discs = []
        for place in places(taxels):
            (x, y), r = drawn.point(place), place.radius
            self._discs.append(self._pixels(x - r, y - r, x + r, y + r))

    def _pixels(self, x0: float, y0: float, x1: float, y1: float) -> Any:
        """Return the left, upper, right and lower edge (4,) in pixels of a box on the map, mm."""
        left, top = self._left, self._top
        edges = np.array([x0 - left, top - y1, x1 - left, top - y0])
        return (self._scale * edges).tolist()

    def picture(self, lit: Iterable[bool]) -> Array:
        """Return an RGB picture (height, width, 3) uint8; taxels `lit`, bool (n,), lie on top."""
        from PIL import ImageDraw

        image = self._blank.copy()
        draw = ImageDraw.Draw(image)
        discs = zip(lit, self._discs, strict=True)
        for is_lit, disc in sorted(discs, key=itemgetter(0)):
            draw.ellipse(disc, LIT if is_lit else TAXEL)
        return np.array(image)
