"""The folder of a study: its study file, and of every run the folder, lock, log and outcome.

study.json                what the runs are, as `Study.as_dict` has it
runs/NAME/                the run folder of `tactilerl train`
runs/NAME.lock            held by the process that trains it
runs/NAME.log             what it printed
runs/NAME.json            how it ended: done, or failed and why
"""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import filelock

from ..errors import InputError
from ..run_dir import RunDir
from ..sealed import replacing
from .grid import Run, Study, from_dict

State = Literal["done", "failed", "running", "interrupted", "left"]
STATES: tuple[State, ...] = ("done", "running", "failed", "interrupted", "left")


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    state: Literal["done", "failed"]
    total_timesteps: int
    """That it was asked for: a study file may ask for more later."""
    reason: str = ""


@dataclass(frozen=True)
class Progress:
    """How far a run has come."""

    env_steps: int = 0
    seconds: float = 0.0
    """Spent on them, without starting and stopping."""


class RunFiles:
    """What there is of one run."""

    def __init__(self, base: Path) -> None:
        self.base = base
        self.run_dir = RunDir(base)
        self.lock_file = base.with_name(base.name + ".lock")
        self.log_file = base.with_name(base.name + ".log")
        self.outcome_file = base.with_name(base.name + ".json")

    @property
    def exists(self) -> bool:
        """Has the run begun, so that it can go on?"""
        return self.run_dir.config_file.exists()

    def outcome(self) -> Outcome | None:
        """How the run ended; None while it has not, or where the record is damaged."""
        try:
            return Outcome(**json.loads(self.outcome_file.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

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

    def state(self) -> State:
        """Where the run stands."""
        if (outcome := self.outcome()) is not None:
            return outcome.state
        if self.is_running():
            return "running"
        return "interrupted" if self.exists else "left"

    def rows(self) -> list[dict[str, str]]:
        """The progress table as it stands in the file, without a last line that was cut off and
        without rows that do not fit its columns."""
        try:
            text = self.run_dir.progress.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return []
        table = csv.DictReader(text[: text.rfind("\n") + 1].splitlines())
        return [row for row in table if None not in row and None not in row.values()]

    def progress(self) -> Progress:
        """Steps and seconds so far, from the progress table."""
        seconds, steps = 0.0, 0
        try:
            for row in self.rows():
                now = int(float(row["env_steps"]))
                seconds, steps = seconds + (now - steps) / float(row["steps_per_s"]), now
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            pass  # damaged from here on
        return Progress(steps, seconds)


class StudyFolder:
    """A study's folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.study_file = path / "study.json"

    def files(self, run: Run) -> RunFiles:
        """The files of one of its runs."""
        return RunFiles(self.path / "runs" / run.name)

    def create(self, study: Study) -> None:
        """Make the folder, or write the study anew into one that a study was run in."""
        if self.path.exists() and not self.study_file.exists() and any(self.path.iterdir()):
            raise InputError(f"{str(self.path)!r} exists and holds no study; choose another with --out")
        try:
            (self.path / "runs").mkdir(parents=True, exist_ok=True)
            with replacing(self.study_file) as file:
                file.write((json.dumps(study.as_dict(), indent=1) + "\n").encode())
        except OSError as error:
            raise InputError(f"cannot write into {str(self.path)!r}: {error.strerror}") from error

    def study(self) -> Study:
        """The study that was run here last."""
        return read_study(self.study_file, self.path)


def read_study(path: Path, folder: Path) -> Study:
    """The study in a study.json; InputError where there is none."""
    try:
        return study_of(json.loads(path.read_text(encoding="utf-8")), path)
    except FileNotFoundError:
        raise InputError(f"{str(folder)!r} is not a study's folder: no study.json in it") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({' '.join(str(error).split())})") from error


def study_of(data: Any, path: Path) -> Study:
    """The study that `Study.as_dict` gave; InputError naming the file it was read from."""
    try:
        return from_dict(data)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a study of this version ({error})") from error
