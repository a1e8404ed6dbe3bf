"""The palmar side of a hand unrolled: a column a digit, fingertips up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from . import places
from .envs.hands import DIGITS, SEGMENTS, Array, Hand
from .envs.layouts import Taxels
from .places import Place

COLUMN, ROW = 38.0, 52.0  # mm between digits and between segments on the map
MARGIN = 6.0  # mm around all of it
ROUND = 0.4  # radius of a panel's corners, of half its width
PAPER, PHALANX, TAXEL, LIT = (255, 255, 255), (224, 224, 224), (70, 90, 160), (255, 200, 0)


class Panel(NamedTuple):
    """Where a surface lies on the map, mm."""

    x: float
    y: float
    """Of the centre of its taxels' grid; up is towards the fingertip."""
    half_width: float
    low: float
    high: float
    """Its ends, from there."""


def panels(hand: Hand) -> list[Panel]:
    """One for each of the hand's surfaces."""
    found = []
    for surface in hand.surfaces:
        x = COLUMN * DIGITS.index(surface.digit)
        if surface.bone is None:
            found.append(Panel(x, -45.0, 9.0, -9.0, 9.0))
            continue
        assert surface.radius is not None
        ends = sorted(1e3 * places.offset(surface, np.array(point))[0] for point in surface.bone)
        if surface.segment == "distal":  # a fingertip is round
            ends[1] += 1e3 * surface.radius
        y = ROW * SEGMENTS.index(surface.segment)
        found.append(Panel(x, y, 1e3 * surface.radius, *ends))
    return found


def point(place: Place, drawn: list[Panel]) -> tuple[float, float]:
    """Where a taxel lies on the map, mm."""
    panel = drawn[place.surface]
    return panel.x + place.column, panel.y + place.row


def beyond(hand: Hand, taxels: Taxels) -> list[str]:
    """Names of the taxels that lie beyond an end of their segment, where nothing carries them."""
    drawn, found = panels(hand), []
    for name, place in zip(taxels.names, places.of(taxels, hand), strict=True):
        panel, is_tip = drawn[place.surface], hand.surfaces[place.surface].segment == "distal"
        low, high = panel.low - panel.half_width, panel.high + (0.0 if is_tip else panel.half_width)
        if not low - place.radius <= place.row <= high + place.radius:
            found.append(name)
    return found


class TaxelMap:
    """Pictures of the unrolled hand, `height` pixels high, with the taxels that fire lit."""

    def __init__(self, hand: Hand, taxels: Taxels, height: int) -> None:
        drawn = panels(hand)
        left = min(panel.x - panel.half_width for panel in drawn) - MARGIN
        right = max(panel.x + panel.half_width for panel in drawn) + MARGIN
        bottom = min(panel.y + panel.low for panel in drawn) - MARGIN
        top = max(panel.y + panel.high for panel in drawn) + MARGIN
        n_columns = 2 * round(height * (right - left) / (top - bottom) / 2)  # even: films want that
        x = np.linspace(left, right, n_columns)
        y = np.linspace(top, bottom, height)[:, None]
        self._blank = np.full((height, n_columns, 3), PAPER, np.uint8)
        for panel in drawn:
            self._blank[_inside(x, y, panel)] = PHALANX
        self._discs = []
        for place in places.of(taxels, hand):
            across, up = point(place, drawn)
            self._discs.append(np.nonzero(np.hypot(x - across, y - up) <= place.radius))

    def picture(self, lit: Array) -> Array:
        """RGB (height, width, 3) uint8; `lit` bool (n,)."""
        image = self._blank.copy()
        for disc, on in zip(self._discs, lit, strict=True):
            image[disc] = LIT if on else TAXEL
        return image


def _inside(x: Array, y: Array, panel: Panel) -> Array:
    """Which points lie in a panel, whose corners are round."""
    corner = ROUND * panel.half_width
    middle, half_height = panel.y + (panel.low + panel.high) / 2, (panel.high - panel.low) / 2
    beyond_x = np.maximum(np.abs(x - panel.x) - (panel.half_width - corner), 0.0)
    beyond_y = np.maximum(np.abs(y - middle) - (half_height - corner), 0.0)
    is_inside: Array = np.hypot(beyond_x, beyond_y) <= corner
    return is_inside
