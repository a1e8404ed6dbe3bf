"""Read taxels as points on links: tables of layout files, and CSV files (docs/guides/layouts.md).

Positions are in m in the frame of the link, normals point outward.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from .hands import RADIUS, Point
from .validation import Newtons, blamed, fill, read_text

Near = Annotated[float, "[-1, 1]"]
POSITION, NORMAL, SENSOR = (
    ("x", "y", "z"),
    ("nx", "ny", "nz"),
    ("radius", "threshold_N"),
)


@dataclass(frozen=True)
class TaxelTable:
    """One [[taxel]], or a row of a CSV file."""

    link: str
    position: tuple[Near, Near, Near]
    normal: tuple[float, float, float] | None = None
    radius: Annotated[float, "[0.0001, 0.02]"] = RADIUS
    name: str = ""
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
        # A unit vector stays as it is, so that a copy of the file is read as the file
        # was.
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


def read(path: Path) -> tuple[Point, ...]:
    """Return the taxels of a CSV file, one a row under a heading.

    Of its columns only link, x, y and z must be there, and unknown ones are left out,
    but for those that only look unknown, such as radius_mm. ValueError naming what is
    wrong with it, and FileNotFoundError.
    """
    with blamed(f"taxel file {path}"):
        lines = read_text(path, "taxel file").splitlines()
        rows = csv.DictReader(lines, skipinitialspace=True)
        for column in rows.fieldnames or ():
            _require_unit(column.strip())
        points = tuple(
            point(_table(row, rows.line_num), i) for i, row in enumerate(rows, 1)
        )
        if not points:
            raise ValueError("found no taxel")
        return points


def _require_unit(column: str) -> None:
    """Raise ValueError for a column of numbers with another unit or spelling than ours."""
    ours = {name.partition("_")[0]: name for name in (*POSITION, *NORMAL, *SENSOR)}
    name = ours.get(column.partition("_")[0].lower(), column)
    if name != column:
        raise ValueError(f"column: found {column!r}, allowed {name!r} (lengths in m)")


def _table(row: dict[str, str], line: int) -> dict[str, Any]:
    """Return the table that a row of a CSV file stands for."""
    if None in row:  # of DictReader: what is left over
        raise ValueError(f"line {line}: found more cells than columns")
    cells = {name.strip(): cell for name, cell in row.items() if name and cell}
    table: dict[str, Any] = {k: cells[k] for k in ("link", "name") if k in cells}
    try:
        table["position"] = [float(cells[name]) for name in POSITION]
        if not cells.keys().isdisjoint(NORMAL):
            table["normal"] = [float(cells[name]) for name in NORMAL]
        table |= {name: float(cells[name]) for name in SENSOR if name in cells}
    except (ValueError, KeyError) as error:
        raise ValueError(
            f"line {line}: found {str(cells)[:200]}, expected numbers as x, y, z and, where they "
            "are known, nx, ny, nz, radius and threshold_N"
        ) from error
    return table
