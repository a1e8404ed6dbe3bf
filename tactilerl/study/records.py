"""What a study has recorded, from its run folders or from the one file that `collect` makes of
them.

The collected file is a compressed CSV. Its first row is the study itself: no run, and study.json as
its `record`. Then come the epochs of every run, at least one row a run:

    run       name of the run
    state     done, failed, running, interrupted or left, when it was collected
    reason    why it failed
    record    on a run's first row: its config.json (all values, versions, commit, ranks), but where
              it was written
    ...       the columns of progress.csv, word for word; empty where a run has none
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..runs.files import damage_named, replacing, unzip
from ..runs.progress_csv import whole
from ..runs.run_dir import require_record
from ..statistics import Array
from .folder import STATES, RunFiles, StudyFolder, seconds_spent
from .grid import Run, Study, from_dict, read

COLLECTED = "collected.csv.gz"
FIXED = ("run", "state", "reason", "record")


@dataclass(frozen=True)
class Record:
    """What one run left behind."""

    run: Run
    state: str
    reason: str
    config: dict[str, Any] | None
    """config.json; None where there is none that can be read."""
    rows: list[dict[str, str]]
    """The progress table."""

    def column(self, name: str) -> Array:
        """A column of the progress table as numbers; NaN where there is none."""
        return np.array([float(row.get(name) or math.nan) for row in self.rows])

    def curve(self, measure: str) -> tuple[Array, Array]:
        """(steps, rates) of the epochs that have a rate."""
        steps, rates = self.column("env_steps"), self.column(measure)
        known = np.isfinite(steps) & np.isfinite(rates)
        return steps[known], rates[known]

    @property
    def has_ended(self) -> bool:
        """Will there be no more of it, unless somebody asks for it?"""
        return self.state in ("done", "failed")

    @property
    def progress(self) -> tuple[bool, bool, int]:
        """Orders records of one run by how far they are."""
        return self.state == "done", self.state == "failed", len(self.rows)

    @property
    def results(self) -> tuple[Any, ...]:
        """What it was made with and what came out; a column of other runs is none of it."""
        return self.config, [{k: v for k, v in row.items() if v} for row in self.rows]

    @property
    def seconds(self) -> float:
        """Spent in epochs."""
        return seconds_spent(self.rows)


def load(*paths: Path) -> tuple[Study, list[Record]]:
    """The study and all its runs in order of the grid, from its folder, file or collected file.

    From several: the one with the most runs, and of each run the record that is furthest. InputError
    where another part says something else, has more runs, or has one done with other results.
    """
    parts = {path: _load(path) for path in paths}
    whole = max(paths, key=lambda path: len(parts[path][1]))
    study, found = parts[whole][0], dict[str, Record]()
    told = study.told()
    for path, (part, records) in parts.items():
        for what, said in part.told().items():
            if told.get(what) != said:
                allowed = told.get(what, "none; name the study file that has both, too")
                raise InputError(f"{path}: {what}: found {said}, but {whole} has {allowed}")
        for record in records:
            known = found.setdefault(record.run.name, record)
            if known.state == record.state == "done" and known.results != record.results:
                raise InputError(
                    f"{path}: run {record.run.name}: found it done, with other results elsewhere"
                )
            found[record.run.name] = max(known, record, key=lambda one: one.progress)
    return study, [found[run.name] for run in study.runs()]


def _load(path: Path) -> tuple[Study, list[Record]]:
    if path.suffix == ".toml":
        study = read(path)
        return study, [Record(run, "left", "", None, []) for run in study.runs()]
    if os.path.isfile(path):  # False for any name
        return _unpack(path)
    folder = StudyFolder(path)
    if not os.path.exists(folder.study_file) and os.path.isfile(path / COLLECTED):
        return _unpack(path / COLLECTED)
    study = folder.study()
    return study, [_record(run, folder.files(run)) for run in study.runs()]


def _record(run: Run, files: RunFiles) -> Record:
    outcome, state = files.outcome(), files.state()
    config, reason = None, files.damage() or (outcome.reason if outcome else "")
    if files.exists:
        try:
            if state != "done":  # goes on, which takes a configuration of this version
                files.run_dir.read_config()
            config = _anywhere(files.run_dir.record())
        except InputError as error:
            state, reason = "failed" if state != "damaged" else state, str(error)
    for place in (files.base, files.base.resolve()):
        reason = reason.replace(str(place), run.name)
    return Record(run, state, reason, config, files.rows())


def _anywhere(config: dict[str, Any]) -> dict[str, Any]:
    """A record without the folder of the machine that it was made on."""
    return {**config, "run": {k: v for k, v in config["run"].items() if k != "out"}}


def collect(*paths: Path, out: Path | None = None) -> Path:
    """Pack folders and collected files of a study into one file; returns it."""
    out = out or paths[0] / COLLECTED
    study, records = load(*paths)
    text = io.StringIO()
    columns = dict.fromkeys(column for record in records for row in record.rows for column in row)
    writer = csv.DictWriter(text, [*FIXED, *columns], lineterminator="\n")
    writer.writeheader()
    writer.writerow({"state": "study", "record": json.dumps(study.as_dict())})
    for record in records:
        first = {"reason": record.reason, "record": json.dumps(record.config)}
        for row in record.rows or [{}]:
            writer.writerow({"run": record.run.name, "state": record.state, **first, **row})
            first = {}
    with (
        replacing(out, _unpack) as file,
        gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed,
    ):
        packed.write(text.getvalue().encode())
    return out


def _unpack(path: Path) -> tuple[Study, list[Record]]:
    with damage_named(path, "not a collected study"):
        text = io.StringIO(unzip(path).decode("utf-8"), newline="")
        first, *rows = csv.DictReader(text, strict=True)
        study = from_dict(json.loads(first["record"]))
        by_run: dict[str, list[dict[str, str]]] = {}
        for row in rows:
            by_run.setdefault(row["run"], []).append(row)
        return study, [_unpacked(run, by_run[run.name]) for run in study.runs()]


def _unpacked(run: Run, rows: list[dict[str, str]]) -> Record:
    head = rows[0]
    if head["state"] not in STATES or any(row["state"] != head["state"] for row in rows):
        raise ValueError(f"run {run.name}: found the state {head['state']!r}")
    config = json.loads(head["record"])
    if config is not None:
        require_record(config)
        config = _anywhere(config)
    progress = [{k: v for k, v in row.items() if k not in FIXED} for row in rows]
    progress = [row for row in progress if any(row.values())]
    if fault := whole(progress)[1]:
        raise ValueError(f"run {run.name}: {fault}")
    return Record(run, head["state"], head["reason"], config, progress)
