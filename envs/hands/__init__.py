"""Robot hands by name or file: each is a model, and a TOML file that says what it means.

| file | what it has |
|---|---|
| `hand` | what the rest knows of a `Hand`, in four groups: `Model`, `Actuation`, `Geometry`, `Start` |
| `model_file` | models as published, MJCF or URDF |
| `mount` | what is done to a model: parts left out, links, couplings, servos |
| `tables`, `parts` | the TOML file; what it means of the model |
| `geometry`, `surfaces` | shapes and skin of links; where taxels may lie, the model's own sensors |
| `hand_file` | all of it together: a `Hand` from a file, hung on slides |
| `checks` | what is wrong with anybody's own hand, before it is used |
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .. import validation
from .hand import (
    ARM,
    DIGITS,
    FINGERS,
    FOLDER,
    GRASP_SUFFIX,
    RADIUS,
    SEGMENTS,
    SLIDES,
    SUFFIX,
    Hand,
    LinearAction,
    Pitch,
    Point,
    ScriptedGrasp,
    Surface,
    short_digest,
)
from .tables import HandFile

__all__ = [
    "ARM",
    "DIGITS",
    "FINGERS",
    "GRASP_SUFFIX",
    "RADIUS",
    "SEGMENTS",
    "SLIDES",
    "SUFFIX",
    "Hand",
    "LinearAction",
    "Pitch",
    "Point",
    "ScriptedGrasp",
    "Surface",
    "short_digest",
]  # fmt: skip

HANDS = ("shadow", "mpl", "allegro")
"""The library's own: each is a file here."""
OTHERS: dict[str, Any] = {}
"""The file of each hand of another package, by name, as its module adds it
(`plugins`)."""


def is_hand(name: str) -> bool:
    """Return whether this names a hand of the library or of a module, or is anybody's file."""
    return name in names() or name.endswith(SUFFIX)


def names() -> list[str]:
    """Return the names of all hands that have one."""
    return [*HANDS, *OTHERS]


def allowed() -> str:
    """Return what hands may be called, for messages."""
    return f"{', '.join(names())}, or the path of a hand's .toml file"


def file(name: str) -> Path:
    """Return the file of a hand; ValueError for a name that is none."""
    if not is_hand(name):
        raise ValueError(f"unknown hand {name!r}; allowed: {allowed()}")
    if name in HANDS:
        return FOLDER / f"{name}{SUFFIX}"
    return Path(OTHERS.get(name, name))


def described(name: str) -> HandFile:
    """Return what a hand's file says, without its model.

    Raises ValueError and FileNotFoundError where the file is wrong.
    """
    path = file(name)
    with validation.blamed(f"hand file {path}"):
        return validation.fill(HandFile, validation.read(path, "hand file"))


def digest(name: str) -> str:
    """Return a digest of the files of anybody's own hand, its meshes too.

    Raises ValueError and OSError where they cannot be read.
    """
    return short_digest(file(name).read_bytes(), *get(name).paths)


def get(name: str) -> Hand:
    """Return the hand of this name or file.

    It is read once, as long as its files stay as they are.

    Raises ValueError or FileNotFoundError saying what is wrong with its file or model,
    and ImportError where the package that has the model is not installed.
    """
    path = file(name).absolute()
    if not path.is_file():
        raise FileNotFoundError(f"hand file {name!r} does not exist")
    if path not in _read or _read[path][0] != _state(path, _read[path][1]):
        from . import hand_file

        with validation.blamed(f"hand file {name}"):
            hand = hand_file.load(described(name), path)
        _read[path] = _state(path, hand), hand
    return _read[path][1]


_read: dict[Path, tuple[list[Any], Hand]] = {}


def _state(path: Path, hand: Hand) -> list[Any]:
    """Return what changes when a file of a hand does, or a grasp is kept beside it."""
    files = (path, *hand.paths, path.with_suffix(GRASP_SUFFIX))
    return [file.exists() and file.stat().st_mtime_ns for file in files]
