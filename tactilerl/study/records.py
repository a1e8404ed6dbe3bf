"""The records of a study: in its folder, or in the one file that `collect` packs.

study.json                what the runs are, as `Study.as_dict` has it
runs/NAME/                the run folder of `tactilerl train`: config.json, progress.csv, checkpoint.pt
runs/NAME.json            why the run failed, if it did
runs/NAME.log .lock       what it printed; held by the `study run` that trains it

A run is done when its table is as long as was asked for. So folders of runs can be copied from one
study to another, with rsync for example. A packed file has the JSON and CSV files of all runs.
"""

from __future__ import annotations

import io
import json
import math
import os
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from gzip import GzipFile
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import filelock
import numpy as np

from ..errors import InputError
from ..files import (
    LEFTOVER,
    MAX_RECORD,
    as_json,
    damage_named,
    read_whole,
    replacing,
    writable,
)
from ..runs.store import Row, RunDir, as_record, parse
from ..statistics import Array
from .grid import Run, Study, from_dict

State = Literal["done", "running", "failed", "interrupted", "left"]
STATES: tuple[State, ...] = get_args(State)
MAX_UNPACKED = 2 * 10**8  # bytes of all files in a packed one
STUDY, RUNS, PACKED = "study.json", "runs", "collected.tar.gz"
T = TypeVar("T")


@dataclass(frozen=True)
class Record:
    """The files that one run left behind, as far as they can be read."""

    run: Run
    state: State
    reason: str
    """The reason why it failed, or what cannot be read of it."""
    config: dict[str, Any]
    """config.json, without the run's folder; empty where there is none that can be read."""
    rows: list[Row]
    """The progress table, up to where it is cut off or damaged."""

    def column(self, name: str) -> Array:
        """Return a column of the progress table as numbers, NaN where there is none."""
        return np.array([float(row.get(name) or math.nan) for row in self.rows])

    @cached_property
    def curve(self) -> tuple[Array, Array]:
        """The steps and rates of the epochs that have a rate, a share of 1."""
        steps, rates = self.column("env_steps"), self.column(self.run.measure)
        known = (rates >= 0) & (rates <= 1)
        return steps[known], rates[known]

    @property
    def diverged(self) -> int:
        """The number of episodes that diverged."""
        columns = self.column("diverged"), self.column("test_diverged")
        return int(sum(map(np.nansum, columns)))

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
        self._packed = _unpacked(path) if is_file else None

    def read(self, name: str) -> bytes:
        """Return a file's content; raise FileNotFoundError where there is none."""
        if self._packed is None:
            return read_whole(self.path / name, MAX_RECORD)
        if name not in self._packed:
            raise FileNotFoundError(name)
        return self._packed[name]

    def study(self) -> Study:
        """Return the study that was run here last; raise InputError where there is none."""
        missing = f"{str(self.path)!r} is not a study's folder: no study.json in it"
        with damage_named(self.path / STUDY, "not a study of this version", missing):
            return from_dict(json.loads(self.read(STUDY)))

    def run_dir(self, run: Run) -> RunDir:
        """Return the folder of one of its runs."""
        return RunDir(self.path / RUNS / run.name)

    def beside(self, run: Run, ending: str) -> Path:
        """Return the path of a run's file that lies beside its folder."""
        return self.path / RUNS / f"{run.name}.{ending}"

    def record(self, run: Run) -> Record:
        """Read what there is of a run now."""
        name, problems = f"{RUNS}/{run.name}", list[str]()

        def parsed(file: str, parser: Callable[[bytes], T], nothing: T) -> T:
            try:
                with damage_named(Path(file)):
                    return parser(self.read(file))
            except FileNotFoundError:
                return nothing
            except InputError as error:
                problems.append(str(error))
                return nothing

        config = parsed(f"{name}/config.json", _config, dict[str, Any]())
        is_begun = bool(config or problems)
        table = f"{name}/progress.csv"
        rows = parsed(table, lambda data: parse(data.decode()), list[Row]())
        if rows and run.measure not in rows[0]:
            problems.append(f"{table}: found no column {run.measure}")
        failure = parsed(
            f"{name}.json", lambda data: str(json.loads(data)["reason"]), ""
        )
        planned = config.get("run", {}).get("total_timesteps")
        planned = run.flags.get("total_timesteps", planned)
        steps = int(rows[-1]["env_steps"]) if config and rows else -math.inf
        if isinstance(planned, int | float) and steps >= planned:
            return Record(run, "done", next(iter(problems), ""), config, rows)
        state: State = "interrupted" if is_begun else "left"
        if self._packed is None and self.is_running(run):
            state = "running"
        elif failure:
            state = "failed"
        reason = next(filter(None, [failure, *problems]), "")
        return Record(run, state, reason, config, rows)

    def is_running(self, run: Run) -> bool:
        """Return whether a process, here or elsewhere, trains it right now."""
        lock = self.run_dir(run).path / ".lock"
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
        """Record that a run failed, and why, without the folder of this machine."""
        for place in (self.path, self.path.resolve()):
            reason = reason.replace(f"{place / RUNS}{os.sep}", "")
        with replacing(self.beside(run, "json")) as file:
            file.write(as_json({"reason": reason}))

    def create(self, study: Study) -> None:
        """Make the folder, or write the study anew into one that it was run in."""
        names = {path.name for path in self.path.glob("*") if path.suffix != LEFTOVER}
        holds = study.name
        if names - {RUNS}:
            holds = self.study().name if STUDY in names else "no study"
        if holds != study.name:
            raise InputError(
                f"{str(self.path)!r} holds {holds}, not the study {study.name!r}; choose another "
                "with --out"
            )
        with writable(self.path):
            (self.path / RUNS).mkdir(parents=True, exist_ok=True)
        with replacing(self.path / STUDY) as file:
            file.write(as_json(study.as_dict()))


def _config(data: bytes) -> dict[str, Any]:
    config = as_record(json.loads(data))
    config["run"].pop("out", None)
    return config


def load(path: Path) -> tuple[Study, list[Record]]:
    """Return the study in a folder or a packed file, and all its runs in order of the grid."""
    files = StudyFiles(path)
    study = files.study()
    return study, [files.record(run) for run in study.runs()]


def collect(path: Path, out: Path | None = None) -> Path:
    """Pack the records of a study into one file, and return its path."""
    out = out or path / PACKED
    study, records = load(path)
    here, files = StudyFiles(path), {STUDY: as_json(study.as_dict())}
    for record in records:
        name = f"{RUNS}/{record.run.name}"
        if record.config:
            files[f"{name}/config.json"] = as_json(record.config)
        if record.rows:
            files[f"{name}/progress.csv"] = here.read(f"{name}/progress.csv")
        if record.state == "failed":
            files[f"{name}.json"] = as_json({"reason": record.reason})
    with (
        replacing(out) as file,
        GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return out


def _unpacked(path: Path) -> dict[str, bytes]:
    """Return the files in a packed file, by name; they are never written by that name."""
    with damage_named(path, "not a collected study of this version"):
        data, files = read_whole(path, MAX_UNPACKED, is_packed=True), {}
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            for entry in archive:
                if not 0 <= entry.size <= MAX_RECORD:  # below 0 it would never end
                    allowed = f"allowed 0 to {MAX_RECORD:,}"
                    raise ValueError(
                        f"{entry.name}: found {entry.size:,} bytes, {allowed}"
                    )
                if entry.type == tarfile.REGTYPE and not entry.issparse():
                    file = archive.extractfile(entry)
                    files[entry.name] = file.read() if file else b""
        if STUDY not in files:
            raise ValueError("no study.json in it")
        return files
