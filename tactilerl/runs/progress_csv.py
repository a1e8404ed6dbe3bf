"""progress.csv: one row an epoch, each on disk before the checkpoint that counts it."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path
from typing import Any

from ..errors import InputError
from .files import content, no_link, replacing

FIRST = ["epoch", "env_steps"]  # the columns that every table begins with
TIMES = ("collect_s", "update_s", "steps_per_s")  # columns that no seed decides
SHARE = "success_rate"  # ends the names of columns that are shares
LONGEST = 100  # characters of a field
Row = dict[str, str]


class ProgressTable:
    """The table of one run. Nothing is changed in a table that is not whole."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, row: dict[str, Any]) -> None:
        """Add one row; the first decides the columns, also those of a version that had fewer."""
        with open(self.path, "a+", newline="", encoding="utf-8", opener=no_link) as file:
            file.seek(0)
            columns = next(csv.reader(file), None)
            unknown = sorted(set(columns or ()) - set(row))
            if unknown:
                raise InputError(f"{self.path}: found the column {unknown[0]!r}, not one of this run")
            writer = csv.DictWriter(
                file, columns or list(row), extrasaction="ignore", lineterminator="\n"
            )
            if columns is None:
                writer.writeheader()
            writer.writerow(row)
            file.flush()
            os.fsync(file.fileno())

    def n_rows(self) -> int:
        """How many whole rows there are."""
        return len(self._read()[1]) if self.path.exists() else 0

    def cut(self, epoch: int) -> None:
        """Drop the row that was written after the checkpoint of `epoch`, if there is one.

        A table that is missing begins anew. InputError when this is not the checkpoint's table:
        damaged, of other epochs, or of more than the one that a checkpoint may lack.
        """
        if not os.path.lexists(self.path):
            return
        if self.path.is_symlink():  # which would have us write somewhere else
            raise InputError(f"{self.path}: found a link, allowed a file")
        lines, epochs = self._read()
        last = epochs[-1] if epochs else 0
        if epochs != [*range(last - len(epochs) + 1, last + 1)]:
            raise InputError(f"{self.path}: damaged (the epochs do not follow one another)")
        if last not in (epoch, epoch + 1):
            raise InputError(
                f"{self.path}: found epochs up to {last}, the checkpoint's is {epoch}; put back the "
                "table that belongs to it, or move this one away to continue with a new one"
            )
        whole = lines[: len(lines) - (last - epoch)]
        if len(whole) < 2:  # so that a header that was cut off does not stay
            self.path.unlink()
        elif (content := "".join(whole).encode()) != self.path.read_bytes():
            with replacing(self.path) as file:
                file.write(content)

    def _read(self) -> tuple[list[str], list[int]]:
        """The header's and all rows' lines, without a last one that was cut off, and the rows'
        epochs; InputError when damaged."""
        try:
            text = content(self.path).decode("utf-8")
            lines = [line + "\n" for line in text.split("\n")[:-1]]
            rows = list(csv.reader(lines, strict=True))
            if len(rows) != len(lines):
                raise ValueError("a line break inside a field")
            for number, row in enumerate(rows, 1):
                _require_row(number, row, rows[0])
        except (OSError, ValueError, csv.Error) as error:
            raise InputError(f"{self.path}: damaged ({error})") from error
        return lines, [int(row[0]) for row in rows[1:]]


def whole(rows: list[Row]) -> tuple[list[Row], str]:
    """The rows before the first that no run writes, and what is wrong with that one."""
    last = (-1, -1)
    for index, row in enumerate(rows):
        try:
            _require_row(1, list(row), list(row))
            if None in row or None in row.values():  # of csv.DictReader
                raise ValueError(f"line {index + 2}: found more or fewer fields than the header has")
            _require_row(index + 2, list(row.values()), list(row))
            now = int(row["epoch"]), int(row["env_steps"])
            if now[0] <= last[0] or now[1] < last[1]:
                raise ValueError(f"line {index + 2}: epoch and steps {now} after {last}")
        except ValueError as error:
            return rows[:index], str(error)
        last = now
    return rows, ""


def _require_row(number: int, row: list[str], columns: list[str]) -> None:
    """ValueError when line `number` is not the header of such a table, or a row of numbers."""
    if number == 1:
        if row[: len(FIRST)] != FIRST or len(set(row)) < len(row):
            raise ValueError(f"its header does not begin with {','.join(FIRST)}")
        return
    if len(row) != len(columns):
        raise ValueError(f"line {number} has {len(row)} fields, the header {len(columns)}")
    if any(len(field) > LONGEST for field in row):
        raise ValueError(f"line {number} has a field of more than {LONGEST} characters")
    if min(int(row[0]), int(row[1])) < 0:
        raise ValueError(f"line {number}: found {row[0]} epochs and {row[1]} steps, allowed 0 or more")
    for column, field in zip(columns, row, strict=True):
        value = float(field or 0)
        if column.endswith(SHARE) and not (0 <= value <= 1 or math.isnan(value)):
            raise ValueError(f"line {number}: {column}: found {value:g}, allowed from 0 to 1")
