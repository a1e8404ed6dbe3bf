"""Grasps played side by side, kept as they come, and gone on with."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from ..envs.vector import Job, Workers
from ..errors import InputError
from . import files
from .grasps import Measured, stack

SAVE_EVERY = 20.0  # s


def play(
    path: Path,
    n: int,
    settings: dict[str, Any],
    task: Job[Measured],
    start: Callable[[], Workers],
    show: Callable[[int], None],
) -> files.Played:
    """Grasps 0 to n - 1; those in the file at `path` are not played again.

    `show` is told how many there are. What was played stays in the file whatever stops it.
    InputError when the file holds grasps of other settings.
    """
    records = _kept(path, settings)
    show(min(n, len(records)))
    if len(records) < n:
        with closing(start()) as workers:
            try:
                saved = time.monotonic()
                for record in workers.play(task, range(len(records), n)):
                    records.append(record)
                    show(len(records))
                    if time.monotonic() - saved > SAVE_EVERY:
                        files.write(path, files.Played(stack(records), settings))
                        saved = time.monotonic()
            finally:
                if records:
                    files.write(path, files.Played(stack(records), settings))
    return files.Played(stack(records[:n]), settings)


def _kept(path: Path, settings: dict[str, Any]) -> list[Measured]:
    """What an earlier call left."""
    if not path.exists():
        return []
    arrays, theirs = files.read(path)
    ours = json.loads(json.dumps(settings))
    for name in {**ours, **theirs}:
        mine, other = ours.get(name), theirs.get(name)
        if mine != other:
            raise InputError(f"{path}: {name}: found {mine!r}, but its grasps have {other!r}; "
                             "choose another folder with --out")  # fmt: skip
    return [{name: values[k] for name, values in arrays.items()} for k in range(len(arrays["held"]))]
