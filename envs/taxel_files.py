"""Taxels as points on links, in files of others: Genesis' probes, DEX-01's patterns, CSV.

Positions in m in the frame of the link, normals outward. docs/guides/layouts.md says which versions
of the formats these are.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from . import toml_files
from .toml_files import number, strings, table, vector

FARTHEST = 1.0  # m from the origin of its link
RADIUS = 2e-3  # m, where a file gives none
LARGEST, MOST = 20_000_000, 20_000  # bytes and taxels
COLUMNS = ("link", "x", "y", "z", "nx", "ny", "nz", "radius")


class Point(NamedTuple):
    """A taxel on a link."""

    link: str
    position: tuple[float, ...]
    """(3,), m."""
    normal: tuple[float, ...]
    """(3,), unit, outward."""
    radius: float
    """Of its sensing sphere, m."""
    name: str

    def toml(self) -> list[str]:
        """Lines of a layout file."""
        values = {"name": self.name, **self._asdict()}.items()
        return ["[[taxel]]", *(f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in values)]


def point(data: Any, index: int) -> Point:
    """From a table with link, position, normal, and perhaps radius and name; ValueError naming what
    is wrong with it."""
    where = f"taxel {index + 1}"
    table({where: data}, where, {*Point._fields})
    link = data.get("link")
    if not isinstance(link, str) or not link:
        raise ValueError(f"{where}: link: found {link!r}, expected the name of a link")
    position = vector(data.get("position"), 3, f"{where}: position", -FARTHEST, FARTHEST)
    normal = vector(data.get("normal"), 3, f"{where}: normal")
    length = float(np.linalg.norm(normal))
    if not 0.5 <= length <= 2.0:
        raise ValueError(f"{where}: normal: found {list(normal)}, expected a unit vector")
    radius = number(data.get("radius", RADIUS), f"{where}: radius", 1e-4, 0.02)
    name = str(data.get("name") or f"{link}[{index + 1}]")
    return Point(link, position, tuple((np.array(normal) / length).tolist()), radius, name)


def require_distinct(points: Sequence[Point]) -> None:
    """ValueError when two have the same name or lie in the same place."""
    for what, of in (("name", lambda p: p.name), ("place", lambda p: (p.link, p.position))):
        seen: dict[Any, int] = {}
        for index, each in enumerate(points):
            if (first := seen.setdefault(of(each), index)) != index:
                raise ValueError(f"taxels {first + 1} and {index + 1}: found the same {what}")


def read(path: Path, link: str | None = None) -> tuple[Point, ...]:
    """The taxels of a file, whose name says which format it has, all on `link` where that is given;
    ValueError naming what is wrong with it, and FileNotFoundError."""
    what = f"taxel file {path}"
    if not path.is_file():
        raise FileNotFoundError(f"taxel file {str(path)!r} does not exist")
    with toml_files.blamed(what), path.open("rb") as file:
        content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise ValueError(f"found more than {LARGEST // 10**6} MB")
        try:
            tables = list(READERS[path.suffix](content))
        except (UnicodeDecodeError, KeyError, TypeError, AttributeError, RecursionError,
                zipfile.BadZipFile, EOFError, csv.Error) as error:  # fmt: skip
            raise ValueError(f"not of this format ({type(error).__name__}: {error})") from None
        if not 0 < len(tables) <= MOST:
            raise ValueError(f"found {len(tables)} taxels, allowed from 1 to {MOST}")
        own = {} if link is None else {"link": link}
        if link is None and "link" not in tables[0]:
            raise ValueError("names no link; put it on one in a layout file: [[sensor]]")
        points = tuple(point({**one, **own}, index) for index, one in enumerate(tables))
        require_distinct(points)
        return points


def mounted(data: Any, index: int, folder: Path) -> Iterator[Point]:
    """The taxels of a sensor that has a file of its own, on each of its links; ValueError naming what
    is wrong, and FileNotFoundError."""
    where = f"sensor {index + 1}"
    table({where: data}, where, {"file", "links", "position", "quaternion", "radius"})
    file = data.get("file")
    if not isinstance(file, str) or Path(file).suffix not in READERS:
        allowed = f"names that end in {', '.join(READERS)}"
        raise ValueError(f"{where}: file: found {file!r}, allowed {allowed}")
    shift = vector(data.get("position", (0, 0, 0)), 3, f"{where}: position", -FARTHEST, FARTHEST)
    quaternion = vector(data.get("quaternion", (1, 0, 0, 0)), 4, f"{where}: quaternion")
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 0.1:
        raise ValueError(f"{where}: quaternion: found {list(quaternion)}, expected one of length 1")
    turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    for link in strings(data.get("links"), f"{where}: links"):
        for number_of, each in enumerate(read(folder / file, link), 1):
            place = tuple((np.array(shift) + turn @ each.position).tolist())
            radius = number(data.get("radius", each.radius), f"{where}: radius", 1e-4)
            name = f"{link}.{Path(file).stem}[{number_of}]"
            yield Point(link, place, tuple((turn @ each.normal).tolist()), radius, name)


def _read_genesis(content: bytes) -> Iterator[dict[str, Any]]:
    """One entry a link, its probes in rows of a grid or in a list."""
    for entry in json.loads(content.decode("utf-8")):
        rows = entry["probes"]
        for probe in chain(*rows) if rows and isinstance(rows[0], list) else rows:
            if probe.get("radius") == 0:  # fills up a row
                continue
            radius = {"radius": probe["radius"]} if "radius" in probe else {}
            place = {"position": probe["pos"], "normal": probe["normal"]}
            yield {"link": entry["link_name"], **place, **radius}


def _write_genesis(points: Sequence[Point]) -> bytes:
    entries = []
    for link, group in groupby(sorted(points, key=lambda p: p.link), key=lambda p: p.link):
        probes = [{"radius": p.radius, "pos": p.position, "normal": p.normal} for p in group]
        entries.append({"link_name": link, "kind": "grid", "probes": [probes]})
    return (json.dumps(entries, indent=1) + "\n").encode()


def _read_dex01(content: bytes) -> Iterator[dict[str, Any]]:
    """Poses (n, 3, 4) of the taxels of one sensor, whose z axes are the normals; no link."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(member.file_size for member in archive.infolist()) > LARGEST:
            raise ValueError(f"unpacks to more than {LARGEST // 10**6} MB")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        poses = arrays["poses"]
    if poses.ndim != 3 or poses.shape[1:] != (3, 4) or poses.dtype.kind != "f":
        found = f"found shape {poses.shape} of {poses.dtype}"
        raise ValueError(f"poses: {found}, expected (n, 3, 4) floats")
    for pose in poses.astype(float):
        yield {"position": pose[:, 3].tolist(), "normal": pose[:, 2].tolist()}


def _read_csv(content: bytes) -> Iterator[dict[str, Any]]:
    """One row a taxel, with a heading; a last column may give names."""
    rows = csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""))
    heading = tuple(rows.fieldnames or ())
    if heading not in (COLUMNS, (*COLUMNS, "name")):
        expected = f"{', '.join(COLUMNS)}[, name]"
        raise ValueError(f"found the columns {', '.join(heading)}, expected {expected}")
    for line, row in enumerate(rows, 2):
        try:
            x, y, z, nx, ny, nz, radius = (float(row[column]) for column in COLUMNS[1:])
        except (TypeError, ValueError):
            found = f"found {list(row.values())}, expected a link and numbers"
            raise ValueError(f"line {line}: {found}") from None
        place = {"position": [x, y, z], "normal": [nx, ny, nz], "radius": radius}
        yield {"link": row["link"], **place, "name": row.get("name")}


def _write_csv(points: Sequence[Point]) -> bytes:
    file = io.StringIO(newline="")
    writer = csv.writer(file)
    writer.writerow((*COLUMNS, "name"))
    for p in points:
        writer.writerow((p.link, *p.position, *p.normal, p.radius, p.name))
    return file.getvalue().encode()


READERS: dict[str, Callable[[bytes], Iterator[dict[str, Any]]]] = {
    ".json": _read_genesis,
    ".npz": _read_dex01,
    ".csv": _read_csv,
}
WRITERS: dict[str, Callable[[Sequence[Point]], bytes]] = {
    ".toml": lambda points: ("\n".join("\n".join([*p.toml(), ""]) for p in points)).encode(),
    ".json": _write_genesis,
    ".csv": _write_csv,
}
