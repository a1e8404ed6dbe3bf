"""The command `tactilerl study`: its flags, and what each of its parts does."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from .. import flags
from ..errors import InputError
from . import display, grid
from .folder import StudyFolder

console = Console(highlight=False, soft_wrap=True, markup=False)
PARTS = {
    "run": "run a study file's runs, or go on with them",
    "status": "done, running, failed, left, ETA",
    "plan": "how many seeds an effect needs, from the spread of a pilot",
    "collect": "pack all that a study has recorded into one file",
    "report": "tables, figures and report.html",
}


def study(args: list[str]) -> int:
    """`tactilerl study PART`"""
    if not args or args[0] in ("-h", "--help"):
        lines = [f"  {name:9}{about}" for name, about in PARTS.items()]
        print("\n".join(["usage: tactilerl study PART [OPTIONS]", "", "parts:", *lines]))
        return 0 if args else 2
    if args[0] not in PARTS:
        raise InputError(f"study: found {args[0]!r}, allowed: {', '.join(PARTS)}")
    part: Callable[[list[str]], int] = globals()[args[0]]
    return part(args[1:])


@dataclass(frozen=True)
class RunFlags:
    """Flags of `tactilerl study run`."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; the default is studies/NAME. Runs that are in it go on."""
    jobs: int | None = None
    """Runs side by side on this machine; default: one per core. Under mpirun, its other ranks."""
    ranks_per_run: int = 1
    """Processes of each run (DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try again what failed earlier."""


def run(args: list[str]) -> int:
    """`tactilerl study run FILE`"""
    read = flags.parse(RunFlags, args, "tactilerl study run")
    from . import runner

    for flag, value in (("--jobs", read.jobs), ("--ranks-per-run", read.ranks_per_run)):
        if value is not None and value < 1:
            raise InputError(f"{flag}: found {value}, allowed 1 or more")
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
    configs = check.configure(runs)
    damaged = check.find_damage(runs, configs, folder)
    check.start(runs, configs, folder)
    folder.create(study)
    jobs = []
    for one in runs:
        files, total = folder.files(one), configs[one.name].run.total_timesteps
        if read.retry_failed and (before := files.outcome()) and before.state == "failed":
            files.outcome_file.unlink()
        if one.name in damaged:
            console.print(f"{one.name}: {damaged[one.name]}; mend or remove it, then --retry-failed")
            files.write_outcome(Outcome("failed", total, damaged[one.name]))
        outcome = files.outcome()
        if outcome is None or (outcome.state == "done" and outcome.total_timesteps < total):
            jobs.append(runner.Job(files.base, check.arguments(one), total, read.ranks_per_run))
    overview = display.Overview(folder, runs)
    title = f"study {study.name}"
    console.print(f"{title}: {len(runs)} runs, {len(jobs)} to do, in {folder.path}")
    with display.Watch(overview, getattr(pool, "num_workers", parallel), title) as watch:
        endings = runner.run_all(jobs, pool, watch)
    return _closing(folder, runs, list(endings.values()).count("busy"))


def _closing(folder: StudyFolder, runs: list[grid.Run], elsewhere: int) -> int:
    failed = {}
    for one in runs:
        outcome = folder.files(one).outcome()
        if outcome is not None and outcome.state == "failed":
            failed[one.name] = outcome.reason
    for name, reason in failed.items():
        console.print(f"failed: {name}: {reason}")
    if elsewhere:
        console.print(f"{elsewhere} runs are trained by another `study run`")
    console.print(f"  tactilerl study report {folder.path}")
    return 1 if failed else 0


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
    is_over = not any(overview.counts()[state] for state in ("running", "interrupted", "left"))
    console.print("nothing left to do" if is_over else f"ETA {display.duration(eta)}")
    for one in overview.runs:
        outcome = folder.files(one).outcome()
        if outcome is not None and outcome.state == "failed":
            console.print(f"failed: {one.name}: {outcome.reason}")
    return 0
