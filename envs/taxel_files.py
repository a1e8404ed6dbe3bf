"""Read taxels as points on links: tables of layout files, and files of points.

Files of points are CSV, and JSON as Tactile Genesis has it (docs/guides/layouts.md). Positions are in
m in the frame of the link, normals point outward.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from .hands import RADIUS, Point
from .validation import Newtons, blamed, fill, read_text, require_one_of

Near = Annotated[float, "[-1, 1]"]
Place = tuple[Near, Near, Near]
"""Point in the frame of a link, m."""
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
    threshold_N: Newtons | None = None


@dataclass(frozen=True)
class SensorTable:
    """One [[sensor]]: taxels of a file on links."""

    file: str
    links: tuple[str, ...]
    position: Place = (0.0, 0.0, 0.0)
    quaternion: tuple[Near, Near, Near, Near] = (1.0, 0.0, 0.0, 0.0)
    radius: Radius | None = None
    threshold_N: Newtons | None = None


def point(data: Any, number: int) -> Point:
    """Return taxel `number` from a table (`TaxelTable`); ValueError naming what is wrong with it."""
    where = f"taxel {number}"
    table = fill(TaxelTable, data, where)
    normal: tuple[float, ...] = table.normal or ()
    if normal:
        length = float(np.linalg.norm(normal))
        if not 1e-9 < length < np.inf:
            raise ValueError(
                f"{where}: normal: found {list(normal)}, expected a direction"
            )
        # A unit vector stays as it is, so that a copy of the file is read as the file was.
        if abs(length - 1.0) > 1e-9:
            normal = tuple((np.array(normal) / length).tolist())
    name = table.name or f"{table.link}[{number}]"
    return Point(**vars(table) | {"normal": normal, "name": name})


def require_distinct(points: Sequence[Point]) -> None:
    """Raise ValueError when two have the same name or lie in the same place."""
    first: dict[Any, int] = {}
    for number, each in enumerate(points, 1):
        for what, key in (("name", each.name), ("place", each[:2])):
            if (other := first.setdefault(key, number)) != number:
                raise ValueError(
                    f"taxels {other} and {number}, {each.name}: found the same {what}"
                )


def read(path: Path, link: str | None = None) -> tuple[Point, ...]:
    """Return the taxels of a file, all on `link` where that is given.

    The file's name says which format it has. ValueError naming what is wrong with it, and
    FileNotFoundError.
    """
    with blamed(f"taxel file {path}"):
        require_one_of(READERS, path.suffix, "ending of its name")
        text = read_text(path, "taxel file")
        try:
            tables = list(READERS[path.suffix](text))
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            found, form = f"{type(error).__name__}: {error}", FORMS[path.suffix]
            raise ValueError(f"found another form ({found}), expected {form}") from None
        if not tables:
            raise ValueError("found no taxel")
        on_link = {} if link is None else {"link": link}
        return tuple(point(table | on_link, i) for i, table in enumerate(tables, 1))


def mounted(sensors: Sequence[SensorTable], folder: Path) -> Iterator[Point]:
    """Yield the taxels of sensors that have files of their own, on each of their links.

    Raise ValueError naming what is wrong, and FileNotFoundError.
    """
    numbers = Counter[str]()
    for sensor in sensors:
        turn = Rotation.from_quat(sensor.quaternion, scalar_first=True).as_matrix()
        for link in sensor.links:
            name = f"{link}.{Path(sensor.file).stem}"
            for each in read(folder / sensor.file, link):
                numbers[name] += 1
                position = np.array(sensor.position) + turn @ each.position
                yield Point(
                    link,
                    tuple(position.tolist()),
                    tuple((turn @ each.normal).tolist()) if each.normal else (),
                    sensor.radius or each.radius,
                    f"{name}[{numbers[name]}]",
                    sensor.threshold_N,
                )


# -- formats ---------------------------------------------------------------------------------


def _read_genesis(text: str) -> Tables:
    """Yield a table a probe.

    There is one entry a link, its probes in rows of a grid or in a list; those of radius 0 fill up a
    row.
    """
    for entry in json.loads(text):
        rows = entry["probes"]
        for probe in chain(*rows) if rows and isinstance(rows[0], list) else rows:
            if radius := probe.get("radius", RADIUS):
                place = {"position": probe["pos"], "normal": probe.get("normal")}
                yield {"link": entry["link_name"], **place, "radius": radius}


def _read_csv(text: str) -> Tables:
    """Yield a table a row.

    There is a heading. Of its columns only x, y and z must be there, and others are left out.
    """
    rows = csv.DictReader(text.splitlines(), skipinitialspace=True)
    for row in rows:
        cells = {name.strip(): cell for name, cell in row.items() if name and cell}
        table: dict[str, Any] = {
            name: cells[name] for name in ("link", "name") if name in cells
        }
        try:
            table["position"] = [float(cells[name]) for name in ("x", "y", "z")]
            if "nx" in cells:
                table["normal"] = [float(cells[name]) for name in ("nx", "ny", "nz")]
            if "radius" in cells:
                table["radius"] = float(cells["radius"])
        except (ValueError, KeyError) as error:
            line = f"line {rows.line_num}: {type(error).__name__}: {error}"
            raise ValueError(f"{line}; found {cells}"[:200]) from error
        yield table


FORMS = {
    ".json": '[{"link_name": NAME, "probes": [{"pos": [x, y, z], "normal": [x, y, z], "radius": r}]}]',
    ".csv": "x, y, z and, where they are known, link, nx, ny, nz, radius, name",
}
"""Content that files of points have, by their suffix."""
READERS: dict[str, Callable[[str], Tables]] = {
    ".json": _read_genesis,
    ".csv": _read_csv,
}
