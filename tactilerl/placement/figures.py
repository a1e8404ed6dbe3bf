"""Pictures of a design: the unrolled hand with its taxels, and what any number of them is worth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from ..envs import layouts
from ..files import replacing
from ..pictures import places
from ..pictures.hand_map import TaxelMap
from ..style import DPI, HEAD, INK, NAMES, OTHERS, STYLE
from .choice import Design, Row

CHOSEN = OTHERS[0]
TICKS = (1, 2, 5, 10, 20, 50, 100)  # of a number of taxels
PIXELS = 900  # height of the hand in its picture


@rc_context(STYLE)
def of_design(design: Design) -> dict[str, Figure]:
    """Draw where arrivals are felt, with the largest set that was chosen, and the curve."""
    pool = design.pool
    env, simulator = pool.env, pool.scenes[0].config.simulator
    where = f"{NAMES.get(env, Path(env).stem)} in {NAMES.get(simulator, simulator)}"
    title = f"{where}: {', '.join(scene.name for scene in pool.scenes)}"
    return {"hand": hand_map(design, title), "curve": _curve(design.rows, title)}


@rc_context(STYLE)
def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the same figure gives the same bytes."""
    with replacing(path) as file:
        figure.savefig(file, dpi=DPI)


def hand_map(design: Design, title: str) -> Figure:
    """Draw the palmar side unrolled, with what each candidate alone is worth, and a ring around each of
    the largest set that was chosen."""
    pool = design.pool
    figure = Figure((6, 5.4), layout="constrained")
    axes = figure.subplots()
    drawn = TaxelMap(pool.hand, pool.taxels.take([]), PIXELS)
    axes.imshow(drawn.picture([]), extent=drawn.extent)
    axes.axis("off")
    x, y = np.array([drawn.point(place) for place in places.of(pool.taxels)]).T
    look: Any = {"cmap": "Blues", "edgecolors": "0.8", "linewidths": 0.3}
    dots = axes.scatter(x, y, 10, design.worth, **look)
    figure.colorbar(dots, label="share of starts won by this taxel alone", shrink=0.7)
    n = max(design.chosen)
    ring: Any = {"facecolors": "none", "edgecolors": CHOSEN, "linewidths": 1.8}
    chosen = design.chosen[n]
    axes.scatter(x[chosen], y[chosen], 60, **ring)
    about = f"the {n} chosen, and what each candidate alone is worth"
    figure.suptitle(f"{title}\n{about}", **HEAD)
    return figure


def _curve(rows: Sequence[Row], title: str) -> Figure:
    """Draw success by number of taxels: what was chosen, random sets of as many, and layouts as
    dots."""
    figure = Figure((6, 3.6), layout="constrained")
    axes = figure.subplots()
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
        side = "right" if i % 2 else "left"  # neighbours' names stand on either side
        name = f" {layouts.short(row.layout)} "
        axes.text(row.taxels, row.success, name, ha=side, va="center")
    axes.set_xscale("log")
    axes.margins(x=0.15)  # for what stands beside the last dot
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()
    axes.set(xlabel="number of taxels", ylabel="success in unseen starts")
    axes.legend(loc="lower right")
    figure.suptitle(title, **HEAD)
    return figure
