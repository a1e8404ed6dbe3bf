"""The records of a study: in its folder, or in the one file that `collect` packs.

    study.json           what the runs are, as `Study.as_dict` has it
    runs/NAME/           the run folder of `tactilerl train`
    runs/NAME.json       why the run failed, if it did
    runs/NAME.log        what it printed
    runs/NAME.lock       held by the `study run` that trains it

A run is done when its table is as long as was asked for, and its checkpoint, where
there is one, is that of the table's last row. So folders of runs can be copied from one
study to another, with rsync for example. A packed file has the JSON and CSV files of
all runs.
"""

from __future__ import annotations

import io
import json
import math
import os
import tarfile
from dataclasses import dataclass
from functools import cached_property
from gzip import GzipFile
from pathlib import Path
from typing import Any, Literal, get_args

import filelock
import numpy as np

from ..errors import InputError
from ..files import as_json, damage_named, replacing, writable
from ..runs.store import Row, RunDir, parse
from ..statistics import Array
from .grid import Run, Study, from_dict

State = Literal["done", "failed", "running", "interrupted", "left"]
STATES: tuple[State, ...] = get_args(State)
STUDY, RUNS, PACKED = "study.json", "runs", "collected.tar.gz"


@dataclass(frozen=True)
class Record:
    """The files that one run left behind, as far as they can be read."""

    run: Run
    state: State
    reason: str
    """The reason why it failed, or what cannot be read of it."""
    config: dict[str, Any]
    """config.json, without the run's folder; empty where there is none that can be
    read."""
    rows: list[Row]
    """The progress table."""

    def column(self, name: str) -> Array:
        """Return a column of the progress table as numbers, NaN where there is none."""
        return np.array([row.get(name, math.nan) for row in self.rows])

    @cached_property
    def curve(self) -> tuple[Array, Array]:
        """The steps and rates of the epochs that have a rate."""
        steps, rates = self.column("env_steps"), self.column(self.run.measure)
        known = ~np.isnan(rates)
        return steps[known], rates[known]

    @property
    def is_finished(self) -> bool:
        """True if the run is done and has a curve."""
        return self.state == "done" and len(self.curve[0]) > 0

    @property
    def has_ended(self) -> bool:
        """True if the run is done or failed; it then goes on only when somebody asks for it."""
        return self.state in ("done", "failed")

    @property
    def seconds(self) -> float:
        """The seconds spent in collecting and updating."""
        columns = self.column("collect_s"), self.column("update_s")
        return float(sum(map(np.nansum, columns)))


class StudyFiles:
    """The files of a study: a folder, or a packed file."""

    def __init__(self, path: Path) -> None:
        """Read a packed file at `path`; of a folder nothing is read yet."""
        self.path = path
        is_file = os.path.isfile(path)  # False for any name
        if is_file and path.suffix == ".toml":
            raise InputError(f"{path}: a study file, allowed the folder of its runs")
        self._packed = _unpacked(path) if is_file else None

    def read(self, name: str) -> bytes:
        """Return a file's content, nothing where there is none."""
        if self._packed is not None:
            return self._packed.get(name, b"")
        try:
            return (self.path / name).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return b""

    def study(self) -> Study:
        """Return the study that was run here last; raise InputError where there is none."""
        with damage_named(self.path / STUDY, "not a study of this version"):
            if data := self.read(STUDY):
                return from_dict(json.loads(data))
        raise InputError(
            f"{str(self.path)!r} is not a study's folder: no study.json in it"
        )

    def run_dir(self, run: Run) -> RunDir:
        """Return the folder of one of its runs."""
        return RunDir(self.path / RUNS / run.name)

    def beside(self, run: Run, ending: str) -> Path:
        """Return the path of a run's file that lies beside its folder."""
        return self.path / RUNS / f"{run.name}.{ending}"

    def record(self, run: Run) -> Record:
        """Read what there is of a run now."""
        name, config, rows = f"{RUNS}/{run.name}", dict[str, Any](), list[Row]()
        is_done, failure, problem = False, "", ""
        try:
            with damage_named(Path(name)):
                if told := self.read(f"{name}.json"):
                    failure = json.loads(told)["reason"]
                if saved := self.read(f"{name}/config.json"):
                    config = json.loads(saved)
                    config["run"].pop("out", None)
                    rows = parse(self.read(f"{name}/progress.csv").decode())
                    planned = config["run"]["total_timesteps"]
                    planned = run.flags.get("total_timesteps", planned)
                    is_done = bool(rows) and rows[-1]["env_steps"] >= planned
                    is_done = is_done and self._is_saved(run, rows[-1]["epoch"])
        except InputError as error:
            problem = str(error)
        state: State = "interrupted" if config or problem else "left"
        if is_done:
            state, failure = "done", ""
        elif failure:
            state = "failed"
        elif self._is_running(run):
            state = "running"
        return Record(run, state, failure or problem, config, rows)

    def _is_saved(self, run: Run, epoch: float) -> bool:
        """Return whether the checkpoint, where there is one, is that of the table's last epoch.

        A run may be cut off after it has written to its table, and before its
        checkpoint.
        """
        run_dir = self.run_dir(run)
        try:
            saved = run_dir.checkpoint_file.stat().st_mtime_ns
            if saved >= run_dir.table.stat().st_mtime_ns:
                return True
        except OSError:  # a packed study, or records that came without
            return True
        return bool(run_dir.read_checkpoint()["epoch"] >= epoch)

    def _is_running(self, run: Run) -> bool:
        """Return whether a `study run`, here or elsewhere, trains it right now."""
        lock = self.beside(run, "lock")
        if not lock.exists():
            return False
        try:
            with filelock.FileLock(lock, timeout=0):
                return False
        except filelock.Timeout:
            return True
        except OSError:  # nobody can train it in a folder that nobody can write to
            return False

    def write_failure(self, run: Run, reason: str) -> None:
        """Record that a run failed, and why."""
        with replacing(self.beside(run, "json")) as file:
            file.write(as_json({"reason": reason}))

    def create(self, study: Study) -> None:
        """Make the folder, or write the study anew into one that it was run in."""
        # Another process may be making it, too: with a hidden file, and the folder of
        # runs first.
        names = {path.name for path in self.path.glob("[!.]*")} - {RUNS}
        holds = self.study().name if STUDY in names else "no study"
        if names and holds != study.name:
            raise InputError(
                f"{str(self.path)!r} holds {holds}, not the study {study.name!r}; choose another "
                "with --out"
            )
        with writable(self.path):
            (self.path / RUNS).mkdir(parents=True, exist_ok=True)
        with replacing(self.path / STUDY) as file:
            file.write(as_json(study.as_dict()))


def load(path: Path) -> tuple[Study, list[Record]]:
    """Return the study in a folder or a packed file, and all its runs in order of the grid."""
    files = StudyFiles(path)
    study = files.study()
    return study, [files.record(run) for run in study.runs()]


def collect(path: Path, out: Path) -> None:
    """Pack the records of a study into one file."""
    here, (study, records) = StudyFiles(path), load(path)
    files = {STUDY: as_json(study.as_dict())}
    for record in records:
        name = f"{RUNS}/{record.run.name}"
        if record.config:
            files[f"{name}/config.json"] = as_json(record.config)
        for kept in (f"{name}/progress.csv", f"{name}.json"):
            if data := here.read(kept):
                files[kept] = data
    with (
        replacing(out) as file,
        GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))


def _unpacked(path: Path) -> dict[str, bytes]:
    """Return the files in a packed file, by name; they are never written by that name."""
    with (
        damage_named(path, "not a collected study of this version"),
        tarfile.open(path) as archive,
    ):
        opened = {entry.name: archive.extractfile(entry) for entry in archive}
        return {name: file.read() for name, file in opened.items() if file}
