"""Taxels as points on links, and in files of others.

Positions in m in the frame of the link, normals outward.
"""

from __future__ import annotations

import csv
import json
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from . import validation
from .taxel_formats import LARGEST, READERS
from .validation import number, strings, table, vector

FARTHEST = 1.0  # m from the origin of its link
RADIUS = 2e-3  # m, where a file gives none
MOST = 20_000  # taxels
BROKEN = (UnicodeDecodeError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError,
          MemoryError, EOFError, zipfile.BadZipFile, zlib.error, csv.Error)  # fmt: skip
"""What readers raise where a file is not of their format; ValueErrors say what is wrong with it."""


class Point(NamedTuple):
    """A taxel on a link."""

    link: str
    position: tuple[float, ...]
    """(3,), m."""
    normal: tuple[float, ...]
    """(3,), unit, outward; () until it is placed, where that of the nearest skin is meant."""
    radius: float
    """Of its sensing sphere, m."""
    name: str

    def toml(self) -> list[str]:
        """Lines of a layout file."""
        values = {"name": self.name, **self._asdict()}.items()
        own = ((key, value) for key, value in values if value != ())
        return [
            "[[taxel]]",
            *(f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in own),
        ]


def point(data: Any, index: int) -> Point:
    """From a table with link, position, normal, and perhaps radius and name; ValueError naming what
    is wrong with it."""
    where = f"taxel {index + 1}"
    table({where: data}, where, {*Point._fields})
    link = data.get("link")
    if not isinstance(link, str) or not link:
        raise ValueError(f"{where}: link: found {link!r}, expected the name of a link")
    position = vector(
        data.get("position"), 3, f"{where}: position", -FARTHEST, FARTHEST
    )
    normal: tuple[float, ...] = ()
    if "normal" in data:
        normal = vector(data["normal"], 3, f"{where}: normal")
        length = float(np.linalg.norm(normal))
        if not 0.5 <= length <= 2.0:
            raise ValueError(
                f"{where}: normal: found {list(normal)}, expected a unit vector"
            )
        normal = tuple((np.array(normal) / length).tolist())
    radius = number(data.get("radius", RADIUS), f"{where}: radius", 1e-4, 0.02)
    name = str(data.get("name") or f"{link}[{index + 1}]")
    return Point(link, position, normal, radius, name)


def require_distinct(points: Sequence[Point]) -> None:
    """ValueError when two have the same name or lie in the same place."""
    for what, of in (
        ("name", lambda p: p.name),
        ("place", lambda p: (p.link, p.position)),
    ):
        seen: dict[Any, int] = {}
        for index, each in enumerate(points):
            if (first := seen.setdefault(of(each), index)) != index:
                which = f"taxels {first + 1} and {index + 1}, {each.name}"
                raise ValueError(f"{which}: found the same {what}")


def read(path: Path, link: str | None = None) -> tuple[Point, ...]:
    """The taxels of a file, whose name says which format it has, all on `link` where that is given;
    ValueError naming what is wrong with it, and FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"taxel file {str(path)!r} does not exist")
    with validation.blamed(f"taxel file {path}"), path.open("rb") as file:
        content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise ValueError(f"found more than {LARGEST // 10**6} MB")
        try:
            tables = list(READERS[path.suffix](content))
        except BROKEN as error:
            raise ValueError(
                f"not of this format ({type(error).__name__}: {error})"
            ) from None
        if not 0 < len(tables) <= MOST:
            raise ValueError(f"found {len(tables)} taxels, allowed from 1 to {MOST}")
        own = {} if link is None else {"link": link}
        if link is None and "link" not in tables[0]:
            raise ValueError(
                "names no link; put it on one in a layout file: [[sensor]]"
            )
        points = tuple(point({**one, **own}, index) for index, one in enumerate(tables))
        require_distinct(points)
        return points


def mounted(sensors: Sequence[Any], index: int, folder: Path) -> Iterator[Point]:
    """The taxels of one of the sensors that have files of their own, on each of its links; ValueError
    naming what is wrong, and FileNotFoundError."""
    where, data = f"sensor {index + 1}", sensors[index]
    table({where: data}, where, {"file", "links", "position", "quaternion", "radius"})
    file = data.get("file")
    if not isinstance(file, str) or Path(file).suffix not in READERS:
        allowed = f"names that end in {', '.join(READERS)}"
        raise ValueError(f"{where}: file: found {file!r}, allowed {allowed}")
    alike = sum(earlier["file"] == file for earlier in sensors[:index])
    again = f" {alike + 1}" if alike else ""
    shift = vector(
        data.get("position", (0, 0, 0)), 3, f"{where}: position", -FARTHEST, FARTHEST
    )
    quaternion = vector(data.get("quaternion", (1, 0, 0, 0)), 4, f"{where}: quaternion")
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 0.1:
        raise ValueError(
            f"{where}: quaternion: found {list(quaternion)}, expected one of length 1"
        )
    turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    for link in strings(data.get("links"), f"{where}: links"):
        for number_of, each in enumerate(read(folder / file, link), 1):
            place = tuple((np.array(shift) + turn @ each.position).tolist())
            radius = number(
                data.get("radius", each.radius), f"{where}: radius", 1e-4, 0.02
            )
            name = f"{link}.{Path(file).stem}{again}[{number_of}]"
            normal = tuple((turn @ each.normal).tolist()) if each.normal else ()
            yield Point(link, place, normal, radius, name)
