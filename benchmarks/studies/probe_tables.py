"""What several probes found, side by side: the tables of docs/probe_results.md, and the figure of worth
against number of taxels.

docs/data/probe.json is what `tactilerl probe --select ... --out` of version 0.3.0 wrote, by pair.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from tactilerl.probe.figures import CHOSEN, TICKS
from tactilerl.style import DPI, FAINT, HEAD, INK, NAMES, STYLE

from benchmarks.printing import interval, markdown

HANDS = {"shadow": "Shadow", "mpl": "MPL", "allegro": "Allegro"}
MARKS = ((CHOSEN, "o", "-"), (INK, "s", ""))  # of the best taxels found, and of layouts
Results = dict[str, dict[str, Any]]
"""probe.json by the pair's name."""


def in_words(pair: str) -> str:
    """Hand and simulator of a folder such as mpl_mujoco."""
    hand, _, simulator = pair.partition("_")
    return f"{HANDS[hand]}, {NAMES[simulator]}"


def gains(results: Results, noise: float) -> None:
    """Gain in AUC over the joint angles."""
    found = [_rows(result, "hold", "auc", noise) for result in results.values()]
    alone = [f"{of['joints', None]['value']:.3f}" for of in found]
    rows: list[tuple[str, ...]] = [("(joints alone: AUC)", *alone)]
    for told, layout in found[0]:
        if told in ("joints+sight", "joints+taxels"):
            what = "sight" if layout is None else f"layout {layout}"
            rows.append((what, *(_interval(of[told, layout], "gain") for of in found)))
    markdown(_head("added to the joints", results), rows)


def places(results: Results, noise: float) -> None:
    """Where is the object?"""
    where = [_rows(result, "position", "error_mm", noise) for result in results.values()]
    turned = [_rows(result, "yaw", "error_deg", noise) for result in results.values()]
    rows = []
    for told, layout in where[0]:
        if told != "taxels":
            errors = [
                [of[told, layout]["value"] for of in both] for both in zip(where, turned, strict=True)
            ]
            what = "joints" if layout is None else f"joints + layout {layout}"
            rows.append((what, *(f"{mm:.1f}, {degrees:.1f}°" for mm, degrees in errors)))
    markdown(_head("features", results), rows)


def chosen(results: Results) -> None:
    """The best found of some numbers, and the layouts beside the best of the same number."""
    selections = [result["selection"] for result in results.values()]
    curves = [{row["taxels"]: row for row in one["curve"]} for one in selections]
    layouts = [{row["layout"]: row for row in one["layouts"]} for one in selections]
    rows = [(f"best {n}", *(_interval(curve[n], "gain") for curve in curves)) for n in curves[0]]
    rows += [
        (f"best {row['taxels']} over layout {name}", *(_interval(of[name], "lead") for of in layouts))
        for name, row in layouts[0].items()
        if "lead" in row
    ]
    markdown(_head("taxels", results), rows)


def differences(results: Results, noise: float) -> None:
    """Layouts against each other: differences in AUC, p-values by Holm."""
    asked = ("hold", "auc", noise)
    found = [
        {(row["a"], row["b"]): row for row in result["differences"] if _question(row) == asked}
        for result in results.values()
    ]
    rows = []
    for a, b in found[0]:
        cells = [f"{of[a, b]['difference']:+.3f} (p {of[a, b]['p_holm']:.2g})" for of in found]
        rows.append((f"{a} − {b}", *cells))
    markdown(_head("", results), rows)


def figure(results: Results, path: Path) -> None:
    """A panel for each pair."""
    with rc_context(STYLE):
        picture = Figure(figsize=(9, 6.6), layout="constrained")
        panels = picture.subplots(2, 2, sharex=True, sharey=True).flat
        for result, axes in zip(results.values(), panels, strict=False):
            draw_selection(axes, result["selection"])
            hand, simulator = NAMES[result["env"]], NAMES[result["simulator"]]
            axes.set_title(f"{hand} in {simulator}, {100 * result['held']:.0f} % of grasps held")
        for axes in picture.axes[2:]:
            axes.set_xlabel("number of taxels")
        picture.supylabel("gain in AUC over joint angles with 0.05 rad of noise", fontsize="medium")
        (grasps,) = {result["grasps"] for result in results.values()}
        picture.suptitle(f"Prediction of whether a grasp will hold, {grasps:,} grasps each", **HEAD)
        line, square = (Line2D([], [], color=c, marker=m, ls=s) for c, m, s in MARKS)
        names = ["best taxels found, 95 % interval", "the paper's layouts 1 to 6, 95 % interval"]
        picture.legend([line, square], names, loc="outside lower center", ncols=2)
        picture.savefig(path, dpi=DPI, metadata={"Software": None})


def draw_selection(axes: Any, selection: dict[str, Any]) -> None:
    """Gain against the number of taxels: the best found, and the layouts as points."""
    n, gain = ([row[key] for row in selection["curve"]] for key in ("taxels", "gain"))
    axes.plot(n, gain, "o-", color=CHOSEN)
    ends = np.array([row["gain_interval"] for row in selection["curve"]]).T
    axes.fill_between(n, *ends, color=CHOSEN, alpha=0.15)
    for row in selection["layouts"]:
        ends = np.array(row["gain_interval"])[:, None]
        at = row["taxels"], row["gain"]
        axes.errorbar(*at, np.abs(ends - row["gain"]), fmt="s", color=INK, capsize=3)
        beside = [one for one in selection["layouts"] if 0.7 < one["taxels"] / row["taxels"] < 1.4]
        is_left = any(one["taxels"] > row["taxels"] for one in beside)
        is_lower = any(one["gain"] > row["gain"] for one in beside)
        axes.annotate(
            Path(row["layout"]).stem, at, xytext=(-6 if is_left else 6, -9 if is_lower else 4),
            textcoords="offset points", ha="right" if is_left else "left",
        )  # fmt: skip
    axes.axhline(0, color=FAINT, zorder=0)
    axes.set_xscale("log")
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()


def _question(row: dict[str, Any]) -> tuple[str, str, float]:
    return row["question"], row["metric"], row["joint_noise"]


def _rows(result: dict[str, Any], *asked: Any) -> dict[Any, Any]:
    """Rows of the table by who is told what."""
    return {(r["told"], r["layout"]): r for r in result["table"] if _question(r) == asked}


def _head(first: str, results: Results) -> str:
    return f"| {' | '.join((first, *results))} |"


def _interval(row: dict[str, Any], key: str) -> str:
    return interval(row[key], *row[f"{key}_interval"], "+.3f")
