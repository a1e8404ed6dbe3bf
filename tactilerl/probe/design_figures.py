"""Pictures of a design: the unrolled hand with its taxels, and what any number of them is worth."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from ..envs import layouts
from ..pictures import places
from ..pictures.hand_map import panels, point
from ..runs.files import MAKER
from ..style import DPI, HEAD, INK, NAMES, STYLE
from .candidates import Design
from .figures import CHOSEN, TICKS, draw_hand, new_figure

KINDS: dict[str, dict[str, Any]] = {
    "png": {"Software": MAKER},
    "svg": {"Date": None, "Creator": MAKER},
}


@rc_context(STYLE)
def draw(found: Design) -> dict[str, Any]:
    """Figures by name."""
    return {"hand": _hand(found), "curve": _curve(found)}


@rc_context(STYLE)
def save(drawn: Figure, file: BinaryIO, suffix: str) -> None:
    """Write it as one of KINDS, with who made it; the same figure gives the same bytes."""
    drawn.savefig(file, format=suffix, dpi=DPI, metadata=KINDS[suffix])


def _title(found: Design) -> str:
    result = found.result
    hand = NAMES.get(result["env"], found.hand.name)
    simulator = NAMES.get(result["simulator"], result["simulator"])
    return f"{hand} in {simulator}: {', '.join(result['scenes'])}"


def _hand(found: Design) -> Any:
    """Where arrivals are felt, and the largest set that was chosen."""
    drawn, axes = draw_hand(found.hand)
    every, where = places.of(found.pool), panels(found.hand)
    points = np.array([point(place, where) for place in every])
    dots = axes.scatter(*points.T, c=found.worth, s=10, cmap="Blues", edgecolors="0.8", linewidths=0.3)
    drawn.colorbar(dots, label=MEASURES[found.result["question"]], shrink=0.7)
    n = max(found.chosen)
    axes.scatter(*points[found.chosen[n]].T, s=60, facecolors="none", edgecolors=CHOSEN, linewidths=1.8)
    drawn.suptitle(f"{_title(found)}\nthe {n} chosen, and what each candidate alone is worth", **HEAD)
    return drawn


MEASURES = {"timing": "share of starts won by this taxel alone", "information": "bits per grasp"}


def _curve(found: Design) -> Any:
    """By number of taxels: what was chosen, random sets of as many, and layouts as dots."""
    drawn, (axes,) = new_figure(6, 3.6)
    rows, key = (
        found.result["rows"],
        {"timing": "success", "information": "gain"}[found.result["question"]],
    )
    for name, style in (("chosen", {"color": CHOSEN, "marker": "o"}), ("random", {"color": "0.6"})):
        some = [row for row in rows if row["layout"] == name]
        if not some:
            continue
        numbers = [row["taxels"] for row in some]
        label = "placed by tactilerl" if name == "chosen" else "random sets, mean"
        axes.plot(numbers, [row[key] for row in some], label=label, **style)
        if name == "chosen":
            low, high = np.array([row[f"{key}_interval"] for row in some]).T
            axes.fill_between(numbers, low, high, color=CHOSEN, alpha=0.15)
    for row in rows:
        if row["layout"] not in ("chosen", "random"):
            axes.plot(row["taxels"], row[key], "s", color=INK)
            name = layouts.short(row["layout"])
            axes.annotate(name, (row["taxels"], row[key]), xytext=(5, -3), textcoords="offset points")
    axes.set_xscale("log")
    axes.margins(x=0.15)  # for what stands beside the last dot
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()
    told = {"timing": "success in unseen starts", "information": "gain in AUC over joint angles"}
    axes.set(xlabel="number of taxels", ylabel=told[found.result["question"]])
    axes.legend(loc="lower right")
    drawn.suptitle(_title(found), **HEAD)
    return drawn
