"""grasps.npz: what was played, and by which settings. Replaced whole, so that it can be read at
any moment."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..envs import hands, typed
from ..envs.objects import KINDS
from ..errors import InputError
from ..pictures.places import Place
from ..runs.files import damage_named, read_arrays, replacing
from .grasps import Measured, shapes_of

FORMAT = 1
LARGEST = 1e6  # of any number in it, SI units
SETTINGS = "settings"
NEEDED = (
    *("held", "broken", "joint_positions", "link_positions", "link_rotations"),
    *("object_position", "object_orientation", "object_kind", "object_half_size", "contact"),
)


class Played(NamedTuple):
    """Grasps 0, 1, 2, ... as they were recorded."""

    records: Measured
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
        with damage_named(path, "a whole file of grasps"):
            arrays = read_arrays(path)
            about = json.loads(str(arrays.pop(SETTINGS)))
            if about.pop("format") != FORMAT:
                raise ValueError("it has another format")
            places = tuple(typed.make(Place, place, "place") for place in about.pop("contact_places"))
            _check(arrays)
            if hands.is_hand(str(about.get("env"))):
                _check_scene(arrays, about, places)
    except FileNotFoundError:
        raise InputError(f"grasps file {str(path)!r} does not exist") from None
    return Played(arrays, about, places)


def _check(arrays: Measured) -> None:
    """ValueError unless all is there, of one length, and of numbers that occur."""
    for name in NEEDED:
        if name not in arrays:
            raise ValueError(f"{name} is missing")
    for name, values in arrays.items():
        if values.ndim == 0 or len(values) != len(arrays["held"]):
            raise ValueError(f"{name} differs in length from the others")
        if values.dtype.kind not in "fiub" or not (np.abs(values.astype(float)) < LARGEST).all():
            raise ValueError(f"{name} is not finite, or out of range")


def _check_scene(arrays: Measured, about: dict[str, Any], places: tuple[Place, ...]) -> None:
    """ValueError unless everything is as one of our hands gives it."""
    for setting, kind in (("simulator", str), ("touch", str), ("seed", int)):
        typed.require_type(about.get(setting), kind, setting)
    hand = hands.get(about["env"])
    shapes = {**shapes_of(hand), "contact": (len(places),)}
    for name, values in arrays.items():
        if values.shape[1:] != shapes.get(name, ()):
            raise ValueError(f"{name} has the shape {values.shape}")
    kinds, sizes = arrays["object_kind"], arrays["object_half_size"]
    if not (np.isin(kinds, range(len(KINDS))).all() and (sizes > 0).all()):
        raise ValueError("it has objects that do not exist")
    if any(not 0 <= place.surface < len(hand.surfaces) for place in places):
        raise ValueError("it has taxels that are not on the hand")


def difference(mine: dict[str, Any], others: dict[str, Any]) -> str | None:
    """The first setting in which grasps that exist are others than asked for."""
    mine = json.loads(json.dumps(mine))
    for name in {**mine, **others}:
        if mine.get(name) != others.get(name):
            return f"{name}: found {mine.get(name)!r}, they were played with {others.get(name)!r}"
    return None
