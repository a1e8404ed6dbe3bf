"""Taxels as points on links, in files of others: Genesis' probes, DEX-01's patterns, ORCA's and iCub's
sensors, CSV. docs/guides/layouts.md says which versions these are.

Each reader yields a table per taxel with `position`, perhaps `normal`, `radius`, `name` and `link`;
ValueError where the content is wrong. Positions in m in the frame of the link, normals outward.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from .hands import RADIUS, Point
from .validation import blamed, fill

MOST = 20_000  # taxels
BROKEN = (UnicodeDecodeError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError,
          MemoryError, EOFError, zipfile.BadZipFile, zlib.error, csv.Error)  # fmt: skip
"""What readers raise where a file is not of their format; ValueErrors say what is wrong with it."""


LARGEST = 20_000_000  # bytes
COLUMNS = ("link", "x", "y", "z", "nx", "ny", "nz", "radius")
UNITS = {"mm": 1e-3, "m": 1.0}
ROWS = "[calibration]"  # of iCub's files: x, y, z and the normal of each taxel follow
Near = Annotated[float, "[-1, 1]"]
Place = tuple[Near, Near, Near]
"""In the frame of a link, m."""
Four = tuple[float, float, float, float]
Radius = Annotated[float, "[0.0001, 0.02]"]
Tables = Iterator[dict[str, Any]]


@dataclass(frozen=True)
class TaxelTable:
    """One [[taxel]], or a taxel of another file."""

    link: str
    position: Place
    normal: tuple[float, float, float] | None = None
    radius: Radius = RADIUS
    name: str = ""


@dataclass(frozen=True)
class SensorTable:
    """One [[sensor]]: taxels of a file on links."""

    file: str
    links: tuple[str, ...]
    position: Place = (0.0, 0.0, 0.0)
    quaternion: Four = (1.0, 0.0, 0.0, 0.0)
    radius: Radius | None = None


def point(data: Any, index: int) -> Point:
    """Return a taxel from a table with link, position, normal, and perhaps radius and name; ValueError
    naming what is wrong with it."""
    where = f"taxel {index + 1}"
    table = fill(TaxelTable, data, where)
    if not table.link:
        raise ValueError(f"{where}: link: found '', expected the name of a link")
    normal: tuple[float, ...] = ()
    if table.normal is not None:
        length = float(np.linalg.norm(table.normal))
        if not 0.5 <= length <= 2.0:
            found = f"found {list(table.normal)}, expected a unit vector"
            raise ValueError(f"{where}: normal: {found}")
        normal = tuple((np.array(table.normal) / length).tolist())
    name = table.name or f"{table.link}[{index + 1}]"
    return Point(table.link, table.position, normal, table.radius, name)


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
    with blamed(f"taxel file {path}"), path.open("rb") as file:
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


def mounted(
    sensors: Sequence[SensorTable], index: int, folder: Path
) -> Iterator[Point]:
    """Yield the taxels of one of the sensors that have files of their own, on each of its links;
    ValueError naming what is wrong, and FileNotFoundError."""
    where, sensor = f"sensor {index + 1}", sensors[index]
    if Path(sensor.file).suffix not in READERS:
        allowed = f"names that end in {', '.join(READERS)}"
        raise ValueError(f"{where}: file: found {sensor.file!r}, allowed {allowed}")
    alike = sum(earlier.file == sensor.file for earlier in sensors[:index])
    stem = Path(sensor.file).stem + (f" {alike + 1}" if alike else "")
    if abs(float(np.linalg.norm(sensor.quaternion)) - 1.0) > 0.1:
        found = f"found {list(sensor.quaternion)}, expected one of length 1"
        raise ValueError(f"{where}: quaternion: {found}")
    turn = Rotation.from_quat(sensor.quaternion, scalar_first=True).as_matrix()
    for link in sensor.links:
        for number, each in enumerate(read(folder / sensor.file, link), 1):
            place = tuple((np.array(sensor.position) + turn @ each.position).tolist())
            normal = tuple((turn @ each.normal).tolist()) if each.normal else ()
            radius = each.radius if sensor.radius is None else sensor.radius
            yield Point(link, place, normal, radius, f"{link}.{stem}[{number}]")


# -- formats ---------------------------------------------------------------------------------


def _read_genesis(content: bytes) -> Tables:
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
    for link, group in groupby(
        sorted(points, key=lambda p: p.link), key=lambda p: p.link
    ):
        probes = [
            {"radius": p.radius, "pos": p.position, "normal": p.normal} for p in group
        ]
        entries.append({"link_name": link, "kind": "grid", "probes": [probes]})
    return (json.dumps(entries, indent=1) + "\n").encode()


def _read_dex01(content: bytes) -> Tables:
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


def _read_csv(content: bytes) -> Tables:
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
        yield {"link": row["link"], **place, "name": row.get("name") or ""}


def _write_csv(points: Sequence[Point]) -> bytes:
    file = io.StringIO(newline="")
    writer = csv.writer(file)
    writer.writerow((*COLUMNS, "name"))
    for p in points:
        writer.writerow((p.link, *p.position, *p.normal, p.radius, p.name))
    return file.getvalue().encode()


def _read_orca(content: bytes) -> Tables:
    """One sensor's taxels, as ORCA publishes them; no link. Older files have no axes."""
    try:
        data = yaml.load(content, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML: {' '.join(str(error).split())}") from None
    if data["units"] not in UNITS:
        raise ValueError(f"units: found {data['units']!r}, allowed {', '.join(UNITS)}")
    rows = data["coordinates"]
    if data.get("num_taxels", len(rows)) != len(rows):
        raise ValueError(
            f"num_taxels: found {data['num_taxels']!r} and {len(rows)} coordinates"
        )
    for row in rows:
        normal = {"normal": row["z_axis"]} if "z_axis" in row else {}
        yield {
            "position": [UNITS[data["units"]] * row[axis] for axis in "xyz"],
            **normal,
        }


def _read_icub(content: bytes) -> Tables:
    """The skin of a part, named as its link. Rows of zeros stand for taxels that it does not have;
    rows in the place of another, after rounding, are left out as well."""
    head, found, rows = content.decode("utf-8").partition(ROWS)
    names = [
        line.split()[1] for line in head.splitlines() if line.split()[:1] == ["name"]
    ]
    if not found or len(names) != 1:
        raise ValueError(f"found no name and {ROWS}, expected iCub's skin positions")
    seen: set[tuple[float, ...]] = {(0.0, 0.0, 0.0)}
    for line, row in enumerate(rows.splitlines(), head.count("\n") + 1):
        figures = tuple(map(float, row.split()))
        if len(figures) not in (0, 6):
            raise ValueError(f"line {line}: found {len(figures)} numbers, expected 6")
        if figures and figures[:3] not in seen:
            seen.add(figures[:3])
            normal = {"normal": list(figures[3:])} if any(figures[3:]) else {}
            yield {"link": names[0], "position": list(figures[:3]), **normal}


READERS: dict[str, Callable[[bytes], Tables]] = {
    ".json": _read_genesis,
    ".npz": _read_dex01,
    ".csv": _read_csv,
    ".yaml": _read_orca,
    ".txt": _read_icub,
}
WRITERS: dict[str, Callable[[Sequence[Point]], bytes]] = {
    ".toml": lambda points: (
        "\n".join("\n".join([*p.toml(), ""]) for p in points)
    ).encode(),
    ".json": _write_genesis,
    ".csv": _write_csv,
}
