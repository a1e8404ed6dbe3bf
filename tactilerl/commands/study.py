"""`tactilerl study`: many runs from one file, and what they say together."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from rich import box
from rich.table import Table

from ..errors import InputError, extra
from ..files import pasted
from ..machine import free_cores
from ..study import executors, grid, jobs, records
from ..study.jobs import Job
from ..study.records import Record, StudyFiles
from ..terminal import flags
from ..terminal.console import console
from ..terminal.progress_bar import duration


@dataclass(frozen=True)
class Run:
    """Run or continue the runs of a study file."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME. Runs already in it are continued."""
    on: str = "local"
    """Where runs are trained: local; dask:ADDRESS of a scheduler; or slurm, pbs, lsf, sge or htcondor
    (extra: cluster)."""
    jobs: Annotated[int, "[1, inf)"] | None = None
    """Runs trained side by side; default: one per core. With a batch system: jobs to submit."""
    walltime: str | None = None
    """Time limit of a job of a batch system, as it wants it; default: dask-jobqueue's."""
    memory: str | None = None
    """Memory of a job of a batch system; default: dask-jobqueue's, or 3GB."""
    ranks_per_run: Annotated[int, "[1, inf)"] = 1
    """Processes per run (for DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try failed runs again."""

    def __call__(self) -> int:
        """Run `tactilerl study run FILE`."""
        where = self.on, self.jobs, self.ranks_per_run, self.walltime, self.memory
        with executors.start(*where) as (pool, parallel):
            study = grid.read(self.study)
            files = StudyFiles(self.out or Path("studies") / study.name)
            runs = study.runs()
            console.print(f"study {study.name}: checking {len(runs)} runs")
            found = {run.name: files.record(run) for run in runs}
            jobs.check(found.values())
            files.create(study)
            for name, record in found.items():
                if record.state == "failed" and self.retry_failed:
                    files.beside(record.run, "json").unlink(missing_ok=True)
                    found[name] = files.record(record.run)
            todo = [
                Job(files.path.absolute(), one.run, self.ranks_per_run, Path.cwd())
                for one in found.values()
                if not one.has_ended
            ]
            counted = f"{len(runs)} runs, {len(todo)} to do"
            console.print(f"study {study.name}: {counted}, in {files.path}")
            busy = []

            def show(job: Job, ending: jobs.Ending) -> None:
                if ending == "busy":
                    busy.append(job)
                record = found[job.run.name] = files.record(job.run)
                n_ended = sum(one.has_ended for one in found.values())
                left = duration(records.seconds_left(found.values(), parallel))
                console.print(
                    f"[{n_ended}/{len(runs)}] {job.run.name} {record.state} "
                    f"{duration(record.seconds)}  ETA {left}"
                )

            jobs.run_all(todo, pool, show)
            n_failed = _print_failures(found.values())
            if busy:
                console.print(f"{len(busy)} runs are trained by another `study run`")
            console.print(f"  tactilerl study report {pasted(files.path)}")
            return 1 if n_failed else 0


def _json(value: Any) -> str:
    """Return JSON, in which numbers that are not finite are null."""
    return json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None))


def _print_failures(found: Iterable[Record]) -> int:
    """Print every run that failed, and why; return how many."""
    failed = [record for record in found if record.state == "failed"]
    for record in failed:
        console.print(f"failed: {record.run.name}: {record.reason}")
    return len(failed)


@dataclass(frozen=True)
class Todo:
    """Print a command for each run that is not done, for job arrays."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME."""

    def __call__(self) -> None:
        """Run `tactilerl study todo FILE`."""
        study = grid.read(self.study)
        files = StudyFiles(self.out or Path("studies") / study.name)
        found = [files.record(run) for run in study.runs()]
        jobs.check(found)
        files.create(study)
        for record in found:
            if record.state != "done":
                arguments = Job(files.path, record.run).arguments
                print(shlex.join(["tactilerl", *arguments]))


@dataclass(frozen=True)
class Train:
    """Train one run of a study, or continue it, as `todo` says."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    run: tyro.conf.Positional[str]
    """Name of the run."""

    def __call__(self) -> None:
        """Run `tactilerl study train FOLDER RUN`."""
        from ..algos import mpi
        from ..runs.training import train

        files = StudyFiles(self.folder)
        runs = {run.name: run for run in files.study().runs()}
        if self.run not in runs:
            raise InputError(f"{self.folder}: found no run {self.run!r} in it")
        run = runs[self.run]
        out = {"out": str(files.run_dir(run).path)}
        train(run.config().choose(out), mpi.world(), f"study train: {run.name}")


@dataclass(frozen=True)
class Status:
    """Count runs that are done, running, failed and left."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> None:
        """Run `tactilerl study status FOLDER`."""
        study, found = records.load(self.folder)
        counts = records.counts(found)
        left = records.seconds_left(found, counts["running"] or free_cores())
        if self.json:
            states = {
                one.run.name: {
                    "state": one.state,
                    "fraction": one.fraction,
                    "seconds": one.seconds,
                }
                for one in found
            }
            result = {"study": study.name, "runs": len(states), **counts}
            print(_json({**result, "eta_s": left, "states": states}))
            return
        table = Table("set-up", *counts, title=f"study {study.name}, {len(found)} runs")
        for setup in study.setups:
            of_setup = [one for one in found if one.run.setup == setup.name]
            table.add_row(setup.name, *map(str, records.counts(of_setup).values()))
        console.print(table)
        is_over = all(one.has_ended for one in found)
        console.print("nothing left to do" if is_over else f"ETA {duration(left)}")
        _print_failures(found)


@dataclass(frozen=True)
class Compare:
    """Compare two studies of the same groups, such as of other code, pairing runs by seed."""

    a: tyro.conf.Positional[Path]
    """Folder of a study or a collected file."""
    b: tyro.conf.Positional[Path]
    """The study to compare A with."""
    score: grid.Score = "area"
    """area: mean success over the run; final: over its last tenth; converged: the converged rate."""

    def __call__(self) -> None:
        """Run `tactilerl study compare A B`."""
        with extra("study"):
            from ..study import pairs
        (_, a), (_, b) = records.load(self.a), records.load(self.b)
        title = f"{self.a} − {self.b}: {self.score}"
        table = Table(title=title, box=box.SIMPLE_HEAD, padding=0)
        for column in ("", "steps", "pairs", "difference", "p", "p, Holm"):
            table.add_column(column, no_wrap=bool(column), overflow="fold")
        for row in pairs.compare(a, b, self.score):
            value, low, high = row.pairs.difference
            table.add_row(
                row.place,
                f"{row.until:,.0f}",
                str(len(row.pairs)),
                f"{value:+.3f} ({low:+.3f} to {high:+.3f})",
                f"{row.pairs.p_value:.3f}",
                f"{row.p_holm:.3f}",
            )
        console.print(table)
        differing = pairs.differing(a, b)
        console.print(f"they differ in: {'; '.join(differing) or 'nothing'}")


@dataclass(frozen=True)
class Collect:
    """Pack the records of a study into one file."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """File to write; default: collected.tar.gz in FOLDER."""

    def __call__(self) -> None:
        """Run `tactilerl study collect FOLDER`."""
        path = records.collect(self.folder, self.out)
        console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


@dataclass(frozen=True)
class Report:
    """Write report.html, with its tables and figures as files."""

    study: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    out: Path | None = None
    """Folder for the report; default: report/ beside the runs or the collected file."""
    resamples: Annotated[int, "[100, 1e6]"] = 50_000
    """Resamples of every bootstrap and permutation test; fewer are faster and less exact."""

    def __call__(self) -> None:
        """Run `tactilerl study report FOLDER`."""
        with extra("study"):
            from ..study import analysis, report, summary
        result = analysis.analyse(*records.load(self.study), self.resamples)
        beside = self.study if os.path.isdir(self.study) else self.study.parent
        out = self.out or beside / "report"
        try:
            path = report.write(result, out)
        except OSError as error:
            where = f"cannot write the report into {str(out)!r}"
            raise InputError(f"{where}: {error.strerror}") from error
        for sentence in summary.answers(result):
            console.print(sentence)
        for warning in summary.warnings(result):
            console.print(f"note: {warning}")
        console.print(f"{path} (tables and figures beside it)")


KINDS = (Run, Todo, Train, Status, Compare, Collect, Report)
PARTS = {kind.__name__.lower(): kind for kind in KINDS}


def main(args: list[str]) -> int:
    """Run `tactilerl study PART`; return its exit code."""
    kind: Any = Union[KINDS]  # noqa: UP007
    part = flags.parse(kind, args, "tactilerl study", __doc__)
    code: int = part() or 0
    return code
