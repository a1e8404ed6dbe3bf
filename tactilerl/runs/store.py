"""The files of a run: config.json, progress.csv, checkpoint.pt, and what a learner remembers.

A folder can be cut off at any moment (`kill -9`, a full disk) and stays readable: files are
replaced whole, and the progress table is cut back to the checkpoint when a run goes on. One
process writes to it: whoever makes it or goes on with it holds its lock.

`checkpoint.pt` is what the run depends on, without the experience of learners that remember.
That grows slowly and would be rewritten again and again, so what an epoch and rank added is a
file of its own in experience/, and the checkpoint names the epochs that belong to it.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import os
import re
import zipfile
from pathlib import Path
from typing import Annotated, Any

import torch

from .. import machine
from ..algos import recipes
from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..envs import hands, layouts, plugins, validation
from ..envs.validation import require_type
from ..errors import InputError, input_errors
from ..files import (
    LEFTOVER,
    as_json,
    damage_named,
    make_folder,
    replacing,
    writable,
)
from . import spaces
from .config import (
    HAND_COPY,
    LAYOUT_COPY,
    PARTS,
    RunConfig,
    defaults,
    from_dict,
)

FORMAT = 3  # of all files in a run folder; 1 and 2 are those of 0.1
Values = dict[str, Any]
# The content of checkpoint.pt, and of a file in experience/.
CHECKPOINT = {"format": int, "epoch": int, "config": str, "ranks": list}
CHECKPOINT |= {"experience": list, "spaces": str}
PART = {"format": int, "epoch": int, "config": str, "rank": int, "experience": dict}
REWRITE = 2.0  # the parts are written anew as one when they take this many times a full memory
FIRST_COLUMNS = ["epoch", "env_steps"]  # the columns that every table begins with
Row = dict[str, str]


# What config.json holds, besides its format.
RECORD: Values = {"run": Values, "scene": Values | None, "learner": Values}
RECORD |= {"ranks": Annotated[int, "[1, inf)"], "provenance": list[Values]}


# -- tensors in a file -----------------------------------------------------------------------


def write_tensors(path: Path, content: Values) -> None:
    """Write tensors and plain values, whole or not at all; OSError where the disk is full."""
    with replacing(path) as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # PyTorch's, of what could not be written
            if isinstance(cause := error.__context__, OSError):
                raise OSError(cause.errno, cause.strerror, str(path)) from None
            raise


def read_tensors(
    path: Path, kind: str, version: int, types: dict[str, type], hint: str = ""
) -> Values:
    """Return the values that `write_tensors` wrote, of exactly these fields and `types`.

    The first field is the `version` of the format. Tensors are mapped from the file, not copied.
    Raise InputError where the file is damaged, of another kind, or would run code.
    """
    missing = f"{path}: missing; there is no {kind} yet, or it was removed"
    with damage_named(path, f"damaged or not a {kind}", missing):
        with zipfile.ZipFile(path) as archive:
            if any(entry.compress_type for entry in archive.infolist()):
                raise ValueError("it is compressed, as torch.save does not write it")
            if changed := archive.testzip():
                raise ValueError(f"{changed} was changed after it was written")
        data = torch.load(path, weights_only=True, map_location="cpu", mmap=True)
    if not isinstance(data, dict) or data.get(next(iter(types))) != version:
        raise InputError(f"{path}: not a {kind} of format {version}{hint}")
    if {name: type(value) for name, value in data.items()} != types:
        raise InputError(f"{path}: damaged (found {', '.join(map(str, data))})")
    return dict(data)


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

    def settled(self, config: RunConfig) -> RunConfig:
        """Return the configuration of a run here; InputError where another run is here already."""
        if not os.path.exists(self.config_file):  # False for any name
            return config
        saved = self.read_config()
        if difference := saved.difference(config.identity()):
            raise InputError(
                f"{self.path}: {difference}; a continued run keeps its settings (another --out "
                "makes another run)"
            )
        return dataclasses.replace(config, folder=self.path, hand=saved.hand)

    def create(self) -> None:
        """Make the folder where there is none; InputError where it holds something else."""
        with writable(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            names = {path.name for path in self.path.iterdir()}
        # A run that was killed before config.json was there leaves its lock and copies.
        ours = {HAND_COPY, LAYOUT_COPY} if ".lock" in names else set()
        others = {n for n in names - ours if not n.endswith((LEFTOVER, ".lock"))}
        if others and not self.config_file.exists():
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

        That is versions, and the `batch` of runs, if any. A run that goes on after `epoch` with others
        keeps the record of those before.
        """
        begins = not self.config_file.exists()
        origins = [] if begins else self.record()["provenance"]
        now = machine.origin(epoch, env_steps)
        if batch:
            now["batch"] = batch
        same = {name: now[name] for name in now if name not in ("epoch", "env_steps")}
        if not origins or not origins[-1].items() >= same.items():
            origins.append(now)
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
            try:
                config = from_dict({name: data[name] for name in PARTS})
            except InputError as error:
                version = data["provenance"][-1]["versions"].get("tactilerl")
                made = f"made by version {version}; this one reads runs of 0.5.0 on"
                raise InputError(f"{error} ({made})") from error
        hand = str(data.get("hand", ""))
        return dataclasses.replace(config, folder=self.path, hand=hand)

    def record(self) -> Values:
        """Return what config.json holds; InputError when damaged."""
        missing = f"{str(self.path)!r} is not a run folder: no config.json in it"
        with damage_named(self.config_file, "not a run's configuration", missing):
            return as_record(json.loads(self.config_file.read_bytes()))

    # -- progress.csv ------------------------------------------------------------------------

    def append(self, *rows: dict[str, Any]) -> None:
        """Add rows to the table, on disk; the first row decides the columns."""
        if not rows:
            return
        with open(self.table, "a+", newline="", encoding="utf-8") as file:
            file.seek(0)
            columns = next(csv.reader(file), None)
            if unknown := set(columns or ()) - rows[0].keys():
                raise InputError(
                    f"{self.table}: found the columns {', '.join(sorted(unknown))}, which this run "
                    "does not write; put back the header that belongs to it"
                )
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
            rows, problem = parse(self.table.read_bytes().decode("utf-8"))
            if problem:
                raise ValueError(problem)
        return rows

    def cut(self, epoch: int) -> None:
        """Drop the rows that were written after the checkpoint of `epoch`, if there are some.

        A table that is missing begins anew. InputError when this is not the checkpoint's table:
        damaged, or of other epochs.
        """
        if not self.table.exists():
            return
        epochs = [int(row["epoch"]) for row in self.rows()]
        first, last = (epochs[0], epochs[-1]) if epochs else (1, 0)
        if epochs != [*range(first, last + 1)] or last < epoch:
            raise InputError(
                f"{self.table}: found epochs up to {last}, the checkpoint's is {epoch}; put back "
                "the table that belongs to it, or move this one away to continue with a new one"
            )
        if first > epoch:  # so that a header that was cut off does not stay
            self.table.unlink()
            return
        lines = self.table.read_bytes().splitlines(keepends=True)
        with replacing(self.table) as file:
            file.write(b"".join(lines[: epoch - first + 2]))

    # -- checkpoint.pt -----------------------------------------------------------------------

    def read_checkpoint(self, config: RunConfig) -> Values:
        """Return the content of checkpoint.pt; InputError when damaged or of another configuration.

        The states of the ranks are for their learners to judge.
        """
        path = self.checkpoint_file
        data = read_tensors(path, "checkpoint", FORMAT, CHECKPOINT)
        with damage_named(path):
            difference = config.difference(json.loads(data["config"]))
        if difference:
            raise InputError(
                f"{path}: from another configuration than config.json ({difference})"
            )
        return data


def _hand_file(path: Path) -> bytes:
    """Return a hand's file with the absolute path of its model.

    The model may be large and stays where it is; a model of an installed package keeps its name.
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


def as_record(data: Any) -> Values:
    """Return the values of a config.json; ValueError where they are something else."""
    require_type(data, Values, "record")
    if data.get("format") != FORMAT:
        raise ValueError(f"not of format {FORMAT}; this version reads runs of 0.5.0 on")
    for name, hint in RECORD.items():
        require_type(data.get(name), hint, f"record.{name}")
    for name in ("algo", "env"):
        require_type(data["run"].get(name), str, f"record.run.{name}")
    return dict(data)


def parse(text: str) -> tuple[list[Row], str]:
    """Return the rows of a progress.csv, and what is wrong with the first that is damaged.

    A last line that was cut off does not count.
    """
    reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]), strict=True)
    rows = list[Row]()
    try:
        if [*(reader.fieldnames or FIRST_COLUMNS)][:2] != FIRST_COLUMNS:
            start = ",".join(FIRST_COLUMNS)
            raise ValueError(f"its header does not begin with {start}")
        for row in reader:
            if None in row or None in row.values():
                raise ValueError("found more or fewer fields than the header has")
            int(row["epoch"]), int(row["env_steps"])
            if any(math.isinf(float(field or 0)) for field in row.values()):
                raise ValueError("found a number that is not finite")
            rows.append(row)
    except (ValueError, csv.Error) as error:
        return rows, f"line {reader.line_num}: {error}"
    return rows, ""


class Checkpoint:
    """The state of one run on disk; rank 0 alone writes."""

    def __init__(
        self, run_dir: RunDir, config: RunConfig, learner: Learner, comm: Communicator
    ) -> None:
        """Save the state of `learner`, one rank of `comm`, in a folder; nothing is written yet."""
        self.run_dir, self.config = run_dir, config
        self.learner, self.comm = learner, comm
        self._memory = learner.replay
        self._about = {"format": FORMAT, "config": json.dumps(config.identity())}
        self._epochs: list[int] = []  # whose experience is on disk

    def save(self, epoch: int) -> None:
        """Write the states of all ranks after `epoch`; every rank must call it."""
        is_anew = self.comm.all_gather(self.comm.rank == 0 and self._has_outgrown())[0]
        added: Values = {}
        if self._memory is not None:
            added = self._memory.new_experience(everything=bool(is_anew))
        for rank, experience in enumerate(self.comm.receive(added)):
            if experience:
                make_folder(self.run_dir.experience_folder)
                about = {**self._about, "epoch": epoch, "rank": rank}
                content = {**about, "experience": experience}
                write_tensors(self._part(epoch, rank), content)
        states = list(self.comm.receive(_compact(self.learner.state_dict())))
        if added:
            self._epochs = [*([] if is_anew else self._epochs), epoch]
        if self.comm.rank == 0:
            content = {**self._about, "epoch": epoch, "ranks": states}
            content["experience"] = self._epochs
            content["spaces"] = spaces.to_json(self.learner.spaces)
            write_tensors(self.run_dir.checkpoint_file, content)
            for path in self._files():  # rewritten, or of epochs that were lost
                if int(path.stem.partition("-")[0]) not in self._epochs:
                    path.unlink()

    def restore(self) -> int:
        """Load this rank's state and experience; return the epoch it was written after.

        InputError when a file is damaged, of another configuration, or of other ranks.
        """
        data, rank = self.run_dir.read_checkpoint(self.config), self.comm.rank
        if (before := len(data["ranks"])) != self.comm.size:
            raise InputError(
                f"ranks: found {self.comm.size}, the run was made with {before}; start it with "
                f"mpirun -n {before}"
            )
        state = data["ranks"][rank]
        if self.learner.state_dict().keys() ^ state.keys():
            versions = self.run_dir.record()["provenance"][-1]["versions"]
            raise InputError(
                f"{self.run_dir.checkpoint_file}: its learner has other parts than this "
                f"version's; finish the run with version {versions.get('tactilerl')}, which made "
                "it (evaluate and render do read it)"
            )
        with damage_named(self.run_dir.checkpoint_file):
            self.learner.load_state_dict(state)
            if self._memory is not None:
                self._epochs = data["experience"]
                for epoch in self._epochs:
                    path = self._part(epoch, rank)
                    part = read_tensors(path, "checkpoint", FORMAT, PART)
                    self._memory.add_experience(part["experience"])
        return int(data["epoch"])

    def _part(self, epoch: int, rank: int) -> Path:
        return self.run_dir.experience_folder / f"{epoch:08d}-{rank:04d}.pt"

    def _files(self) -> list[Path]:
        return sorted(self.run_dir.experience_folder.glob("[0-9]" * 8 + "-*.pt"))

    def _has_outgrown(self) -> bool:
        if self._memory is None:
            return False
        size = sum(path.stat().st_size for path in self._files())
        return size > REWRITE * self._memory.nbytes * self.comm.size


def _compact(value: Any) -> Any:
    """Return copies of all tensors: of a view, pickle would send all that it is a view of."""
    if isinstance(value, torch.Tensor):
        return value.clone()
    if isinstance(value, dict):
        return {key: _compact(part) for key, part in value.items()}
    return [_compact(part) for part in value] if isinstance(value, list) else value


def resolve(
    algo: str | None = None,
    env: str = "",
    recipe: str | None = None,
    scene: str | None = None,
    resume: str | Path | None = None,
) -> RunConfig:
    """Return the configuration before other choices: defaults, or that of the run in `resume`.

    Imports the module that `env` names. Raise InputError where `resume` holds no such run, or a scene
    is named as well.
    """
    module, colon, _ = str(env).partition(":")
    if colon:
        with input_errors("env"):
            plugins.import_modules([module])
    if not resume:
        return defaults(algo, env, recipe, scene)
    if scene:
        raise InputError("scene: found with resume; a resumed run keeps its settings")
    saved = RunDir(Path(resume)).read_config()
    if recipe:
        with input_errors():
            learner = recipes.recipe(saved.run.algo, recipe)
        saved = dataclasses.replace(saved, learner=learner)
    return saved
