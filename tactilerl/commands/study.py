"""`tactilerl study`: many runs from one file, and what they say together."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from rich.table import Table

from ..errors import InputError, extra, input_errors
from ..files import pasted, require_new
from ..study import batch, grid, jobs, records
from ..study.records import Record, StudyFiles
from ..terminal import flags
from ..terminal.console import Progress, about, console


@dataclass(frozen=True)
class Run:
    """Run or continue the runs of a study file."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME. Runs already in it are continued."""
    on: str = "local"
    """Place where runs are trained: local; gpu, where runs that differ in layout,
    touch, seed or numbers of the learner are one batch (extra: gpu); dask:ADDRESS, the
    workers of a scheduler of Dask (extra: cluster); or dask-gpu:ADDRESS, workers that
    each train batches on a GPU.
    """
    jobs: Annotated[int, "[1, inf)"] | None = None
    """Runs trained side by side; default: one per core. With gpu: batches; default: 6.
    Dask's workers train one each."""
    ranks_per_run: Annotated[int, "[1, inf)"] = 1
    """Processes per run (for DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try failed runs again."""

    def __call__(self) -> int:
        """Run `tactilerl study run FILE`."""
        study = grid.read(self.study)
        files = StudyFiles(self.out or Path("studies") / study.name)
        runs, is_gpu = study.runs(), jobs.is_gpu(self.on)
        console.print(
            f"study {study.name}: {len(runs)} runs; checking that each can start"
        )
        if self.on == jobs.GPU:
            batch.require_device()
        jobs.check(files, runs)
        if is_gpu:
            batches, others = batch.form(runs)
            if not batches:
                run, reason = others[0]
                raise InputError(
                    f"--on {self.on}: found no run for it ({run.name}: {reason}); leave out --on"
                )
            for run, reason in others:
                console.print(f"not on a GPU: {run.name}: {reason}")
            runs = [run for one in batches for run in one]
        with jobs.executor(self.on, self.jobs, self.ranks_per_run) as pool:
            files.create(study)
            if self.retry_failed:
                for run in runs:
                    files.beside(run, "json").unlink(missing_ok=True)
            todo = [run for run in runs if not files.record(run).has_ended]
            console.print(
                f"study {study.name}: {len(runs)} runs, {len(todo)} to do, in {files.path}"
            )
            n_ended, folder = itertools.count(1), files.path.absolute()
            tick = Progress("runs", len(todo))

            def show(run: grid.Run) -> None:
                record = files.record(run)
                text = f"[{next(n_ended)}/{len(todo)}] {run.name} {record.state} "
                console.print(text + about(record.seconds))
                tick()

            alone = [(run,) for run in todo]
            together = batch.form(todo)[0] if is_gpu else alone
            job = partial(jobs.Job, folder, ranks=self.ranks_per_run, is_batch=is_gpu)
            jobs.run_all(map(job, together), pool, show)
        ended = [files.record(run) for run in runs]
        _print_failures(ended)
        n = Counter(record.state for record in ended)
        if n["running"]:
            console.print(f"{n['running']} runs are trained by another `study run`")
        if n_interrupted := n["interrupted"] + n["left"]:
            console.print(
                f"interrupted: {n_interrupted}; run the same command to go on"
            )
        console.print(f"  tactilerl study report {pasted(files.path)}")
        return 1 if n["failed"] or n_interrupted else 0


def _print_failures(all_records: Iterable[Record]) -> None:
    """Print every run that failed, and why."""
    for record in all_records:
        if record.state == "failed":
            console.print(f"failed: {record.run.name}: {record.reason}")


@dataclass(frozen=True)
class Train:
    """Train one run of a study, or several as a batch, or continue them, as `study run` does."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    run: tyro.conf.Positional[tuple[str, ...]]
    """Name of the run, or names of all runs of a batch."""
    batch: bool = False
    """Train the runs as a batch, on a GPU (extra: gpu), instead of one by one."""

    def __call__(self) -> int:
        """Run `tactilerl study train FOLDER RUN`."""
        from ..algos import mpi
        from ..runs.training import train

        if not self.run:
            raise InputError("run: found none, allowed one name or more")
        files = StudyFiles(self.folder)
        runs = {run.name: run for run in files.study().runs()}
        for name in self.run:
            if name not in runs:
                raise InputError(f"{self.folder}: found no run {name!r} in it")
        if self.batch:
            return batch.train(files, [runs[name] for name in self.run])
        for name in self.run:
            out = {"out": str(files.run_dir(runs[name]).path)}
            train(runs[name].config().choose(out), mpi.world(), f"study train: {name}")
        return 0


@dataclass(frozen=True)
class Status:
    """Count runs that are done, running, failed and left."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""

    def __call__(self) -> None:
        """Run `tactilerl study status FOLDER`."""
        study, all_records = records.load(self.folder)
        table = Table("set-up", *records.STATES, title=f"study {study.name}")
        for setup in study.setups:
            n = Counter(r.state for r in all_records if r.run.setup == setup.name)
            table.add_row(setup.name, *(str(n[state]) for state in records.STATES))
        console.print(table)
        _print_failures(all_records)


@dataclass(frozen=True)
class Collect:
    """Pack the records of a study into one file."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """File to write; default: collected.tar.gz in FOLDER."""
    overwrite: bool = False
    """Replace that file where it is there."""

    def __call__(self) -> None:
        """Run `tactilerl study collect FOLDER`."""
        out = self.out or self.folder / records.PACKED
        require_new(out, self.overwrite)
        records.collect(self.folder, out)
        console.print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


@dataclass(frozen=True)
class Report:
    """Write report.html, with its tables and figures as files."""

    study: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    out: Path | None = None
    """Folder for the report; default: report/ beside the runs or the collected file."""
    overwrite: bool = False
    """Replace an earlier report there."""

    def __call__(self) -> None:
        """Run `tactilerl study report FOLDER`."""
        with extra("study"):
            from ..study import analysis, report
        result = analysis.analyse(*records.load(self.study))
        beside = self.study if os.path.isdir(self.study) else self.study.parent
        out = self.out or beside / "report"
        require_new(out, self.overwrite)
        with input_errors(f"cannot write the report into {str(out)!r}"):
            path = report.write(result, out)
        for sentence in report.answers(result):
            console.print(sentence)
        for warning in report.warnings(result):
            console.print(f"note: {warning}")
        console.print(f"{path} (tables and figures beside it)")


KINDS = (Run, Train, Status, Collect, Report)
PARTS = {kind.__name__.lower(): kind for kind in KINDS}


def main(args: list[str]) -> int:
    """Run `tactilerl study PART`; return its exit code."""
    kind: Any = Union[KINDS]  # noqa: UP007
    part = flags.parse(kind, args, "tactilerl study", __doc__)
    code: int = part() or 0
    return code
