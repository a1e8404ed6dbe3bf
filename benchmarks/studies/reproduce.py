"""Train a run of a collected study again, and compare every epoch bit for bit.

    python -m benchmarks reproduce docs/data/handover.tar.gz RUN

The same bits need the same machine and versions, so both versions are printed. Exit code 1
where an epoch differs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from tactilerl.envs.validation import nearest
from tactilerl.errors import InputError
from tactilerl.runs.progress_csv import TIMES
from tactilerl.study import records, runner

from benchmarks.command import ROOT


def differences(before: list[dict[str, str]], after: list[dict[str, str]]) -> list[str]:
    """Epoch and column of every number that is not the same; times are none of them."""
    found = []
    for old, new in zip(before, after, strict=False):
        known = {name: value for name, value in old.items() if value and name not in TIMES}
        found += [
            f"epoch {old['epoch']}, {name}: {value} -> {new.get(name)}"
            for name, value in known.items()
            if value != new.get(name)
        ]
    if len(before) != len(after):
        found.append(f"{len(before)} epochs -> {len(after)}")
    return found


def main() -> int:
    """Train the run anew, in a folder that goes again."""
    flags = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    flags.add_argument("study", type=Path, help="a collected file, or a study's folder")
    flags.add_argument("run", help="name of a run in it, such as handover_layout-2_touch-on_s0")
    options = flags.parse_args()
    found = {one.run.name: one for one in records.load(options.study)[1] if one.state == "done"}
    if options.run not in found:
        hint = nearest(options.run, found)
        raise InputError(f"run: found {options.run!r}; {hint}allowed: a finished run of the study")
    before = found[options.run]
    config = before.config or {}
    with tempfile.TemporaryDirectory() as folder:
        files = records.StudyFiles(Path(folder))
        (files.path / records.RUNS).mkdir()
        job = runner.RunJob(files.path, before.run, config.get("ranks", 1))
        done = subprocess.run(
            job.command(sys.executable, "-m", "tactilerl"), cwd=ROOT, stdout=subprocess.DEVNULL
        )
        if done.returncode:  # it has said why
            return done.returncode
        after = files.record(before.run)
    now = after.config or {}
    for when, record in (("before", config), ("now", now)):
        last = record["provenance"][-1]
        versions = ", ".join(f"{name} {number}" for name, number in sorted(last["versions"].items()))
        print(f"{when:7} commit {last['commit']}, {versions}")
    differing = differences(before.rows, after.rows)
    print("\n".join(differing[:5]) or f"{len(after.rows)} epochs: the same, bit for bit")
    return 1 if differing else 0
