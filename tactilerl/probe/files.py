"""grasps.npz: grasps played side by side, kept as they come, and gone on with; and by which settings.
Replaced whole, so that it can be read at any moment."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..envs import hands, validation, vector
from ..envs.scenes import renamed
from ..envs.state import KINDS
from ..errors import InputError
from ..files import damage_named, read_arrays, replacing
from . import grasps
from .grasps import Measured, Scenes, shapes_of, stack
from .options import GraspFlags

FORMAT = 1
LARGEST = 1e6  # of any number in it, SI units
SETTINGS = "settings"
SAVE_EVERY = 20.0  # s


class Played(NamedTuple):
    """Grasps 0, 1, 2, ... as they were recorded."""

    records: Measured
    settings: dict[str, Any]
    """What they follow from, besides their number."""


def play(
    path: Path | None, asked: GraspFlags, workers: int, show: Callable[[int], None]
) -> Played:
    """All grasps that are asked for; those in the file at `path`, if any, are not played again.

    `show` is told how many there are. What was played stays in the file whatever stops it.
    InputError when the file holds grasps of other settings.
    """
    settings, n = asked.settings(), asked.grasps
    records = _kept(path, settings) if path is not None and path.exists() else []
    show(min(n, len(records)))
    if len(records) < n:
        with closing(vector.start(partial(Scenes, asked), workers)) as played_in:
            try:
                saved = time.monotonic()
                for record in played_in.play(grasps.play, range(len(records), n)):
                    records.append(record)
                    show(len(records))
                    if path is not None and time.monotonic() - saved > SAVE_EVERY:
                        write(path, Played(stack(records), settings))
                        saved = time.monotonic()
            finally:
                if path is not None and records:
                    write(path, Played(stack(records), settings))
    return Played(stack(records[:n]), settings)


def _kept(path: Path, settings: dict[str, Any]) -> list[Measured]:
    """What an earlier call left."""
    arrays, theirs = read(path)
    ours = json.loads(json.dumps(settings))
    for name in {**ours, **theirs}:
        mine, other = ours.get(name), theirs.get(name)
        if mine != other:
            raise InputError(f"{path}: {name}: found {mine!r}, but its grasps have {other!r}; "
                             "choose another folder with --out")  # fmt: skip
    return [
        {name: values[k] for name, values in arrays.items()}
        for k in range(len(arrays["held"]))
    ]


def write(path: Path, played: Played) -> None:
    """Write the file, or leave what is there."""
    about = json.dumps({"format": FORMAT, **played.settings})
    arrays: dict[str, Any] = {SETTINGS: np.array(about), **played.records}
    with replacing(path) as file:
        np.savez_compressed(file, **arrays)


def read(path: Path) -> Played:
    """What `write` wrote; InputError when it is not that."""
    missing = f"grasps file {str(path)!r} does not exist"
    with damage_named(path, "not a whole file of grasps", missing):
        arrays = read_arrays(path)
        about = renamed(json.loads(str(arrays.pop(SETTINGS))))
        if about.pop("format") != FORMAT:
            raise ValueError("it has another format")
        about.pop("contact_places", None), arrays.pop("contact", None)  # of 0.3.0
        if hands.is_hand(str(about.get("env"))):
            _check(arrays, about)
    return Played(arrays, about)


def _check(arrays: Measured, about: dict[str, Any]) -> None:
    """ValueError unless all is there, as one of our hands gives it, and of numbers that occur."""
    for setting, kind in (("simulator", str), ("touch_rule", str), ("seed", int)):
        validation.require_type(about.get(setting), kind, setting)
    hand = hands.get(about["env"])
    shapes = {"held": (), "broken": (), **shapes_of(hand)}
    for name in shapes:
        if name not in arrays:
            raise ValueError(f"{name} is missing")
    for name, values in arrays.items():
        expected = (arrays["held"].size, *shapes.get(name, ()))
        if values.shape != expected:
            raise ValueError(
                f"{name} has the shape {values.shape}, expected {expected}"
            )
        if (
            values.dtype.kind not in "fiub"
            or not (np.abs(values.astype(float)) < LARGEST).all()
        ):
            raise ValueError(f"{name} is not finite, or out of range")
    kinds, sizes = arrays["object_kind"], arrays["object_half_size"]
    if not (np.isin(kinds, range(len(KINDS))).all() and (sizes > 0).all()):
        raise ValueError("it has objects that do not exist")
