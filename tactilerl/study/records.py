"""What a study has recorded: in its folder, or in the one file that `collect` packs.

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
from collections.abc import Callable, Mapping
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
    MAX_JSON,
    content,
    damage_named,
    replacing,
    unzip,
    writable,
)
from ..runs.config import PARTS
from ..runs.store import Row, RunDir, as_record, parse
from ..statistics import Array
from .grid import Run, Study, from_dict, read

State = Literal["done", "running", "failed", "interrupted", "left"]
STATES: tuple[State, ...] = get_args(State)
UNTOLD = ("seed", "workers", "threads", "tensorboard")
"""Settings that tell nobody what was compared."""
STUDY, RUNS, PACKED = "study.json", "runs", "collected.tar.gz"
T = TypeVar("T")


@dataclass(frozen=True)
class Record:
    """What one run left behind."""

    run: Run
    state: State
    reason: str
    """Why it failed, or what cannot be read of it."""
    config: dict[str, Any] | None
    """config.json, without the folder of the machine that it was made on; None where there is none
    that can be read."""
    rows: list[Row]
    """The progress table, up to where it is cut off or damaged."""

    def column(self, name: str) -> Array:
        """A column of the progress table as numbers; NaN where there is none."""
        return np.array([float(row.get(name) or math.nan) for row in self.rows])

    @cached_property
    def curve(self) -> tuple[Array, Array]:
        """(steps, rates) of the epochs that have a rate."""
        steps, rates = self.column("env_steps"), self.column(self.run.measure)
        known = np.isfinite(steps) & np.isfinite(rates)
        return steps[known], rates[known]

    @property
    def diverged(self) -> int:
        """Episodes that diverged."""
        return int(
            sum(np.nansum(self.column(name)) for name in ("diverged", "test_diverged"))
        )

    @property
    def is_finished(self) -> bool:
        """Is it done, and has it a curve?"""
        return self.state == "done" and len(self.curve[0]) > 0

    @property
    def has_ended(self) -> bool:
        """Will there be no more of it, unless somebody asks for it?"""
        return self.state in ("done", "failed")

    @property
    def fraction(self) -> float:
        """Of its steps."""
        done = int(self.rows[-1]["env_steps"]) if self.rows else 0
        return min(1.0, done / _asked(self.run, self.config)) if self.config else 0.0

    @property
    def seconds(self) -> float:
        """Spent in epochs, without starting and saving."""
        seconds, steps = 0.0, 0
        for row in self.rows:
            now, speed = int(row["env_steps"]), float(row.get("steps_per_s") or 0)
            seconds, steps = (
                seconds + ((now - steps) / speed if speed > 0 else 0.0),
                now,
            )
        return seconds


def _asked(run: Run, config: dict[str, Any]) -> float:
    """Steps that a run should have: the study's, or if it says nothing, those that it was made for."""
    try:
        return max(
            1,
            int(run.flags.get("total_timesteps", config["run"].get("total_timesteps"))),
        )
    except (TypeError, ValueError, OverflowError):
        return math.inf


def settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Every value of a config.json by its flag."""
    return {
        flag: value
        for name in PARTS
        for flag, value in (config.get(name) or {}).items()
    }


class StudyFiles:
    """The files of a study: a folder, or a packed file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._packed = (
            _unpacked(path) if os.path.isfile(path) else None
        )  # False for any name

    def read(self, name: str) -> bytes:
        """A file's content; FileNotFoundError where there is none."""
        if self._packed is None:
            return content(self.path / name)
        if name not in self._packed:
            raise FileNotFoundError(name)
        return self._packed[name]

    def study(self) -> Study:
        """The study that was run here last; InputError where there is none."""
        missing = f"{str(self.path)!r} is not a study's folder: no study.json in it"
        with damage_named(self.path / STUDY, "not a study of this version", missing):
            data = self.read(STUDY)
            if len(data) > MAX_JSON:
                raise ValueError(f"it has more than {MAX_JSON:,} bytes")
            return from_dict(json.loads(data))

    def run_dir(self, run: Run) -> RunDir:
        """The folder of one of its runs."""
        return RunDir(self.path / RUNS / run.name)

    def beside(self, run: Run, ending: str) -> Path:
        """A file of a run that lies beside its folder."""
        return self.path / RUNS / f"{run.name}.{ending}"

    def record(self, run: Run) -> Record:
        """What there is of a run now."""
        name, nothing = f"{RUNS}/{run.name}", (list[Row](), "")
        config, unread = self._parsed(f"{name}/config.json", _config, None)
        table = f"{name}/progress.csv"
        (rows, cut), damaged = self._parsed(
            table, lambda data: parse(data.decode()), nothing
        )
        failure, _ = self._parsed(f"{name}.json", _failure, "")
        done = Record(run, "done", "", config, rows)
        if done.fraction == 1:
            return done
        state: State = "interrupted" if config or unread else "left"
        if self._packed is None and self.is_running(run):
            state = "running"
        elif failure:
            state = "failed"
            for place in (self.path, self.path.resolve()):
                failure = failure.replace(f"{place / RUNS}{os.sep}", "")
        return Record(run, state, failure or unread or damaged or cut, config, rows)

    def _parsed(
        self, name: str, parse: Callable[[bytes], T], nothing: T
    ) -> tuple[T, str]:
        """What a file says, or `nothing`; and why not, where it is there."""
        try:
            with damage_named(Path(name)):
                return parse(self.read(name)), ""
        except FileNotFoundError:
            return nothing, ""
        except InputError as error:
            return nothing, str(error)

    def is_running(self, run: Run) -> bool:
        """Does a process, here or elsewhere, train it right now?"""
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
        """Record that a run failed, and why."""
        with replacing(self.beside(run, "json")) as file:
            file.write(_failed(reason))

    def create(self, study: Study) -> None:
        """Make the folder, or write the study anew into one that it was run in."""
        with writable(self.path):
            names = (
                {p.name for p in self.path.iterdir()} if self.path.exists() else set()
            )
        if STUDY in names and (other := self.study().name) != study.name:
            raise InputError(
                f"{str(self.path)!r} holds the study {other!r}, not {study.name!r}; choose another "
                "with --out"
            )
        if STUDY not in names and not all(
            LEFTOVER.fullmatch(one) or one == RUNS for one in names
        ):
            raise InputError(
                f"{str(self.path)!r} exists and holds no study; choose another with --out"
            )
        with writable(self.path):
            (self.path / RUNS).mkdir(parents=True, exist_ok=True)
        with replacing(self.path / STUDY) as file:
            file.write(_study(study))


def _config(data: bytes) -> dict[str, Any]:
    config = as_record(json.loads(data[: MAX_JSON + 1]))
    config["run"].pop("out", None)
    return config


def _failure(data: bytes) -> str:
    """Why a run failed. Version 0.3.0 wrote such a file of every run, with its state."""
    found = json.loads(data[: MAX_JSON + 1])
    return str(found["reason"]) or "failed" if found["state"] == "failed" else ""


def _failed(reason: str) -> bytes:
    return (json.dumps({"state": "failed", "reason": reason}) + "\n").encode()


def _study(study: Study) -> bytes:
    return (json.dumps(study.as_dict(), indent=1) + "\n").encode()


def load(path: Path) -> tuple[Study, list[Record]]:
    """The study in a folder or a packed file, and all its runs in order of the grid."""
    if path.suffix == ".toml":
        folder = f"studies/{read(path).name}"
        raise InputError(
            f"{path}: found a study file, expected the study's folder, such as {folder}"
        )
    files = StudyFiles(path)
    study = files.study()
    return study, [files.record(run) for run in study.runs()]


def collect(path: Path, out: Path | None = None) -> Path:
    """Pack what there is of a study into one file; returns it."""
    out = out or path / PACKED
    study, records = load(path)
    here, files = StudyFiles(path), {STUDY: _study(study)}
    for record in records:
        name = f"{RUNS}/{record.run.name}"
        if record.config is not None:
            files[f"{name}/config.json"] = json.dumps(record.config).encode()
        if record.rows:
            files[f"{name}/progress.csv"] = here.read(f"{name}/progress.csv")
        if record.state == "failed":
            files[f"{name}.json"] = _failed(record.reason)
    with (
        replacing(out, _unpacked) as file,
        GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return out


def _unpacked(path: Path) -> dict[str, bytes]:
    """The files in a packed file, by name. They are never written anywhere by that name."""
    with damage_named(path, "not a collected study"):
        data, found = unzip(path), {}
        if data.startswith(b"run,state,"):
            raise ValueError(
                "of version 0.3: tools/convert_collected.py makes one of this version"
            )
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            for entry in archive:
                if entry.type == tarfile.REGTYPE and not entry.issparse():
                    file = archive.extractfile(entry)
                    found[entry.name] = file.read() if file else b""
        if STUDY not in found:
            raise ValueError("no study.json in it")
        return found
