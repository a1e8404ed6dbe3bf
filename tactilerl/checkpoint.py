"""Saving and loading a run's state: files replaced whole, read without running their code.

`checkpoint.pt` is what the run depends on, without the experience of learners that remember.
That grows slowly and would be rewritten again and again, so each epoch's part of it is a file
of its own, and the checkpoint names those that belong to it.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from .algos import Algorithm
from .algos.mpi import Communicator
from .config import RunConfig
from .errors import InputError
from .run_dir import RunDir, replace_file

FORMAT = 2
REWRITE = 2.0  # the parts are written anew as one when they take this many times a full memory


class Checkpoint:
    """The state of one run on disk; rank 0 alone writes."""

    def __init__(self, run_dir: RunDir, config: RunConfig, learner: Algorithm, comm: Communicator):
        self.run_dir, self.config, self.learner, self.comm = run_dir, config, learner, comm
        self._parts: list[int] = []  # epochs whose experience is on disk

    def save(self, epoch: int) -> None:
        """Write the states of all ranks after `epoch`; every rank must call it."""
        is_anew = self.comm.min(self._has_outgrown() if self.comm.rank == 0 else 1)
        experience = self.comm.gather(self.learner.new_experience(everything=bool(is_anew)))
        states = self.comm.gather(self.learner.state_dict())
        if self.comm.rank > 0:
            return
        if any(experience):
            self._parts = [*([] if is_anew else self._parts), epoch]
            self.run_dir.experience_folder.mkdir(exist_ok=True)
            _write(self._part(epoch), {"format": FORMAT, "ranks": experience})
        content = {
            "format": FORMAT,
            "epoch": epoch,
            "config": self.config.identity(),
            "ranks": states,
            "experience": self._parts,
        }
        _write(self.run_dir.checkpoint_file, content)
        self._drop_others()

    def restore(self, any_ranks: bool = False) -> int:
        """Load this rank's state and experience; the epoch it was written after.

        InputError when a file is damaged, of another configuration, or of another number of
        ranks. With `any_ranks` another number goes: ranks that are new start from the state of
        an old one with their own random numbers, and the experience of ranks that are gone is
        dealt out to the others.
        """
        data, comm = read(self.run_dir, self.config), self.comm
        states = data["ranks"]
        if len(states) != comm.size and not any_ranks:
            raise InputError(
                f"ranks: found {comm.size}, the run was made with {len(states)}; start it with "
                f"mpirun -n {len(states)}, or give --any-ranks to go on all the same"
            )
        state = dict(states[comm.rank % len(states)])
        if len(states) != comm.size:
            del state["rng"]
        load_state(self.learner, state, self.run_dir.checkpoint_file)
        self._parts = list(data["experience"])
        for epoch in self._parts:
            ranks = _read(self._part(epoch))["ranks"]
            for rank in range(comm.rank, len(ranks), comm.size):
                self.learner.add_experience(ranks[rank])
        return int(data["epoch"])

    def _part(self, epoch: int) -> Path:
        return self.run_dir.experience_folder / f"{epoch:08d}.pt"

    def _has_outgrown(self) -> bool:
        size = sum(self._part(epoch).stat().st_size for epoch in self._parts)
        return size > REWRITE * self.learner.experience_bytes * self.comm.size > 0

    def _drop_others(self) -> None:
        """Remove parts that no checkpoint names: rewritten, or of epochs that were lost."""
        for path in self.run_dir.experience_folder.glob("*.pt"):
            if int(path.stem) not in self._parts:
                path.unlink()


def read(run_dir: RunDir, config: RunConfig) -> dict[str, Any]:
    """The content of checkpoint.pt; InputError when damaged or of another configuration."""
    path = run_dir.checkpoint_file
    data = _read(path)
    if difference := config.difference(data["config"]):
        raise InputError(f"{path}: from another configuration than config.json ({difference})")
    return data


def load_state(learner: Algorithm, state: dict[str, Any], path: Path) -> None:
    """Give a learner its state; InputError naming the file when they do not fit."""
    try:
        learner.load_state_dict(state)
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: damaged ({reason})") from error


def _write(path: Path, content: dict[str, Any]) -> None:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    replace_file(path, buffer.getvalue())


def _read(path: Path) -> dict[str, Any]:
    try:
        data = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise InputError(f"{path}: missing; there is no checkpoint yet, or it was removed") from None
    except Exception as error:  # torch.load answers garbage with errors of any kind
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged or not a checkpoint ({reason})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a checkpoint of format {FORMAT}")
    return data
