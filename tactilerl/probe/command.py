"""`tactilerl probe`: flags in, exit code out."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from .. import flags, interrupts
from ..algos import mpi
from ..config import require_workers
from ..envs import hands, objects
from ..envs.hold import Verdict
from ..errors import InputError, input_errors
from ..files import pasted
from ..terminal import console
from .faults import TaxelFaults
from .grasps import Perturbation

SIX = ("1", "2", "3", "4", "5", "6")


@dataclass(frozen=True)
class GraspFlags:
    """The grasps to play."""

    env: str = "shadow"
    """Which hand: shadow, mpl, allegro, or the path of a hand's .toml file."""
    simulator: Literal["mujoco", "pybullet"] | None = None
    """The physics engine; default: the hand's."""
    policy: Path | None = None
    """Grasps of a trained policy with its noise, in its run's own scene, instead of scripted ones."""
    grasps: int = 2_000
    """Number of grasps."""
    seed: int = 0
    """Random seed of grasps, folds, noise and bootstrap samples."""
    touch: Literal["skin", "contact"] = "skin"
    """Touch rule. skin: any layout can be read afterwards; contact: the simulator's own contacts are
    recorded for the layouts of this call."""
    object: tuple[objects.Kind, ...] = ("box",)
    """Kinds of object: box, sphere, cylinder."""
    object_size: tuple[float, ...] = (0.04, 0.045, 0.05)
    """Edges of cubes, diameters (and heights) of others, m."""
    friction: tuple[float, ...] = (0.5, 1.0)
    """Sliding frictions of the object."""
    start_offset: float = 0.025
    """Largest distance of the object from its place along x and y, m."""
    start_yaw: float = 0.6
    """Largest turn of the object, rad."""
    closing: tuple[float, float] | None = None
    """How far the fingers close, from and to: 1 is all the way of the scripted grasp; default: what
    lets 30 to 70 % of the grasps hold (mpl 0.8 1.1, others 0.5 0.9)."""
    joint_jitter: float = 0.1
    """Largest offset of a finger joint at the start, rad."""
    hold_verdict: Verdict = "settled"
    """full: is the object up 2 s after the lift?; settled: the same, called early in PyBullet when the
    object has come to rest in the hand."""

    @property
    def perturbation(self) -> Perturbation:
        """That of scripted grasps."""
        return Perturbation(
            self.object, self.object_size, self.friction, self.start_offset, self.start_yaw,
            self.closing or hands.registration(self.env).closing, self.joint_jitter,
        )  # fmt: skip

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        if not hands.is_hand(self.env):
            raise ValueError(f"env: found {self.env!r}, allowed: {hands.allowed()}")
        if self.grasps < 1:
            raise ValueError(f"grasps: found {self.grasps}, allowed 1 or more")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed: found {self.seed}, allowed from 0 to 2**32 - 1")
        for name in ("object", "object_size", "friction"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}: found {list(values)}, allowed one or more, each once")
        for name, most in (("start_offset", 0.05), ("start_yaw", 3.2), ("joint_jitter", 1.0)):
            value = getattr(self, name)
            if not 0 <= value <= most:
                raise ValueError(f"{name}: found {value}, allowed from 0 to {most}")
        low, high = self.perturbation.closing
        if not 0 <= low <= high <= 2:
            raise ValueError(f"closing: found {low} {high}, allowed from 0 to 2, the smaller first")


@dataclass(frozen=True)
class AnalysisFlags:
    """The questions to ask."""

    layout: tuple[str, ...] = SIX
    """Layouts: 1-6, named designs, or paths of .toml files."""
    estimator: Literal["linear", "boosting"] = "linear"
    """linear: regularised linear models; boosting: boosted trees, which take many times as long."""
    joint_noise: tuple[float, ...] = (0.0, 0.05)
    """Standard deviations of noise on the joint angles, rad; each is reported."""
    folds: int = 5
    """Folds of the cross-validation."""
    hold_out: Literal["grasps", "objects"] = "grasps"
    """What a fold holds back: some grasps, or all grasps of some objects, so that these are new."""
    resamples: int = 2_000
    """Bootstrap samples behind an interval."""
    shuffles: int = 10
    """How often outcomes are shuffled, to check that nothing is gained then."""
    select: tuple[int, ...] = ()
    """Choose this many taxels from a dense skin; several numbers give a layout file each."""
    skin: str = "1"
    """The skin to choose from: a layout, or the spacing of a grid over all phalanges, such as 2mm."""

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        for name, least in (("folds", 2), ("resamples", 100), ("shuffles", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: found {getattr(self, name)}, allowed {least} or more")
        for noise in self.joint_noise:
            if not 0 <= noise <= 10:
                raise ValueError(f"joint_noise: found {noise}, allowed from 0 to 10")
        for n in self.select:
            if n < 1:
                raise ValueError(f"select: found {n}, allowed 1 or more")
        for name in ("layout", "joint_noise"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}: found {list(values)}, allowed one or more, each once")


@dataclass(frozen=True)
class OutputFlags:
    """Where results go and how they are shown."""

    out: Path | None = None
    """Folder of grasps.npz, probe.json and figures; default: probes/ENV_SIMULATOR. The same command
    continues what is there."""
    grasps_file: Annotated[Path | None, tyro.conf.arg(name="from", metavar="FILE")] = None
    """Read the grasps from this file instead of playing any."""
    workers: int | None = None
    """Grasps played side by side; default: one per free core. Results do not depend on it."""
    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class ProbeFlags:
    """Flags of `tactilerl probe`."""

    grasp: GraspFlags = GraspFlags()
    analysis: AnalysisFlags = AnalysisFlags()
    fault: TaxelFaults = field(default_factory=TaxelFaults)
    output: OutputFlags = OutputFlags()


def main(args: list[str]) -> int:
    """`tactilerl probe`: exit 130 when it was interrupted."""
    about = "What do taxels tell of a grasp, at the moment before the lift? Needs the extra probe."
    read = flags.parse(ProbeFlags, args, "tactilerl probe", about=about)
    with input_errors():
        for part in (read.grasp, read.analysis, read.fault):
            part.validate()
        require_workers(read.output.workers)
        comm = mpi.world()
    _require_extra()
    from . import run

    with _Bar(read.grasp.grasps, is_shown=comm.rank == 0 and not read.output.json) as bar:
        try:
            with interrupts.in_order():
                played, out = run.grasps(read, comm, bar.show)
        except KeyboardInterrupt:
            kept = f"{bar.done} of {read.grasp.grasps} grasps are kept; the same command goes on"
            print(f"tactilerl: interrupted; {kept}", file=sys.stderr)
            return 130
    if comm.rank > 0:
        return 0
    if not read.output.json:
        console.print(f"analysing {len(played.records['held'])} grasps")
    result = run.analyse(read, played, out)
    if read.output.json:
        print(json.dumps(result))
        return 0
    _print(result, out)
    return 0


def _require_extra() -> None:
    for package, name in (("sklearn", "scikit-learn"), ("matplotlib", "matplotlib")):
        if find_spec(package) is None:
            raise InputError(
                f"probe: found no {name}; install the extra: pip install 'tactilerl[probe]'"
            )


EVERY = 30.0  # s between lines


class _Bar:
    """Grasps played so far: a bar on a terminal, elsewhere a line now and then."""

    def __init__(self, total: int, is_shown: bool) -> None:
        screen = Console(stderr=True)
        columns = (TextColumn("grasps"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._progress = Progress(
            *columns, console=screen, disable=not (is_shown and screen.is_terminal)
        )
        self._task = self._progress.add_task("", total=None)
        self._said = time.monotonic() if is_shown and not screen.is_terminal else math.inf
        self.done, self._total = 0, total

    def show(self, done: int) -> None:
        """So many are there."""
        self.done = done
        if time.monotonic() - self._said > EVERY:
            self._said = time.monotonic()
            print(f"grasps {done:,}/{self._total:,}", file=sys.stderr, flush=True)
        self._progress.update(self._task, completed=done, total=self._total)

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


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
        f"{result['env']} in {result['simulator']}, rule {result['touch']}: {result['grasps']} grasps, "
        f"{100 * result['held']:.0f} % held"
    )
    for noise in result["asking"]["joint_noise"]:
        rows = [row for row in result["table"] if row["joint_noise"] == noise]
        taxels = {name: about["taxels"] for name, about in result["layouts"].items()}
        title = f"joint noise {noise:g} rad: will it hold?"
        console.print(_table(title, rows, HOLDS, taxels))
        console.print(_table("where is the object, and which is it?", rows, OBJECT, taxels))
    check = result["shuffled"]
    low, high = check["interval"]
    verdict = "no gain, as it should be" if check["is_zero"] else "not 0: do not trust the gains"
    console.print(
        f"outcomes shuffled: layout {check['layout']} gains {check['gain']:+.3f} "
        f"({low:+.3f} … {high:+.3f}), {verdict}"
    )
    _print_differences([d for d in result["differences"] if d["question"] == "hold"])
    for row in result.get("selection", {}).get("layouts", ()):
        if "lead" in row:
            low, high = row["lead_interval"]
            console.print(
                f"layout {row['layout']}: {row['taxels']} taxels chosen from the skin tell "
                f"{row['lead']:+.3f} ({low:+.3f} – {high:+.3f}) more"
            )
    for path in result.get("selection", {}).get("files", ()):
        console.print(f"chosen: {out / path}    tactilerl train --layout {pasted(out / path)}")
    console.print(f"{out}: {', '.join(sorted(path.name for path in out.iterdir()))}")


FEW = 6  # comparisons that are all shown


def _print_differences(found: list[dict[str, Any]]) -> None:
    """What one layout tells of the outcome more than another; of many pairs, those that surely do."""
    clear = [d for d in found if d["p_holm"] < 0.05]
    for d in found if len(found) <= FEW else clear:
        console.print(
            f"joint noise {d['joint_noise']:g}: layout {d['a']} − {d['b']}: AUC "
            f"{d['difference']:+.3f} ({d['interval'][0]:+.3f} … {d['interval'][1]:+.3f}), "
            f"p {d['p_holm']:.3f} (Holm)"
        )
    if found and not clear:
        console.print(
            f"of {len(found)} comparisons, none shows that a layout tells more of the outcome"
        )


def _table(
    title: str, rows: list[dict[str, Any]], columns: dict[str, tuple[str, str]], taxels: dict[str, int]
) -> Table:
    """A row for each that is told something else, a column for each measure that there is."""
    found = {(row["told"], row["layout"], row["metric"]): row for row in rows}
    metrics = [metric for metric in columns if any(row["metric"] == metric for row in rows)]
    table = Table("told", title=title, box=box.SIMPLE_HEAD)
    for heading in ("taxels", *(columns[metric][0] for metric in metrics)):
        table.add_column(heading, justify="right", no_wrap=True)
    if "auc" in metrics:
        table.add_column("gain by taxels (95 %)", no_wrap=True)
    for told, layout in dict.fromkeys((row["told"], row["layout"]) for row in rows):
        cells = [(found.get((told, layout, metric)), columns[metric][1]) for metric in metrics]
        if not any(row for row, _ in cells):
            continue
        name = told if layout is None else told.replace("taxels", f"layout {layout}")
        values = [_value(row, form) for row, form in cells]
        gain = [_gain(cells[0][0])] if "auc" in metrics else []
        table.add_row(name, "" if layout is None else str(taxels[layout]), *values, *gain)
    return table


def _value(row: dict[str, Any] | None, form: str) -> str:
    return "" if row is None or row["value"] is None else format(row["value"], form)


def _gain(row: dict[str, Any] | None) -> str:
    if row is None or "gain" not in row:
        return ""
    low, high = row["gain_interval"]
    return f"{row['gain']:+.3f} ({low:+.3f} … {high:+.3f})"
