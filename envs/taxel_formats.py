"""Formats of taxel files: Genesis' probes, DEX-01's patterns, ORCA's and iCub's sensors, CSV.

Each reader yields a table per taxel with `position`, perhaps `normal`, `radius`, `name` and `link`;
ValueError where the content is wrong. docs/guides/layouts.md says which versions these are.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, groupby
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

if TYPE_CHECKING:
    from .taxel_files import Point

Tables = Iterator[dict[str, Any]]
LARGEST = 20_000_000  # bytes
COLUMNS = ("link", "x", "y", "z", "nx", "ny", "nz", "radius")
UNITS = {"mm": 1e-3, "m": 1.0}
ROWS = "[calibration]"  # of iCub's files: x, y, z and the normal of each taxel follow


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
        yield {"link": row["link"], **place, "name": row.get("name")}


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
