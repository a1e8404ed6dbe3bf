"""Turn a collected study of version 0.3 (.csv.gz) into one that later versions read.

    python tools/convert_collected.py collected.csv.gz collected.tar.gz

The old file is a table: one row a study, then the epochs of every run, whose first has its state and
its config.json.
"""

from __future__ import annotations

import csv
import io
import sys
import tempfile
from pathlib import Path

from tactilerl.errors import InputError
from tactilerl.runs.files import damage_named, unzip
from tactilerl.study import records

FIXED = ("run", "state", "reason", "record")


def write(folder: Path, table: str) -> None:
    """The folder of the study that a collected table was made of."""
    first, *rows = csv.DictReader(io.StringIO(table, newline=""), strict=True)
    (folder / records.RUNS).mkdir()
    (folder / records.STUDY).write_text(first["record"])
    study = records.StudyFiles(folder).study()
    for run in study.runs():
        own = [row for row in rows if row["run"] == run.name]
        place, head = folder / records.RUNS / run.name, own[0]
        if head["record"] != "null":
            place.mkdir()
            (place / "config.json").write_text(head["record"])
        if head["state"] == "failed":
            records.StudyFiles(folder).write_failure(run, head["reason"])
        used = [
            name for name in head if name not in FIXED and any(row[name] for row in own)
        ]
        if used:
            with (place / "progress.csv").open("w", newline="") as file:
                writer = csv.DictWriter(
                    file, used, extrasaction="ignore", lineterminator="\n"
                )
                writer.writeheader()
                writer.writerows(own)


def main() -> int:
    """Read one, write the other."""
    if len(sys.argv) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    old, new = map(Path, sys.argv[1:])
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            damage_named(old, "not a collected study of 0.3"),
        ):
            write(Path(folder), unzip(old).decode())
            records.collect(Path(folder), out=new)
    except (InputError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
