"""`tactilerl probe`: flags in, exit code out."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from ..errors import extra, input_errors
from ..probe.options import GraspFlags, Options
from ..terminal import flags, interrupts
from ..terminal.console import console, progress
from ..terminal.help import About
from .grasps import require_grasp

ABOUT = About(
    "How well do a layout's readings just before the lift predict whether a grasp holds? Plays "
    "scripted grasps and compares layouts, without training (extra: probe).",
    first=(
        "scene", "env", "simulator", "grasps", "seed", "layout", "joint_noise",
        "out", "grasps_file", "workers", "json",
    ),
    examples=(
        "tactilerl probe --env shadow",
        "tactilerl probe --env shadow --layout 1 my_layout.toml",
    ),
)  # fmt: skip


def main(args: list[str]) -> int:
    """`tactilerl probe`: what was played is kept when it is interrupted."""
    with input_errors():
        scene = flags.peek(args, "--scene", "")
        usual = Options(GraspFlags.of_scene(scene) if scene else GraspFlags())
    read = flags.parse(Options, args, "tactilerl probe", ABOUT, usual)
    with input_errors():
        read.validate()
    with extra("probe"):
        from ..probe import run

    if read.output.grasps_file is None:
        with input_errors():
            require_grasp(read.grasp.env, read.grasp.config)
    with ExitStack() as held:
        with (
            progress("grasps", is_shown=not read.output.json) as show,
            interrupts.in_order(),
        ):
            played, out = run.grasps(read, held, show)
        if not read.output.json:
            console.print(f"analysing {len(played.records['held'])} grasps")
        with Console(stderr=True, quiet=read.output.json).status(
            "evaluating classifiers"
        ):
            result = run.analyse(read, played, out)
    if read.output.json:
        print(json.dumps(result))
    else:
        _print(result, out)
    return 0


ENOUGH = 1_000  # grasps
HOLDS = {"auc": ("AUC", ".3f"), "bits": ("bits", ".3f")}  # metric -> heading and format
OBJECT = {
    "r2": ("place: R²", ".3f"),
    "error_mm": ("mm", ".1f"),
    "error_deg": ("yaw: °", ".1f"),
    "balanced_accuracy": ("which: accuracy", ".3f"),
}


def _print(result: dict[str, Any], out: Path) -> None:
    """The table on the terminal, and how far it can be trusted."""
    console.print(
        f"{result['env']} in {result['simulator']}, rule {result['touch_rule']}: "
        f"{result['grasps']} grasps, {100 * result['held']:.0f} % held"
    )
    if result["grasps"] < ENOUGH:
        console.print(
            f"{result['grasps']} grasps are few: with {ENOUGH:,} or more, gains are sure to 0.02"
        )
    for noise in result["asking"]["joint_noise"]:
        rows = [row for row in result["table"] if row["joint_noise"] == noise]
        taxels = {name: about["taxels"] for name, about in result["layouts"].items()}
        title = f"joint noise {noise:g} rad: will it hold?"
        console.print(_table(title, rows, HOLDS, taxels))
        console.print(
            _table("where is the object, and which is it?", rows, OBJECT, taxels)
        )
    check = result["shuffled"]
    verdict = (
        "compatible with 0" if check["is_zero"] else "not 0: do not trust the gains"
    )
    gain = _signed(check["gain"], check["interval"])
    console.print(
        f"outcomes shuffled: layout {check['layout']} gains {gain}, {verdict}"
    )
    _print_differences([d for d in result["differences"] if d["question"] == "hold"])
    written = sorted(
        path.name for path in out.iterdir() if not path.name.startswith(".")
    )
    console.print(f"{out}: {', '.join(written)}")


FEW = 6  # comparisons that are all shown


def _print_differences(found: list[dict[str, Any]]) -> None:
    """What one layout tells of the outcome more than another; of many pairs, those that surely do."""
    clear = [d for d in found if d["p_holm"] < 0.05]
    for d in found if len(found) <= FEW else clear:
        pair = f"joint noise {d['joint_noise']:g}: layout {d['a']} − {d['b']}"
        more = _signed(d["difference"], d["interval"])
        console.print(f"{pair}: AUC {more}, p {d['p_holm']:.3f} (Holm)")
    if found and not clear:
        console.print(
            f"in none of {len(found)} comparisons does one layout clearly predict the outcome better"
        )


def _table(
    title: str,
    rows: list[dict[str, Any]],
    columns: dict[str, tuple[str, str]],
    taxels: dict[str, int],
) -> Table:
    """A row for each that is told something else, a column for each measure that there is."""
    found = {(row["told"], row["layout"], row["metric"]): row for row in rows}
    metrics = [metric for metric in columns if any(metric == key[-1] for key in found)]
    table = Table("features", title=title, box=box.SIMPLE_HEAD)
    for heading in ("taxels", *(columns[metric][0] for metric in metrics)):
        table.add_column(heading, justify="right", no_wrap=True)
    if "auc" in metrics:
        table.add_column("gain (95 %)", no_wrap=True)
    for told, layout in dict.fromkeys(key[:2] for key in found):
        measured = {metric: found.get((told, layout, metric), {}) for metric in metrics}
        if not any(measured.values()):
            continue
        cells = [told, ""]
        if layout is not None:
            cells = [told.replace("taxels", f"layout {layout}"), str(taxels[layout])]
        for metric, row in measured.items():
            value = row.get("value")
            cells.append("" if value is None else format(value, columns[metric][1]))
        if "gain" in measured.get("auc", {}):
            cells.append(
                _signed(measured["auc"]["gain"], measured["auc"]["gain_interval"])
            )
        table.add_row(*cells)
    return table


def _signed(value: float, ends: list[float]) -> str:
    return f"{value:+.3f} ({ends[0]:+.3f} … {ends[1]:+.3f})"
