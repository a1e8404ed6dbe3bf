"""Pictures of what was found, as PNG and SVG: of a probe what each layout and each taxel tells, of a
design the unrolled hand with its taxels, and what any number of them is worth."""

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
from ..style import DPI, FAINT, HEAD, INK, NAMES, OTHERS, STYLE
from .candidates import Design

CHOSEN = OTHERS[0]
TICKS = (1, 2, 5, 10, 20, 50, 100)  # of a number of taxels
KINDS: dict[str, dict[str, Any]] = {
    "png": {"Software": MAKER},
    "svg": {"Date": None, "Creator": MAKER},
}


@rc_context(STYLE)
def of_probe(result: dict[str, Any], hand: Hand) -> dict[str, Figure]:
    """Figures by name."""
    skin, title = result["worth"], f"{_where(result)}, {result['grasps']:,} grasps"
    worth = hand_map(
        hand,
        [Place(**place) for place in skin["places"]],
        np.array(skin["bits"]),
        "bits per grasp",
        f"{title}\nlayout {skin['layout']}: what each taxel adds to the joint angles",
        cmap="inferno",
    )
    return {"gain": _gains(result, title), "worth": worth}


@rc_context(STYLE)
def of_design(found: Design) -> dict[str, Figure]:
    """Figures by name: where arrivals are felt, with the largest set that was chosen, and the curve."""
    title, n = (
        f"{_where(found.result)}: {', '.join(found.result['scenes'])}",
        max(found.chosen),
    )
    drawn = hand_map(
        found.hand,
        places.of(found.pool),
        found.worth,
        WORTH[found.result["question"]],
        f"{title}\nthe {n} chosen, and what each candidate alone is worth",
        found.chosen[n],
        **{"s": 10, "cmap": "Blues", "edgecolors": "0.8", "linewidths": 0.3},
    )
    return {"hand": drawn, "curve": _curve(found.result, title)}


@rc_context(STYLE)
def save(
    drawn: dict[str, Figure], out: Path, is_ours: IsOurs | None = None
) -> list[Path]:
    """Write figures to a folder, replacing what `is_ours`, with who made them: which files those
    are. The same figure gives the same bytes."""
    files = []
    for name, figure in drawn.items():
        for suffix, about in KINDS.items():
            files.append(out / f"{name}.{suffix}")
            with replacing(files[-1], is_ours) as file:
                figure.savefig(file, format=suffix, dpi=DPI, metadata=about)
    return files


def _where(result: dict[str, Any]) -> str:
    """Hand and simulator."""
    env, simulator = result["env"], result["simulator"]
    return f"{NAMES.get(env, Path(env).stem)} in {NAMES.get(simulator, simulator)}"


def new_figure(width: float, height: float) -> tuple[Figure, Any]:
    """A figure of so many inches, and its axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _gains(result: dict[str, Any], title: str) -> Figure:
    """Gain in AUC of each layout at each joint noise."""
    told = ("joints+taxels", "joints+sight")
    rows = [
        row for row in result["table"] if row["metric"] == "auc" and row["told"] in told
    ]
    figure, axes = new_figure(6, 3.4)
    for place, noise in enumerate(result["asking"]["joint_noise"]):
        some = [row for row in rows if row["joint_noise"] == noise]
        labels = [
            Path(row["layout"]).stem if row["layout"] else "sight" for row in some
        ]
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
    figure.suptitle(title, **HEAD)
    return figure


def hand_map(
    hand: Hand,
    where: Sequence[Place],
    values: np.ndarray,
    label: str,
    title: str,
    chosen: Sequence[int] = (),
    **style: Any,
) -> Figure:
    """The palmar side unrolled: a column a digit, fingertips up; taxels coloured by `values` (n,), of
    which the bar's `label` says what they are, with a ring around those that were `chosen`."""
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


WORTH = {
    "timing": "share of starts won by this taxel alone",
    "information": "bits per grasp",
}
MEASURES = {
    "timing": ("success", "success in unseen starts"),
    "information": ("gain", "gain in AUC over joint angles"),
}


def _curve(result: dict[str, Any], title: str) -> Figure:
    """By number of taxels: what was chosen, random sets of as many, and layouts as dots."""
    drawn, axes = new_figure(6, 3.6)
    key, measured = MEASURES[result["question"]]
    for name, style in (
        ("chosen", {"color": CHOSEN, "marker": "o"}),
        ("random", {"color": "0.6"}),
    ):
        some = [row for row in result["rows"] if row["layout"] == name]
        if not some:
            continue
        numbers = [row["taxels"] for row in some]
        label = "placed by tactilerl" if name == "chosen" else "random sets, mean"
        axes.plot(numbers, [row[key] for row in some], label=label, **style)
        if name == "chosen":
            low, high = np.array([row[f"{key}_interval"] for row in some]).T
            axes.fill_between(numbers, low, high, color=CHOSEN, alpha=0.15)
    others = [
        row for row in result["rows"] if row["layout"] not in ("chosen", "random")
    ]
    axes.plot(
        [row["taxels"] for row in others], [row[key] for row in others], "s", color=INK
    )
    for i, row in enumerate(others):
        # To the left where another of the same size has its name on the right.
        alike = [o for o in others[:i] if o["taxels"] == row["taxels"]]
        is_left = any(abs(o[key] - row[key]) < 0.03 for o in alike)
        axes.annotate(
            layouts.short(row["layout"]),
            (row["taxels"], row[key]),
            xytext=(-5 if is_left else 5, -3),
            textcoords="offset points",
            ha="right" if is_left else "left",
        )
    axes.set_xscale("log")
    axes.margins(x=0.15)  # for what stands beside the last dot
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()
    axes.set(xlabel="number of taxels", ylabel=measured)
    axes.legend(loc="lower right")
    drawn.suptitle(title, **HEAD)
    return drawn
