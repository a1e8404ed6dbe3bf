"""Saving and loading a run's state: files replaced whole, read without running their code.

`checkpoint.pt` is what the run depends on, without the experience of learners that remember.
That grows slowly and would be rewritten again and again, so what an epoch and rank added is a
file of its own, and the checkpoint names the epochs that belong to it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..errors import InputError
from ..files import damage_named, own_folder
from . import sealed
from .config import RunConfig
from .run_dir import FORMAT, RunDir, with_new_names

TYPES = {
    "format": int,
    "epoch": int,
    "config": str,
    "ranks": list,
    "experience": list,
    "spaces": str,
}
PART = {"format": int, "epoch": int, "config": str, "rank": int, "experience": dict}
REWRITE = 2.0  # the parts are written anew as one when they take this many times a full memory


class Checkpoint:
    """The state of one run on disk; rank 0 alone writes."""

    def __init__(
        self, run_dir: RunDir, config: RunConfig, learner: Learner, comm: Communicator
    ):
        self.run_dir, self.config, self.learner, self.comm = (
            run_dir,
            config,
            learner,
            comm,
        )
        self._memory = learner.replay
        self._about = {"format": FORMAT, "config": json.dumps(config.identity())}
        self._parts: list[int] = []  # epochs whose experience is on disk

    def save(self, epoch: int) -> None:
        """Write the states of all ranks after `epoch`; every rank must call it."""
        is_anew = self.comm.all_gather(self.comm.rank == 0 and self._has_outgrown())[0]
        experience = (
            self._memory.new_experience(everything=bool(is_anew))
            if self._memory
            else {}
        )
        for rank, part in enumerate(self.comm.receive(experience)):
            if part:
                own_folder(self.run_dir.experience_folder)
                content = {
                    **self._about,
                    "epoch": epoch,
                    "rank": rank,
                    "experience": part,
                }
                sealed.write(self._part(epoch, rank), content)
        states = list(self.comm.receive(_compact(self.learner.state_dict())))
        if experience:
            self._parts = [*([] if is_anew else self._parts), epoch]
        if self.comm.rank == 0:
            content = {
                **self._about,
                "epoch": epoch,
                "ranks": states,
                "experience": self._parts,
                "spaces": self.learner.spaces.to_json(),
            }
            sealed.write(self.run_dir.checkpoint_file, content)
            for path in self._files():  # rewritten, or of epochs that were lost
                if int(path.stem.partition("-")[0]) not in self._parts:
                    path.unlink()

    def restore(self) -> int:
        """Load this rank's state and experience; the epoch it was written after.

        InputError when a file is damaged, of another configuration, or of another number of ranks.
        """
        data, rank = read(self.run_dir, self.config), self.comm.rank
        if (before := len(data["ranks"])) != self.comm.size:
            raise InputError(
                f"ranks: found {self.comm.size}, the run was made with {before}; start it with "
                f"mpirun -n {before}"
            )
        with damage_named(self.run_dir.checkpoint_file):
            self.learner.load_state_dict(data["ranks"][rank])
        if self._memory is not None:
            self._parts = data["experience"]
            for epoch in self._parts:
                with damage_named(path := self._part(epoch, rank)):
                    part = sealed.read_fields(path, "checkpoint", FORMAT, PART)
                    about = {**self._about, "epoch": epoch, "rank": rank}
                    if other := next(
                        (name for name in about if part[name] != about[name]), None
                    ):
                        raise ValueError(f"it is the experience of another {other}")
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
    """Copies of all tensors: of a view, pickle would send all that it is a view of."""
    if isinstance(value, torch.Tensor):
        return value.clone()
    if isinstance(value, dict):
        return {key: _compact(part) for key, part in value.items()}
    return [_compact(part) for part in value] if isinstance(value, list) else value


def read(run_dir: RunDir, config: RunConfig) -> dict[str, Any]:
    """The content of checkpoint.pt; InputError when damaged or of another configuration.

    The states of the ranks are for their learners to judge.
    """
    path = run_dir.checkpoint_file
    data = sealed.read_fields(path, "checkpoint", FORMAT, TYPES)
    with damage_named(path):
        epoch, parts = data["epoch"], data["experience"]
        if not 0 <= epoch < 2**63 or not data["ranks"]:
            raise ValueError(f"epoch {epoch}, {len(data['ranks'])} ranks")
        if any(type(part) is not int or not 1 <= part <= epoch for part in parts):
            raise ValueError("experience of epochs that the run has not had")
        if parts != sorted(set(parts)):
            raise ValueError("experience of epochs that are not in order")
        if difference := config.difference(with_new_names(json.loads(data["config"]))):
            raise InputError(
                f"{path}: from another configuration than config.json ({difference})"
            )
    return data
