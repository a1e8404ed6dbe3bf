"""What several probes found, side by side: the tables of docs/probe_results.md, and the figure of worth
against number of taxels.

    python -m benchmarks probe_tables probes/{shadow,mpl}_{mujoco,pybullet} \\
        --figure docs/images/probe_selection.png --out docs/data/probe.json

Each folder is one that `tactilerl probe --select ... --out` wrote.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.command import parser, write
from tactilerl.probe.figures import CHOSEN, LAYOUT, draw_selection
from tactilerl.style import DPI, HEAD, NAMES, STYLE

HANDS = {"shadow": "Shadow", "mpl": "MPL", "allegro": "Allegro"}
MARKS = ((CHOSEN, "o", "-"), (LAYOUT, "s", ""))  # of the best taxels found, and of layouts
Results = dict[str, dict[str, Any]]
"""probe.json by the pair's name."""


def in_words(pair: str) -> str:
    """Hand and simulator of a folder such as mpl_mujoco."""
    hand, _, simulator = pair.partition("_")
    return f"{HANDS[hand]}, {NAMES[simulator]}"


def gains(results: Results, noise: float) -> None:
    """Gain in AUC over the joint angles."""
    print(f"\n### Will it hold? Gain in AUC, joint angles with {noise:g} rad of noise\n")
    _head("added to the joints", results)
    rows = {name: _rows(result, "hold", "auc", noise) for name, result in results.items()}
    _line("(joints alone: AUC)", [f"{found['joints', None]['value']:.3f}" for found in rows.values()])
    for told, layout in next(iter(rows.values())):
        if told not in ("joints+sight", "joints+taxels"):
            continue
        cells = [found[told, layout] for found in rows.values()]
        what = "sight" if layout is None else f"layout {layout}"
        _line(what, [_interval(row["gain"], row["gain_interval"]) for row in cells])


def places(results: Results, noise: float) -> None:
    """Where is the object?"""
    print(f"\n### Where is it, and how is it turned? mm and degrees, {noise:g} rad of noise\n")
    _head("features", results)
    where = [_rows(result, "position", "error_mm", noise) for result in results.values()]
    turned = [_rows(result, "yaw", "error_deg", noise) for result in results.values()]
    for told, layout in where[0]:
        pairs = [
            (w[told, layout]["value"], t[told, layout]["value"])
            for w, t in zip(where, turned, strict=True)
        ]
        if told != "taxels":
            what = "joints" if layout is None else f"joints + layout {layout}"
            _line(what, [f"{mm:.1f}, {degrees:.1f}°" for mm, degrees in pairs])


def chosen(results: Results) -> None:
    """The best found of some numbers, and the layouts beside the best of the same number."""
    first = next(iter(results.values()))["selection"]
    noise = f"{first['joint_noise']:g} rad of noise"
    print(f"\n### Chosen from a skin of {first['skin']}: gain in AUC, {noise}\n")
    _head("taxels", results)
    curves = [{row["taxels"]: row for row in r["selection"]["curve"]} for r in results.values()]
    for n in curves[0]:
        _line(f"best {n}", [_interval(c[n]["gain"], c[n]["gain_interval"]) for c in curves])
    layouts = [{row["layout"]: row for row in r["selection"]["layouts"]} for r in results.values()]
    for name, row in layouts[0].items():
        if "lead" in row:
            what = f"best {row['taxels']} over layout {name}"
            _line(what, [_interval(x[name]["lead"], x[name]["lead_interval"]) for x in layouts])


def differences(results: Results, noise: float) -> None:
    """Layouts against each other: differences in AUC, p-values by Holm."""
    print(f"\n### Layouts against each other: AUC, {noise:g} rad of noise (p by Holm)\n")
    _head("", results)
    found = [
        {
            (row["a"], row["b"]): row
            for row in result["differences"]
            if row["question"] == "hold" and row["metric"] == "auc" and row["joint_noise"] == noise
        }
        for result in results.values()
    ]
    for a, b in found[0]:
        cells = [pairs[a, b] for pairs in found]
        _line(f"{a} − {b}", [f"{row['difference']:+.3f} (p {row['p_holm']:.2g})" for row in cells])


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


def _rows(result: dict[str, Any], question: str, metric: str, noise: float) -> dict[Any, Any]:
    """Rows of the table by who is told what."""
    return {
        (row["told"], row["layout"]): row
        for row in result["table"]
        if (row["question"], row["metric"], row["joint_noise"]) == (question, metric, noise)
    }


def _head(first: str, results: Results) -> None:
    _line(first, list(results))
    print("|---" * (1 + len(results)) + "|")


def _line(first: str, cells: list[str]) -> None:
    print(f"| {' | '.join([first, *cells])} |")


def _interval(value: float, interval: list[float]) -> str:
    return f"{value:+.3f} ({interval[0]:+.3f} – {interval[1]:+.3f})"


def show(results: Results) -> None:
    """All tables."""
    for noise in next(iter(results.values()))["asking"]["joint_noise"]:
        gains(results, noise)
        differences(results, noise)
        places(results, noise)
    chosen(results)


def main() -> None:
    """Print the tables; draw and write what was asked for."""
    flags = parser(__doc__)
    flags.add_argument("folders", nargs="+", type=Path)
    flags.add_argument("--figure", type=Path, help="draw worth against number of taxels here")
    options = flags.parse_args()
    results: Results = {}
    for folder in options.folders:
        found = json.loads((folder / "probe.json").read_text(encoding="utf-8"))
        results[in_words(f"{found['env']}_{found['simulator']}")] = found
    show(results)
    if options.figure:
        figure(results, options.figure)
    write(options.out, results)
