"""The files of a run: config.json, progress.csv, checkpoint.pt, and what a learner remembers.

A folder can be cut off at any moment (`kill -9`, a full disk) and stays readable: files
are replaced whole, and the progress table is cut back to the checkpoint when a run goes
on. One process writes to it: whoever makes it or goes on with it holds its lock.

`checkpoint.pt` is what the run depends on, without the experience of learners that
remember. That grows slowly and would be rewritten again and again, so what an epoch and
rank added is a file of its own in experience/, and the checkpoint names the epochs that
belong to it.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import re
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from .. import machine
from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..algos.policy import Spaces, action_bounds
from ..envs import hands, layouts, plugins, validation
from ..errors import InputError, input_errors
from ..files import (
    as_json,
    damage_named,
    make_folder,
    replacing,
    writable,
)
from .config import (
    HAND_COPY,
    LAYOUT_COPY,
    RunConfig,
    defaults,
    from_dict,
)

# Parts of an experience become one when they hold this many times a full replay.
REWRITE = 2
FORMAT = 3  # of all files in a run folder; 1 and 2 are those of 0.1
Values = dict[str, Any]
Row = dict[str, float]
"""A row of progress.csv, NaN where it says nothing."""


# -- tensors and spaces in a file ------------------------------------------------------------


def write_tensors(path: Path, content: Values) -> None:
    """Write tensors and plain values, whole or not at all; OSError where the disk is full."""
    with replacing(path) as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # PyTorch's, of what could not be written
            if isinstance(cause := error.__context__, OSError):
                raise OSError(cause.errno, cause.strerror, str(path)) from None
            raise


def read_tensors(path: Path, kind: str, key: str, version: int) -> Values:
    """Return the values that `write_tensors` wrote, whose `key` is the `version` of the format.

    Tensors are mapped from the file, not copied. Raise InputError where the file is
    missing, damaged or of another kind; code in it is never run.
    """
    missing = f"{path}: missing; there is no {kind} yet, or it was removed"
    with damage_named(path, f"not a {kind} of this version", missing):
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):  # PyTorch would say it in five lines
                raise ValueError("not an archive, or cut off")
        data: Values = torch.load(
            path, weights_only=True, map_location="cpu", mmap=True
        )
        if data[key] != version:
            raise ValueError(f"{key}: found {data[key]}, allowed {version}")
    return data


def spaces_to_json(spaces: Spaces) -> str:
    """Return what a saved policy knows of spaces: shapes of observations and bounds of actions."""
    low, high = action_bounds(spaces.action)
    action = {"shape": low.shape, "dtype": str(low.dtype)}
    action |= {"low": low.ravel().tolist(), "high": high.ravel().tolist()}
    return json.dumps({"observation": spaces.shapes, "action": action})


def spaces_from_json(text: str) -> Spaces:
    """Return spaces of which `spaces_to_json` would say the same; observations have no bounds."""
    known = json.loads(text)
    boxes = {
        key: gym.spaces.Box(-np.inf, np.inf, tuple(shape))
        for key, shape in known["observation"].items()
    }
    action = known["action"]
    low, high = (
        np.array(action[name], action["dtype"]).reshape(action["shape"])
        for name in ("low", "high")
    )
    bounds = gym.spaces.Box(low, high, dtype=low.dtype.type)
    return Spaces(boxes.get("") or gym.spaces.Dict(boxes), bounds)  # type: ignore[arg-type]


# -- the folder ------------------------------------------------------------------------------


class RunDir:
    """The folder of one run."""

    def __init__(self, path: Path) -> None:
        """Name the files in the folder at `path`; nothing is read or made yet."""
        self.path = path
        self.config_file = path / "config.json"
        self.table = path / "progress.csv"
        self.checkpoint_file = path / "checkpoint.pt"
        self.experience_folder = path / "experience"
        self.layout_file = path / LAYOUT_COPY

    def settled(self, config: RunConfig, may_be_shorter: bool = True) -> RunConfig:
        """Return the configuration of a run here; InputError where another run is here already.

        That is a run of other values, one whose files of layout or hand said something
        else, a finished one with another last test, or, unless this one
        `may_be_shorter`, one that was begun with more steps.
        """
        if not os.path.exists(self.config_file):  # False for any name
            return config
        saved = self.read_config()
        if difference := saved.difference(config):
            raise InputError(
                f"{self.path}: {difference}; a continued run keeps its settings (another --out "
                "makes another run)"
            )
        was, now = saved.run.total_timesteps, config.run.total_timesteps
        if now < was and not may_be_shorter:
            raise InputError(
                f"total_timesteps: found {now:,}, allowed from {was:,}: a run was begun with so many"
            )
        if config.folder != self.path:  # resumed by its folder, its own copies count
            self._require_same_files(config)
        was, now = saved.run.n_test_episodes, config.run.n_test_episodes
        rows = self.rows() if was != now else []
        if rows and rows[-1]["env_steps"] >= config.run.total_timesteps:
            raise InputError(
                f"{self.path}: n_test_episodes: found {now}, the run has ended with a test of {was}"
            )
        return dataclasses.replace(config, folder=self.path, hand=saved.hand)

    def _require_same_files(self, config: RunConfig) -> None:
        """Raise InputError where a layout or a hand of one's own is not what the run's copy is."""
        layout, copy = config.layout_file, self.layout_file
        if layout and layout.is_file() and copy.is_file():
            with input_errors():
                was, now = (layouts.load(str(file)) for file in (copy, layout))
            if (was.patches, was.taxels) != (now.patches, now.taxels):
                raise InputError(
                    f"{self.path}: layout {layout}: found other taxels than when this run began"
                )
        hand, copy = Path(config.run.env), self.path / HAND_COPY
        if hand.is_file() and copy.is_file():
            with input_errors():
                texts = copy.read_text("utf-8"), _hand_file(hand).decode()
                was_file, file = map(tomllib.loads, texts)
            # Paths differ where a study moves; the model is compared where it is read.
            if was_file | {"model": ""} != file | {"model": ""}:
                raise InputError(
                    f"{self.path}: hand {hand}: found another file than when this run began"
                )

    def create(self) -> None:
        """Make the folder where there is none; InputError where it holds something else."""
        with writable(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            names = {path.name for path in self.path.glob("[!.]*")}
        # A run that was killed before config.json was there leaves its lock and copies.
        if (self.path / ".lock").exists():
            names -= {HAND_COPY, LAYOUT_COPY}
        if names and not self.config_file.exists():
            raise InputError(
                f"folder {str(self.path)!r} exists but is not a run folder; choose another "
                "with --out"
            )

    def write_config(
        self,
        config: RunConfig,
        ranks: int,
        epoch: int = 0,
        env_steps: int = 0,
        batch: Values | None = None,
    ) -> None:
        """Write config.json: every value, the number of ranks, and with what it was made.

        That is versions, and the `batch` of runs, if any. A run that goes on after
        `epoch` with others keeps the record of those before.
        """
        begins = not self.config_file.exists()
        origins = [] if begins else self.record()["provenance"]
        made_with = machine.origin() | ({"batch": batch} if batch else {})
        if not origins or not origins[-1].items() >= made_with.items():
            origins.append({"epoch": epoch, "env_steps": env_steps, **made_with})
        digest, env, copy = config.hand, config.run.env, self.path / HAND_COPY
        if not digest and config.scene and env not in hands.HANDS:  # it begins
            with replacing(copy) as file:
                file.write(_hand_file(hands.file(env)))
            digest = hands.digest(str(copy))
        if config.layout_file and (begins or not self.layout_file.exists()):
            with replacing(self.layout_file) as file:
                file.write(layouts.load(str(config.layout_file)).toml().encode())
        content = {"format": FORMAT, **config.as_dict(), "ranks": ranks}
        content |= {"provenance": origins, "hand": digest}
        with replacing(self.config_file) as file:
            file.write(as_json(content))

    def read_config(self) -> RunConfig:
        """Return the run's configuration; InputError when there is none, or an older version's."""
        data = self.record()
        with damage_named(self.config_file):
            config = from_dict(data)
        hand = str(data.get("hand", ""))
        return dataclasses.replace(config, folder=self.path, hand=hand)

    def record(self) -> Values:
        """Return what config.json holds; InputError when damaged."""
        missing = f"{str(self.path)!r} is not a run folder: no config.json in it"
        with damage_named(self.config_file, "not a run's configuration", missing):
            data: Values = json.loads(self.config_file.read_bytes())
            if data["format"] != FORMAT:
                allowed = f"{FORMAT}; this version reads runs of 0.5.0 on"
                raise ValueError(f"format: found {data['format']}, allowed {allowed}")
            return data

    # -- progress.csv ------------------------------------------------------------------------

    def append(self, *rows: dict[str, Any]) -> None:
        """Add rows to the table, on disk; the first row decides the columns."""
        with open(self.table, "a+", newline="", encoding="utf-8") as file:
            file.seek(0)
            columns = next(csv.reader(file), None)
            writer = csv.DictWriter(
                file,
                columns or list(rows[0]),
                extrasaction="ignore",
                lineterminator="\n",
            )
            if columns is None:
                writer.writeheader()
            writer.writerows(rows)
            file.flush()
            os.fsync(file.fileno())

    def rows(self) -> list[Row]:
        """Return the rows of the table, if there is one; InputError where it is damaged."""
        if not self.table.exists():
            return []
        with damage_named(self.table):
            return parse(self.table.read_text(encoding="utf-8"))

    def cut(self, epoch: int) -> None:
        """Drop the rows that were written after the checkpoint of `epoch`, if there are some.

        InputError where rows before it are missing; a table that is missing begins
        anew.
        """
        epochs = [row["epoch"] for row in self.rows()]
        if epochs and epochs[-1] < epoch:
            raise InputError(
                f"{self.table}: found epochs up to {epochs[-1]:g}, the checkpoint's is {epoch}; put "
                "back the table that belongs to it, or move this one away to continue with a new one"
            )
        kept = sum(one <= epoch for one in epochs)
        if not kept:  # so that a header that was cut off does not stay
            self.table.unlink(missing_ok=True)
            return
        lines = self.table.read_bytes().splitlines(keepends=True)
        with replacing(self.table) as file:
            file.write(b"".join(lines[: kept + 1]))

    # -- checkpoint.pt -----------------------------------------------------------------------

    def read_checkpoint(self) -> Values:
        """Return the content of checkpoint.pt; InputError when missing or damaged."""
        return read_tensors(self.checkpoint_file, "checkpoint", "format", FORMAT)


def _hand_file(path: Path) -> bytes:
    """Return a hand's file with the absolute path of its model.

    The model may be large and stays where it is; a model of an installed package keeps
    its name.
    """
    text = validation.read_text(path, "hand file")
    model = str(validation.read(path, "hand file")["model"])
    if ":" in model:
        return text.encode()
    line = json.dumps(str((path.parent / model).absolute()), ensure_ascii=False)
    text = re.sub(
        r"""(?m)^\s*(["']?)model\1\s*=.*$""", lambda _: f"model = {line}", text, count=1
    )
    return text.encode()


def parse(text: str) -> list[Row]:
    """Return the rows of a progress.csv; a last line that was cut off does not count."""
    whole = text[: text.rfind("\n") + 1]
    rows = [*csv.DictReader(io.StringIO(whole))]
    for row in rows:  # which all must have
        float(row["epoch"]), float(row["env_steps"])
    return [{name: float(x or "nan") for name, x in row.items()} for row in rows]


class Checkpoint:
    """The state of one run on disk.

    Each rank writes what it remembers; rank 0 the rest.
    """

    def __init__(self, run_dir: RunDir, learner: Learner, comm: Communicator) -> None:
        """Save the state of `learner`, one rank of `comm`, in a folder; nothing is written yet."""
        self.run_dir, self.learner, self.comm = run_dir, learner, comm
        self._epochs: list[int] = []  # whose experience is on disk
        self._n_saved = 0  # episodes in this rank's parts of it

    def save(self, epoch: int) -> None:
        """Write the states of all ranks after `epoch`; every rank must call it."""
        if self.learner.replay is not None:
            self._save_experience(epoch)
        states = self.comm.all_gather(self.learner.state_dict())
        if self.comm.rank == 0:
            content = {"format": FORMAT, "epoch": epoch, "ranks": states}
            content["experience"] = self._epochs
            content["spaces"] = spaces_to_json(self.learner.spaces)
            write_tensors(self.run_dir.checkpoint_file, content)
            for path in self.run_dir.experience_folder.glob("[0-9]*.pt"):
                if int(path.stem.partition("-")[0]) not in self._epochs:
                    path.unlink()

    def _save_experience(self, epoch: int) -> None:
        """Write what is new in this rank's replay, or all of it once its parts take too much room."""
        replay = self.learner.replay
        has_outgrown = self._n_saved > REWRITE * replay.n_slots
        is_anew = any(self.comm.all_gather(has_outgrown))
        added = replay.new_experience(everything=is_anew)
        if is_anew:
            self._epochs, self._n_saved = [], 0
        if added:
            make_folder(self.run_dir.experience_folder)
            write_tensors(self._part(epoch), {"format": FORMAT, "experience": added})
            self._epochs.append(epoch)
            self._n_saved += len(added["slots"])

    def restore(self) -> int:
        """Load this rank's state and experience; return the epoch it was written after.

        InputError when a file is damaged, of another version, or of other ranks.
        """
        data = self.run_dir.read_checkpoint()
        if (before := len(data["ranks"])) != self.comm.size:
            raise InputError(
                f"ranks: found {self.comm.size}, the run was made with {before}; start it with "
                f"mpirun -n {before}"
            )
        state, self._epochs = data["ranks"][self.comm.rank], data["experience"]
        problem = "damaged, a policy alone, or of another version"
        with damage_named(self.run_dir.checkpoint_file, problem):
            self.learner.load_state_dict(state)
            for epoch in self._epochs:
                part = read_tensors(self._part(epoch), "experience", "format", FORMAT)
                self.learner.replay.add_experience(part["experience"])
                self._n_saved += len(part["experience"]["slots"])
        return int(data["epoch"])

    def _part(self, epoch: int) -> Path:
        name = f"{epoch:08d}-{self.comm.rank:04d}.pt"
        return self.run_dir.experience_folder / name


def resolve(
    algo: str | None = None,
    env: str = "",
    recipe: str | None = None,
    scene: str | None = None,
    resume: str | Path | None = None,
    out: str | Path | None = None,
) -> RunConfig:
    """Return the configuration before other choices: defaults, or that of the run in `resume`.

    Imports the module that `env` names. Raise InputError where `resume` holds no run,
    or a scene, a recipe or another folder is named as well.
    """
    module, colon, _ = str(env).partition(":")
    if colon:
        with input_errors("env"):
            plugins.import_modules([module])
    if not resume:
        return defaults(algo, env, recipe, scene)
    for name, value in {"scene": scene, "recipe": recipe, "out": out}.items():
        if value:
            raise InputError(
                f"{name}: found with resume; a resumed run keeps its settings and its folder"
            )
    return RunDir(Path(resume)).read_config()
