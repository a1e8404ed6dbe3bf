"""The folder of a study: its study file, and of every run the folder, lock, log and outcome.

study.json                what the runs are, as `Study.as_dict` has it
runs/NAME/                the run folder of `tactilerl train`
runs/NAME.log             what it printed
runs/NAME.json            how it ended: done, or failed and why
runs/NAME.damaged1        what was left of a finished run that had to be trained again
"""

from __future__ import annotations

import csv
import itertools
import json
import os
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import filelock

from ..envs import typed
from ..errors import InputError
from ..runs.files import PATIENCE, content, damage_named, read_json, replacing, writable
from ..runs.progress_csv import Row, whole
from ..runs.run_dir import RunDir
from .grid import Run, Study, from_dict

State = Literal["done", "failed", "running", "interrupted", "damaged", "left"]
STATES: tuple[State, ...] = ("done", "running", "failed", "interrupted", "damaged", "left")


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    state: Literal["done", "failed"]
    total_timesteps: int
    """That it was asked for: a study file may ask for more later."""
    reason: str = ""


class RunFiles:
    """What there is of one run."""

    def __init__(self, base: Path) -> None:
        self.base = base
        self.run_dir = RunDir(base)
        self.lock_file = base / ".lock"
        self.log_file = base.with_name(base.name + ".log")
        self.outcome_file = base.with_name(base.name + ".json")

    @property
    def exists(self) -> bool:
        """Has the run begun, so that it can go on?"""
        return self.run_dir.config_file.exists()

    def outcome(self) -> Outcome | None:
        """How the run ended; None while it has not, or where the record is damaged."""
        try:
            with damage_named(self.outcome_file):
                return typed.make(Outcome, read_json(self.outcome_file), "outcome")
        except (FileNotFoundError, InputError):
            return None

    def damage(self) -> str:
        """Why a run that is recorded as done has to be trained again; "" where it has not."""
        outcome = self.outcome()
        if outcome is None or outcome.state != "done":
            return ""
        try:
            self.run_dir.record()
        except InputError as error:
            return str(error)
        rows, fault = self._table()
        reached = int(rows[-1]["env_steps"]) if rows else 0
        if reached >= outcome.total_timesteps:
            return ""
        found = fault or f"found {reached:,} steps of {outcome.total_timesteps:,}"
        return f"{self.run_dir.progress.path}: {found}"

    def set_aside(self) -> Path | None:
        """Make room for a damaged run to be trained again; where what is left of it went. Nothing
        happens where another process has done so."""
        if self.is_running():
            return None
        with writable(self.base), ExitStack() as held:
            if self.base.is_dir():
                held.enter_context(filelock.FileLock(self.lock_file, timeout=PATIENCE))
            if not self.damage():  # any more
                return None
            numbers = (self.base.with_name(f"{self.base.name}.damaged{n}") for n in itertools.count(1))
            place = next(path for path in numbers if not os.path.lexists(path))
            if os.path.lexists(self.base):
                self.base.rename(place)
            self.outcome_file.unlink()
            return place

    def write_outcome(self, outcome: Outcome) -> None:
        """Record how the run ended."""
        with replacing(self.outcome_file) as file:
            file.write((json.dumps(asdict(outcome)) + "\n").encode())

    def is_running(self) -> bool:
        """Does a process, here or elsewhere, train it right now?"""
        if not self.lock_file.exists():
            return False
        try:
            with filelock.FileLock(self.lock_file, timeout=0):
                return False
        except filelock.Timeout:
            return True
        except OSError:  # nobody can train it in a folder that nobody can write to
            return False

    def state(self) -> State:
        """Where the run stands."""
        if (outcome := self.outcome()) is not None:
            return "damaged" if self.damage() else outcome.state
        if self.is_running():
            return "running"
        return "interrupted" if self.exists else "left"

    def rows(self) -> list[Row]:
        """The progress table as it stands in the file, up to where it is cut off or damaged."""
        return self._table()[0]

    def _table(self) -> tuple[list[Row], str]:
        """Rows, and what is wrong with the one behind them."""
        path = self.run_dir.progress.path
        try:
            with damage_named(path):
                text = content(path).decode("utf-8")
                table = csv.DictReader(text[: text.rfind("\n") + 1].splitlines())
                return whole(list(table))
        except (FileNotFoundError, InputError):
            return [], "it cannot be read"


def seconds_spent(rows: list[Row]) -> float:
    """In epochs, without starting and saving."""
    seconds, steps = 0.0, 0
    for row in rows:
        now, speed = int(row["env_steps"]), float(row.get("steps_per_s") or 0)
        seconds, steps = seconds + ((now - steps) / speed if speed > 0 else 0.0), now
    return seconds


class StudyFolder:
    """A study's folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.study_file = path / "study.json"

    def files(self, run: Run) -> RunFiles:
        """The files of one of its runs."""
        return RunFiles(self.path / "runs" / run.name)

    def create(self, study: Study) -> None:
        """Make the folder, or write the study anew into one that it was run in."""
        with writable(self.path):
            if self.path.exists() and not self.study_file.exists() and any(self.path.iterdir()):
                raise InputError(
                    f"{str(self.path)!r} exists and holds no study; choose another with --out"
                )
            (self.path / "runs").mkdir(parents=True, exist_ok=True)
        if self.study_file.exists() and (other := self.study().name) != study.name:
            raise InputError(
                f"{str(self.path)!r} holds the study {other!r}, not {study.name!r}; choose another "
                "with --out"
            )
        with replacing(self.study_file) as file:
            file.write((json.dumps(study.as_dict(), indent=1) + "\n").encode())

    def study(self) -> Study:
        """The study that was run here last; InputError where there is none."""
        if os.path.isfile(self.path):
            raise InputError(f"{str(self.path)!r} is a file, allowed the folder of a study")
        missing = f"{str(self.path)!r} is not a study's folder: no study.json in it"
        with damage_named(self.study_file, "not a study of this version", missing):
            return from_dict(read_json(self.study_file))
