"""grasps.npz: what was played, and by which settings. Replaced whole, so that it can be read at
any moment."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..files import replacing
from ..places import Place
from .grasps import Record

FORMAT = 1
SETTINGS = "settings"
NEEDED = (
    *("held", "broken", "joint_positions", "link_positions", "link_rotations"),
    *("object_position", "object_orientation", "object_kind", "object_half_size", "contact"),
)


class Played(NamedTuple):
    """Grasps 0, 1, 2, ... as they were recorded."""

    records: Record
    settings: dict[str, Any]
    """What they follow from, besides their number."""
    contact_places: tuple[Place, ...]


def folder(path: Path) -> Path:
    """Make the folder of the results, where there is none; InputError when that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {str(path)!r}: {error.strerror}") from error
    return path


def write(path: Path, played: Played) -> None:
    """Write the file, or leave what is there."""
    about = {
        "format": FORMAT,
        **played.settings,
        "contact_places": [asdict(place) for place in played.contact_places],
    }
    with replacing(path) as file:
        arrays: dict[str, Any] = {SETTINGS: np.array(json.dumps(about)), **played.records}
        np.savez_compressed(file, **arrays)


def read(path: Path) -> Played:
    """What `write` wrote; InputError when it is not that."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        about = json.loads(str(arrays.pop(SETTINGS)))
        if about.pop("format") != FORMAT:
            raise ValueError("it has another format")
        places = tuple(Place(**place) for place in about.pop("contact_places"))
        _check(arrays)
    except FileNotFoundError:
        raise InputError(f"grasps file {str(path)!r} does not exist") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: found no whole file of grasps ({reason})") from error
    return Played(arrays, about, places)


def _check(arrays: Record) -> None:
    """ValueError unless all is there, of one length, and finite."""
    for name in NEEDED:
        if name not in arrays:
            raise ValueError(f"{name} is missing")
    for name, values in arrays.items():
        if values.ndim == 0 or len(values) != len(arrays["held"]):
            raise ValueError(f"{name} differs in length from the others")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")


def difference(mine: dict[str, Any], others: dict[str, Any]) -> str | None:
    """The first setting in which grasps that exist are others than asked for."""
    mine = json.loads(json.dumps(mine))
    for name in {**mine, **others}:
        if mine.get(name) != others.get(name):
            return f"{name}: found {mine.get(name)!r}, they were played with {others.get(name)!r}"
    return None
