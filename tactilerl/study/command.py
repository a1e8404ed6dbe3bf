"""The command `tactilerl study`: its flags, and what each of its parts does."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich import box
from rich.table import Table

from .. import flags
from ..errors import InputError
from ..files import pasted
from ..terminal import console
from . import display, grid
from .folder import StudyFolder

if TYPE_CHECKING:
    from .planning import Need
    from .records import Record


@dataclass(frozen=True)
class RunFlags:
    """Flags of `tactilerl study run`."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME. Runs already in it are continued."""
    jobs: int | None = None
    """Runs trained at a time; default: one per core, or under mpirun one per rank but the first."""
    ranks_per_run: int = 1
    """Processes of each run (DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try failed runs again."""


def run(args: list[str]) -> int:
    """`tactilerl study run FILE`"""
    read = flags.parse(RunFlags, args, "tactilerl study run")
    from . import runner

    for flag, value in (("--jobs", read.jobs), ("--ranks-per-run", read.ranks_per_run)):
        if value is not None:
            flags.at_least(flag, value, 1)
    parallel = read.jobs or max(1, _cores() // read.ranks_per_run)
    with runner.executor(parallel) as pool:
        return _run(read, pool, parallel) if pool is not None else 0


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _run(read: RunFlags, pool: Executor, parallel: int) -> int:
    from . import check, runner
    from .folder import Outcome

    study = grid.read(read.study)
    folder = StudyFolder(read.out or Path("studies") / study.name)
    runs = study.runs()
    title = f"study {study.name}"
    console.print(f"{title}: checking {len(runs)} runs")
    configs = check.configure(runs)
    damaged = check.find_damage(runs, configs, folder)
    check.start(runs, configs, folder)
    folder.create(study)
    jobs = []
    for one in runs:
        files, total = folder.files(one), configs[one.name].run.total_timesteps
        if found := files.damage():
            console.print(f"{one.name}: {found}; recorded as done, it is trained again")
            if place := files.set_aside():
                console.print(f"  what is left of it: {pasted(place)}")
        if read.retry_failed and (before := files.outcome()) and before.state == "failed":
            files.outcome_file.unlink()
        if one.name in damaged:
            console.print(f"{one.name}: {damaged[one.name]}; repair or remove it, then --retry-failed")
            files.write_outcome(Outcome("failed", total, damaged[one.name]))
        outcome = files.outcome()
        if outcome is None or (outcome.state == "done" and outcome.total_timesteps < total):
            jobs.append(runner.Job(files.base, check.arguments(one), total, read.ranks_per_run))
    overview = display.Overview(folder, runs)
    console.print(f"{title}: {len(runs)} runs, {len(jobs)} to do, in {folder.path}")
    with display.Watch(overview, getattr(pool, "num_workers", parallel), title) as watch:
        endings = runner.run_all(jobs, pool, watch)
    failures = _print_failures(folder, runs)
    if elsewhere := list(endings.values()).count("busy"):
        console.print(f"{elsewhere} runs are trained by another `study run`")
    console.print(f"  tactilerl study report {pasted(folder.path)}")
    return 1 if failures else 0


def _print_failures(folder: StudyFolder, runs: list[grid.Run]) -> int:
    """Every run that failed, and why; how many."""
    outcomes = {one.name: folder.files(one).outcome() for one in runs}
    reasons = {name: o.reason for name, o in outcomes.items() if o and o.state == "failed"}
    for name, reason in reasons.items():
        console.print(f"failed: {name}: {reason}")
    return len(reasons)


@dataclass(frozen=True)
class StatusFlags:
    """Flags of `tactilerl study status`."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    json: bool = False
    """Print JSON instead of a table."""


def status(args: list[str]) -> int:
    """`tactilerl study status FOLDER`"""
    read = flags.parse(StatusFlags, args, "tactilerl study status")
    folder = StudyFolder(read.folder)
    study = folder.study()
    overview = display.Overview(folder, study.runs())
    eta = overview.eta(overview.counts()["running"] or _cores())
    if read.json:
        states = {name: dataclasses.asdict(one) for name, one in overview.standings.items()}
        counts = {"runs": len(states), **overview.counts()}
        print(json.dumps({"study": study.name, **counts, "eta_s": eta, "states": states}))
        return 0
    console.print(overview.table(f"study {study.name}, {len(overview.runs)} runs"))
    is_over = overview.counts()["done"] + overview.counts()["failed"] == len(overview.runs)
    console.print("nothing left to do" if is_over else f"ETA {display.duration(eta)}")
    _print_failures(folder, overview.runs)
    return 0


@dataclass(frozen=True)
class CollectFlags:
    """Flags of `tactilerl study collect`."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """The file; default: collected.csv.gz in the folder."""


def collect(args: list[str]) -> int:
    """`tactilerl study collect FOLDER`"""
    from . import records

    read = flags.parse(CollectFlags, args, "tactilerl study collect")
    path = records.collect(read.folder, read.out)
    console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return 0


@dataclass(frozen=True)
class ReportFlags:
    """Flags of `tactilerl study report`."""

    study: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    out: Path | None = None
    """Folder for the report; default: report/ beside the runs or the collected file."""
    resamples: int = 50_000
    """Resamples of every bootstrap and permutation test; fewer are faster and less exact."""


def report(args: list[str]) -> int:
    """`tactilerl study report FOLDER`"""
    read = flags.parse(ReportFlags, args, "tactilerl study report")
    flags.at_least("--resamples", read.resamples, 100)
    with _needs_extra("report"):
        import statsmodels  # noqa: F401

        from . import report as page
        from . import tables
        from .analysis import analyse
        from .statistics import FEW_RUNS
    analysis = analyse(*_load(read.study), read.resamples)
    out = read.out or (read.study if read.study.is_dir() else read.study.parent) / "report"
    try:
        path = page.write(analysis, out)
    except OSError as error:
        raise InputError(f"cannot write the report into {str(out)!r}: {error.strerror}") from error
    for warning in tables.warnings(analysis, FEW_RUNS):
        console.print(f"note: {warning}")
    console.print(f"{path} (tables and figures beside it)")
    return 0


@dataclass(frozen=True)
class PlanFlags:
    """Flags of `tactilerl study plan`."""

    study: tyro.conf.Positional[Path]
    """Folder of a pilot study, or the file that `collect` wrote."""
    effect: float = 0.05
    """Difference of success rates to detect."""
    power: float = 0.8
    """Probability of detecting it."""
    alpha: float = 0.05
    """Level of the test."""
    score: Literal["converged", "final", "area"] = "converged"
    """Of each run: its converged rate, the mean of its last tenth, or the area under its curve."""
    json: bool = False
    """Print JSON instead of a table."""


def plan(args: list[str]) -> int:
    """`tactilerl study plan FOLDER`"""
    read = flags.parse(PlanFlags, args, "tactilerl study plan")
    for name in ("effect", "power", "alpha"):
        if not 0 < getattr(read, name) < 1:
            raise InputError(f"--{name}: found {getattr(read, name)}, allowed between 0 and 1")
    with _needs_extra("plan"):
        import statsmodels  # noqa: F401

        from .analysis import analyse
        from .planning import plan as needs_of
    analysis = analyse(*_load(read.study), n_resamples=1000)
    needs = needs_of(analysis, read.effect, read.power, read.alpha, read.score)
    if not needs:
        raise InputError(f"{read.study}: no comparison with two or more finished runs to plan from")
    if read.json:
        print(json.dumps([dataclasses.asdict(need) for need in needs]))
        return 0
    title = f"Seeds per group for a difference of {read.effect:g} with power {read.power:g}"
    console.print(_plan_table(title, needs))
    return 0


def _plan_table(title: str, needs: list[Need]) -> Table:
    at = list(needs[0].power)
    caption = "at: power with so many seeds; test: power of the permutation test, simulated"
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("set-up", "cell", "runs", "sd", "seeds", "Holm", *(f"at {n}" for n in at), "test"):
        table.add_column(column, no_wrap=True)
    for need in needs:
        seeds = [str(n) if n else "–" for n in (need.seeds, need.seeds_holm)]
        powers = [f"{need.power[n]:.2f}" for n in at]
        row = [need.setup, need.cell, f"{need.runs[0]}/{need.runs[1]}", f"{need.sd:.3f}", *seeds]
        table.add_row(*row, *powers, f"{need.simulated:.2f}")
    return table


def _load(path: Path) -> tuple[grid.Study, list[Record]]:
    from . import records

    return records.load(path)


@contextmanager
def _needs_extra(part: str) -> Iterator[None]:
    """InputError naming the extra when a package of it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(
            f"study {part} needs {error.name}, which is not installed: pip install 'tactilerl[study]'"
        ) from error


PARTS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "run": (run, "run or continue the runs of a study file"),
    "status": (status, "done, running, failed, left, ETA"),
    "plan": (plan, "how many seeds an effect needs, from the spread of a pilot"),
    "collect": (collect, "pack all that a study has recorded into one file"),
    "report": (report, "tables, figures and report.html"),
}


def main(args: list[str]) -> int:
    """`tactilerl study PART`"""
    if not args or args[0] in ("-h", "--help"):
        lines = [f"  {name:9}{about}" for name, (_, about) in PARTS.items()]
        print("\n".join(["usage: tactilerl study PART [OPTIONS]", "", "parts:", *lines]))
        return 0 if args else 2
    if args[0] not in PARTS:
        raise InputError(f"study: found {args[0]!r}, allowed: {', '.join(PARTS)}")
    return PARTS[args[0]][0](args[1:])
