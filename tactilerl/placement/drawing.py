"""A drawing of chosen taxels on the unrolled hand, at scale, to print and to drill by."""

from __future__ import annotations

from html import escape

from ..envs.hands import Hand
from ..envs.layouts import Taxels
from ..pictures import places
from ..pictures.hand_map import LETTERS, Unrolled

LINE = 5.0  # mm, height of a line of the legend
RULER = 50.0  # mm
STYLE = (
    "text{font:3.5px sans-serif}.part{fill:#eee;stroke:#888}.axis{stroke:#888;stroke-dasharray:1 1}"
    ".taxel{fill:#fff;stroke:#000}*{stroke-width:.2}.number{text-anchor:middle;font-size:3px}"
)


def drawing(hand: Hand, taxels: Taxels, title: str) -> str:
    """Return an SVG in which a millimetre is one: parts with their middles, and numbered sensors."""
    drawn = Unrolled(hand)
    left, right, low, top = drawn.extent
    parts = []
    for panel in drawn.panels:
        x0, x1 = panel.x - panel.half_width, panel.x + panel.half_width
        y0, y1 = panel.y + panel.low, panel.y + panel.high
        parts += [
            f'<rect class="part" x="{x0:g}" y="{-y1:g}" width="{x1 - x0:g}" height="{y1 - y0:g}"/>',
            f'<path class="axis" d="M{x0:g} {-panel.y:g}H{x1:g}M{panel.x:g} {-y0:g}V{-y1:g}"/>',
        ]
    for text, x, y in drawn.labels:
        at = f'x="{x:g}" y="{-y:g}" style="font-size:{0.8 * LETTERS:g}px"'
        parts.append(f'<text class="number" {at}>{escape(text)}</text>')
    lines = [title, f"Print at 100 %: this line is {RULER:g} mm long."]
    where = places.described(taxels, hand)
    for number, (place, words) in enumerate(
        zip(places.of(taxels), where, strict=True), 1
    ):
        (x, y), radius = drawn.point(place), place.radius
        parts += [
            f'<circle class="taxel" cx="{x:g}" cy="{-y:g}" r="{radius:g}"/>',
            f'<text class="number" x="{x:g}" y="{1 - y:g}">{number}</text>',
        ]
        lines.append(f"{number}: {words}; diameter {2 * radius:g} mm")
    foot = LINE - low
    parts.append(
        f'<path d="M{left + LINE:g} {foot + 2 * LINE:g}h{RULER:g}m0 -1v2M{left + LINE:g} '
        f'{foot + 2 * LINE - 1:g}v2" stroke="#000"/>'
    )
    for index, line in enumerate(lines):
        y = foot + LINE * (index if index < 2 else index + 1)
        parts.append(f'<text x="{left + LINE:g}" y="{y:g}">{escape(line)}</text>')
    width, height = right - left, top + foot + LINE * (len(lines) + 2)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="{left:g} {-top:g} {width:g} {height:g}"><style>{STYLE}</style>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )
