"""Saving and loading a run's state: one file, replaced whole, read without running its code."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import torch

from .errors import InputError
from .run_dir import replace_file

FORMAT = 1


def save(path: Path, epoch: int, ranks: list[dict[str, Any]]) -> None:
    """Write the states of all ranks after `epoch`."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, "epoch": epoch, "ranks": ranks}, buffer)
    replace_file(path, buffer.getvalue())


def load(path: Path) -> tuple[int, list[dict[str, Any]]]:
    """(epoch, states of all ranks); InputError when there is no whole checkpoint."""
    try:
        data = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise InputError(f"{path}: no checkpoint yet; start the run anew") from None
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged or not a checkpoint ({reason})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a checkpoint of format {FORMAT}")
    return data["epoch"], data["ranks"]
