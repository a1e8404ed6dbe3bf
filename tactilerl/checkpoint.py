"""Saving and loading a run's state: one file, replaced whole, read without running its code."""

from __future__ import annotations

import io
from typing import Any

import torch

from .algos import Algorithm
from .config import RunConfig
from .errors import InputError
from .run_dir import RunDir, replace_file

FORMAT = 1


def save(run_dir: RunDir, config: RunConfig, epoch: int, ranks: list[dict[str, Any]]) -> None:
    """Write the states of all ranks after `epoch`."""
    buffer = io.BytesIO()
    content = {"format": FORMAT, "epoch": epoch, "config": config.identity(), "ranks": ranks}
    torch.save(content, buffer)
    replace_file(run_dir.checkpoint_file, buffer.getvalue())


def restore(run_dir: RunDir, config: RunConfig, learner: Algorithm, rank: int, ranks: int) -> int:
    """Load one rank's state into `learner`; the epoch it was written after.

    InputError when the file is damaged, of another number of ranks (`ranks` 0: any number) or
    of another configuration.
    """
    path = run_dir.checkpoint_file
    data = _read(run_dir)
    if difference := config.difference(data["config"]):
        raise InputError(f"{path}: from another configuration than config.json ({difference})")
    states = data["ranks"]
    if ranks and len(states) != ranks:
        raise InputError(
            f"ranks: found {ranks}, the run was made with {len(states)}; "
            f"start it with mpirun -n {len(states)}"
        )
    try:
        learner.load_state_dict(states[rank])
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: damaged ({reason})") from error
    return int(data["epoch"])


def _read(run_dir: RunDir) -> dict[str, Any]:
    path = run_dir.checkpoint_file
    try:
        data = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise InputError(f"{path}: no checkpoint yet") from None
    except Exception as error:  # torch.load answers garbage with errors of any kind
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged or not a checkpoint ({reason})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a checkpoint of format {FORMAT}")
    return data
