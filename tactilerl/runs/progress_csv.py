"""progress.csv: one row an epoch, each on disk before the checkpoint that counts it."""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import content, damage_named, no_link, replacing

FIRST = ["epoch", "env_steps"]  # the columns that every table begins with
TIMES = ("collect_s", "update_s", "steps_per_s")  # columns that no seed decides
SHARE = "success_rate"  # ends the names of columns that are shares
Row = dict[str, str]


class ProgressTable:
    """The table of one run. Nothing is changed in a table that is not whole."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, row: dict[str, Any]) -> None:
        """Add one row; the first decides the columns, also those of a version that had fewer."""
        with open(
            self.path, "a+", newline="", encoding="utf-8", opener=no_link
        ) as file:
            file.seek(0)
            columns = next(csv.reader(file), None)
            unknown = sorted(set(columns or ()) - set(row))
            if unknown:
                raise InputError(
                    f"{self.path}: found the column {unknown[0]!r}, not one of this run"
                )
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
            raise InputError(
                f"{self.path}: damaged (the epochs do not follow one another)"
            )
        if last not in (epoch, epoch + 1):
            raise InputError(
                f"{self.path}: found epochs up to {last}, the checkpoint's is {epoch}; put back the "
                "table that belongs to it, or move this one away to continue with a new one"
            )
        whole = lines[: len(lines) - (last - epoch)]
        if len(whole) < 2:  # so that a header that was cut off does not stay
            self.path.unlink()
        elif (kept := "".join(whole).encode()) != self.path.read_bytes():
            with replacing(self.path) as file:
                file.write(kept)

    def _read(self) -> tuple[list[str], list[int]]:
        """The header's and all rows' lines, without a last one that was cut off, and the rows'
        epochs; InputError when damaged."""
        with damage_named(self.path):
            text = content(self.path).decode("utf-8")
            rows, problem = parse(text)
            if problem:
                raise ValueError(problem)
        lines = [f"{line}\n" for line in text.split("\n")[: len(rows) + 1]]
        return lines, [int(row["epoch"]) for row in rows]


def parse(text: str) -> tuple[list[Row], str]:
    """The rows before the first that no run writes, and what is wrong with that one. A last line that
    was cut off does not count."""
    reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]), strict=True)
    rows, before = list[Row](), (-1, 0)
    try:
        columns = list(reader.fieldnames or FIRST)
        if columns[: len(FIRST)] != FIRST or len(set(columns)) < len(columns):
            raise ValueError(f"its header does not begin with {','.join(FIRST)}")
        for row in reader:
            if reader.line_num != len(rows) + 2:
                raise ValueError("found an empty line, or a line break inside a field")
            before = _checked(row, before)
            rows.append(row)
    except (ValueError, csv.Error) as error:
        return rows, f"line {reader.line_num}: {error}"
    return rows, ""


def _checked(row: Row, before: tuple[int, int]) -> tuple[int, int]:
    """Epoch and steps of a row; ValueError where it is none, or does not follow those `before`."""
    if None in row or None in row.values():  # as csv.DictReader has it
        raise ValueError("found more or fewer fields than the header has")
    now = int(row["epoch"]), int(row["env_steps"])
    if now[0] <= before[0] or now[1] < before[1]:
        raise ValueError(f"epoch and steps do not follow: found {now} after {before}")
    for column, field in row.items():
        value = float(field or 0)
        if column.endswith(SHARE) and not (0 <= value <= 1 or math.isnan(value)):
            raise ValueError(f"{column}: found {value:g}, allowed from 0 to 1")
    return now
