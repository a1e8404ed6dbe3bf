"""Pictures of a design, as PNG and SVG: the unrolled hand with its taxels, and what any number of them
is worth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from ..envs import layouts
from ..envs.hands import Hand
from ..files import MAKER, IsOurs, replacing
from ..pictures import places
from ..pictures.hand_map import EDGE, ROUND, labels, panels, point
from ..pictures.places import Place
from ..style import DPI, HEAD, INK, NAMES, OTHERS, STYLE
from .choice import Design, Row

CHOSEN = OTHERS[0]
TICKS = (1, 2, 5, 10, 20, 50, 100)  # of a number of taxels
NEAR = 0.03  # success, of dots whose names would overlap
KINDS: dict[str, dict[str, Any]] = {
    "png": {"Software": MAKER},
    "svg": {"Date": None, "Creator": MAKER},
}


@rc_context(STYLE)
def of_design(design: Design) -> dict[str, Figure]:
    """Draw where arrivals are felt, with the largest set that was chosen, and the curve."""
    pool, n = design.pool, max(design.chosen)
    env, simulator = pool.env, pool.scenes[0].config.simulator
    where = f"{NAMES.get(env, Path(env).stem)} in {NAMES.get(simulator, simulator)}"
    title = f"{where}: {', '.join(scene.name for scene in pool.scenes)}"
    hand = hand_map(
        pool.hand,
        places.of(pool.taxels),
        design.worth,
        "share of starts won by this taxel alone",
        f"{title}\nthe {n} chosen, and what each candidate alone is worth",
        design.chosen[n],
        **{"s": 10, "cmap": "Blues", "edgecolors": "0.8", "linewidths": 0.3},
    )
    return {"hand": hand, "curve": _curve(design.rows, title)}


@rc_context(STYLE)
def save(
    figures: dict[str, Figure], out: Path, is_ours: IsOurs | None = None
) -> list[Path]:
    """Write figures to a folder, replacing what `is_ours`, with who made them; return which files those
    are. The same figure gives the same bytes."""
    files = []
    for name, figure in figures.items():
        for suffix, about in KINDS.items():
            files.append(out / f"{name}.{suffix}")
            with replacing(files[-1], is_ours) as file:
                figure.savefig(file, format=suffix, dpi=DPI, metadata=about)
    return files


def new_figure(width: float, height: float) -> tuple[Figure, Any]:
    """Return a figure of so many inches, and its axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def hand_map(
    hand: Hand,
    where: Sequence[Place],
    values: np.ndarray,
    label: str,
    title: str,
    chosen: Sequence[int] = (),
    **style: Any,
) -> Figure:
    """Draw the palmar side unrolled: a column a digit, fingertips up; taxels coloured by `values` (n,),
    of which the bar's `label` says what they are, with a ring around those that were `chosen`."""
    figure, axes = new_figure(6, 5.4)
    drawn = panels(hand)
    for x, y, half_width, low, high in drawn:
        corner, size = (x - half_width, y + low), (2 * half_width, high - low)
        shape = f"round,pad={EDGE},rounding_size={ROUND * half_width + EDGE}"
        axes.add_patch(
            FancyBboxPatch(corner, *size, shape, facecolor="0.95", edgecolor="0.6")
        )
    for text, x, y in labels(hand, drawn):
        axes.text(x, y, text, ha="center", va="baseline")
    axes.set_aspect("equal")
    axes.axis("off")
    axes.autoscale_view()
    points = np.array([point(place, drawn) for place in where]).reshape(-1, 2)
    dots = axes.scatter(*points.T, c=values, **{"s": 14, **style})
    figure.colorbar(dots, label=label, shrink=0.7)
    if len(chosen):
        ring = {"facecolors": "none", "edgecolors": CHOSEN, "linewidths": 1.8}
        axes.scatter(*points[chosen].T, s=60, **ring)
    figure.suptitle(title, **HEAD)
    return figure


def _curve(rows: Sequence[Row], title: str) -> Figure:
    """Draw success by number of taxels: what was chosen, random sets of as many, and layouts as
    dots."""
    figure, axes = new_figure(6, 3.6)
    chosen = [row for row in rows if row.layout == "chosen"]
    random = [row for row in rows if row.layout == "random"]
    numbers = [row.taxels for row in chosen]
    axes.plot(numbers, [row.success for row in chosen], "-o", color=CHOSEN,
              label="placed by tactilerl")  # fmt: skip
    low, high = np.array([row.success_interval for row in chosen]).T
    axes.fill_between(numbers, low, high, color=CHOSEN, alpha=0.15)
    axes.plot(numbers, [row.success for row in random], color="0.6",
              label="random sets, mean")  # fmt: skip
    others = [row for row in rows if row not in chosen and row not in random]
    for i, row in enumerate(others):
        axes.plot(row.taxels, row.success, "s", color=INK)
        # To the left where another of the same size has its name on the right.
        is_left = any(
            other.taxels == row.taxels and abs(other.success - row.success) < NEAR
            for other in others[:i]
        )
        axes.annotate(
            layouts.short(row.layout),
            (row.taxels, row.success),
            xytext=(-5 if is_left else 5, -3),
            textcoords="offset points",
            ha="right" if is_left else "left",
        )
    axes.set_xscale("log")
    axes.margins(x=0.15)  # for what stands beside the last dot
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()
    axes.set(xlabel="number of taxels", ylabel="success in unseen starts")
    axes.legend(loc="lower right")
    figure.suptitle(title, **HEAD)
    return figure
