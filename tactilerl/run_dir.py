"""The run folder: config.json, progress.csv, checkpoint.pt, and what a learner remembers.

A folder can be cut off at any moment (`kill -9`, a full disk) and stays readable: files are
replaced whole, and the progress table is cut back to the checkpoint when a run goes on.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO

from . import __version__
from .config import LAYOUT_COPY, RunConfig, from_dict
from .errors import InputError

PACKAGES = ("torch", "numpy", "mujoco", "pybullet", "gymnasium", "gymnasium-robotics", "mpi4py")


class RunDir:
    """One run's files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / "config.json"
        self.progress_file = path / "progress.csv"
        self.checkpoint_file = path / "checkpoint.pt"
        self.experience_folder = path / "experience"

    @classmethod
    def create(cls, path: Path, config: RunConfig, ranks: int) -> RunDir:
        """A new folder with its config.json; InputError when it exists."""
        if path.exists():
            raise InputError(
                f"run folder {str(path)!r} exists; choose another with --out, "
                f"or go on with it: --resume {path}"
            )
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"cannot make the run folder {str(path)!r}: {error.strerror}") from error
        run_dir = cls(path)
        if config.layout_file:
            shutil.copyfile(config.layout_file, path / LAYOUT_COPY)
        run_dir.write_config(config, ranks)
        return run_dir

    def write_config(self, config: RunConfig, ranks: int) -> None:
        """Write config.json: every value, the number of ranks, versions and commit."""
        content = {**config.as_dict(), "ranks": ranks, **_provenance()}
        with replacing(self.config_file) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())

    def read_config(self) -> tuple[RunConfig, int]:
        """The run's configuration and number of ranks; InputError when there is none."""
        try:
            data = json.loads(self.config_file.read_text(encoding="utf-8"))
            ranks = int(data["ranks"])
        except FileNotFoundError:
            raise InputError(f"{str(self.path)!r} is not a run folder: no config.json in it") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{self.config_file}: not a run's configuration: {error}") from error
        return dataclasses.replace(from_dict(data), folder=self.path), ranks

    def append_progress(self, row: dict[str, Any]) -> None:
        """Add one row; the first decides the columns, also those of a version that had fewer."""
        with self.progress_file.open("a+", newline="", encoding="utf-8") as file:
            file.seek(0)
            columns = next(csv.reader(file), None)
            writer = csv.DictWriter(
                file, columns or list(row), extrasaction="ignore", lineterminator="\n"
            )
            if columns is None:
                writer.writeheader()
            writer.writerow(row)

    def cut_progress(self, epoch: int) -> None:
        """Drop what was written after the checkpoint of `epoch`."""
        if epoch == 0:
            self.progress_file.unlink(missing_ok=True)
        if not self.progress_file.exists():
            return
        lines = self.progress_file.read_text(encoding="utf-8").splitlines(keepends=True)
        with replacing(self.progress_file) as file:
            file.write("".join(lines[: epoch + 1]).encode())


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write to that takes the place of `path` when it is whole, or not at all."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _provenance() -> dict[str, Any]:
    versions = {"tactilerl": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {"versions": versions, "commit": _commit()}


def _commit() -> str | None:
    command = ["git", "-C", str(Path(__file__).resolve().parent), "rev-parse", "HEAD"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()
