"""Pictures of what was found, as PNG and SVG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from ..envs.hands import Hand
from ..pictures.hand_map import EDGE, ROUND, labels, panels, point
from ..pictures.places import Place
from ..style import DPI, FAINT, HEAD, NAMES, OTHERS, STYLE

CHOSEN = OTHERS[0]
TICKS = (1, 2, 5, 10, 20, 50, 100)  # of a number of taxels


@rc_context(STYLE)
def draw(result: dict[str, Any], hand: Hand, out: Path) -> None:
    """All figures that there is something to draw for."""
    figures = {"gain": _gains(result)}
    skin = result["worth"]
    places = [Place(**place) for place in skin["places"]]
    title = f"{_title(result)}\nlayout {skin['layout']}: what each taxel adds to the joint angles"
    figures["worth"] = hand_map(hand, places, title, np.array(skin["bits"]))
    for name, figure in figures.items():
        for suffix, metadata in (("png", None), ("svg", {"Date": None})):
            figure.savefig(out / f"{name}.{suffix}", dpi=DPI, metadata=metadata)


def new_figure(width: float, height: float, columns: int = 1) -> tuple[Figure, Any]:
    """A figure of so many inches, and its axes in a row."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(1, columns, squeeze=False, sharey=True)[0]


def _gains(result: dict[str, Any]) -> Any:
    """Gain in AUC of each layout at each joint noise."""
    told = ("joints+taxels", "joints+sight")
    rows = [row for row in result["table"] if row["metric"] == "auc" and row["told"] in told]
    figure, (axes,) = new_figure(6, 3.4)
    for place, noise in enumerate(result["asking"]["joint_noise"]):
        some = [row for row in rows if row["joint_noise"] == noise]
        labels = [Path(row["layout"]).stem if row["layout"] else "sight" for row in some]
        gains = np.array([row["gain"] for row in some])
        ends = np.array([row["gain_interval"] for row in some]).T
        axes.errorbar(
            np.arange(len(some)) + 0.12 * place, gains, np.abs(ends - gains), fmt="o", capsize=3,
            label=f"joint noise {noise:g} rad",
        )  # fmt: skip
        axes.set_xticks(range(len(some)), labels)
    axes.axhline(0, color=FAINT, zorder=0)
    axes.set(xlabel="layout", ylabel="gain in AUC over joint angles")
    axes.legend()
    figure.suptitle(_title(result), **HEAD)
    return figure


def _title(result: dict[str, Any]) -> str:
    """Hand, simulator and number of grasps."""
    hand = NAMES.get(result["env"], Path(result["env"]).name)
    return (
        f"{hand} in {NAMES.get(result['simulator'], result['simulator'])}, {result['grasps']:,} grasps"
    )


def hand_map(hand: Hand, places: Sequence[Place], title: str, worth: np.ndarray | None = None) -> Any:
    """The palmar side unrolled: a column a digit, fingertips up; taxels coloured by `worth` (n,),
    bits, or in their order."""
    figure, axes = draw_hand(hand)
    drawn = panels(hand)
    points = np.array([point(place, drawn) for place in places]).reshape(-1, 2)
    colour = np.arange(1, len(places) + 1) if worth is None else worth
    dots = axes.scatter(*points.T, c=colour, s=14, cmap="viridis_r" if worth is None else "inferno")
    figure.colorbar(dots, label="order of choice" if worth is None else "bits per grasp", shrink=0.7)
    figure.suptitle(title, **HEAD)
    return figure


def draw_hand(hand: Hand) -> tuple[Figure, Any]:
    """A figure with the palmar side unrolled, and its axes."""
    drawn, (axes,) = new_figure(6, 5.4)
    for panel in panels(hand):
        x, y, half_width, low, high = panel
        corner, size = (x - half_width, y + low), (2 * half_width, high - low)
        style = f"round,pad={EDGE},rounding_size={ROUND * half_width + EDGE}"
        axes.add_patch(FancyBboxPatch(corner, *size, style, facecolor="0.95", edgecolor="0.6"))
    for text, x, y in labels(hand, panels(hand)):
        axes.text(x, y, text, ha="center", va="baseline")
    axes.set_aspect("equal")
    axes.axis("off")
    axes.autoscale_view()
    return drawn, axes
