"""Robot hands by name or file: each is a model, and a TOML file that says what it means."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from .. import validation
from .files import FOLDER, KEPT, SUFFIX, short_digest
from .hand import (
    DIGITS,
    SEGMENTS,
    SLIDES,
    Hand,
    LinearAction,
    Pitch,
    ScriptedGrasp,
    Surface,
)

__all__ = [
    "DIGITS", "KEPT", "SEGMENTS", "SLIDES", "SUFFIX", "Hand", "LinearAction", "Pitch", "ScriptedGrasp",
    "Surface", "short_digest",
]  # fmt: skip

HANDS = ("shadow", "mpl", "allegro")
"""The library's own: each is a file here."""
OTHERS: dict[str, Any] = {}
"""The file of each hand of another package, by name, as its module adds it (`plugins`)."""


@dataclass(frozen=True)
class Usage:
    """What a hand's file says of the scenes it is used in."""

    id: str = ""
    """Of its environment in Gymnasium's registry; by name it is `make(name)`."""
    closing: tuple[float, float] = (0.5, 0.9)
    """How far the fingers of perturbed scripted grasps close, from and to, 1 being all the way: 30
    to 70 % of `tactilerl probe`'s grasps of the library's own hands then hold in either simulator."""
    scene: dict[str, Any] = field(default_factory=dict)
    """Where its scene differs from the defaults of `GraspConfig`."""


def is_hand(name: str) -> bool:
    """Is it the name of one of the library's hands, of another package's, or of anybody's hand file?"""
    return name in HANDS or name.endswith(SUFFIX) or name in names()


def names() -> list[str]:
    """Hands that can be asked for by name."""
    return [*HANDS, *OTHERS]


def allowed() -> str:
    """What hands may be called, for messages."""
    return f"{', '.join(names())}, or the path of a hand's .toml file"


def file(name: str) -> Path:
    """The file of a hand; ValueError for a name that is none."""
    if not is_hand(name):
        raise ValueError(f"unknown hand {name!r}; allowed: {allowed()}")
    if name in HANDS:
        return FOLDER / f"{name}{SUFFIX}"
    if name.endswith(SUFFIX):
        return Path(name)
    return Path(OTHERS[name])


def usage(name: str) -> Usage:
    """Of a hand by name or file; ValueError and FileNotFoundError where the file is wrong."""
    path = file(name)
    with validation.blamed(f"hand file {path}"):
        data = validation.read(path, "hand file")
        about = validation.table(data, "environment", {"id", "closing"})
        closing = about.get("closing", Usage.closing)
        low, high = validation.interval(closing, "environment.closing", 0.0, 2.0)
        return Usage(
            str(about.get("id", "")), (low, high), validation.table(data, "scene")
        )


def digest(name: str) -> str:
    """Return a digest of the files of anybody's own hand, of its meshes too; "" for the library's
    hands and for what is no hand. ValueError and OSError where they cannot be read."""
    if name in HANDS or not is_hand(name):
        return ""
    return short_digest(file(name), *get(name).build.files)


def get(name: str) -> Hand:
    """Return the hand of this name or file. ValueError or FileNotFoundError saying what is wrong with
    its file or model, ImportError where the package that has the model is not installed.

    Anybody's own hand is read once, as long as its files stay as they are, in a process of its own.
    """
    path = file(name)
    if path.parent == FOLDER:
        return _packaged(path)
    if not path.is_file():
        raise FileNotFoundError(f"hand file {name!r} does not exist")
    path = path.absolute()
    if path not in _read or _read[path][0] != _state(path, _read[path][1]):
        from . import loading, sandbox

        with validation.blamed(f"hand file {name}"):
            hand = sandbox.call(loading.load, path)
        _read[path] = _state(path, hand), hand
    return _read[path][1]


_read: dict[Path, tuple[list[Any], Hand]] = {}


def _state(path: Path, hand: Hand) -> list[Any]:
    """Return what changes when a file of a hand does, or a grasp is kept beside it."""
    files = [path, *hand.build.files, path.with_suffix(KEPT)]
    looks = [file.stat() if file.exists() else None for file in files]
    return [look and (look.st_size, look.st_mtime_ns) for look in looks]


@cache
def _packaged(path: Path) -> Hand:
    from . import loading

    return loading.load(path)
