"""Studies whose runs were never trained: what they left behind is made up, for tests of reports."""

import csv
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from tactilerl import machine
from tactilerl.runs.store import FORMAT
from tactilerl.study import grid
from tactilerl.study.records import StudyFiles

PAPER_LIKE = (Path(__file__).parent / "studies/made_up.toml").read_text()
LEVEL = {"layout 1": 0.7, "layout 2": 0.85, "layout 5": 0.5, "sighted": 0.95}


def make_study(path, text=PAPER_LIKE, n_seeds=4):
    """A study's folder with all runs done; main runs rise higher the better their layout."""
    text = text.replace("{last}", str(n_seeds - 1))
    path.with_suffix(".toml").write_text(text)
    shutil.copytree(_made(text).name, path, dirs_exist_ok=True)
    return StudyFiles(path)


def interrupt(folder, run, rows=20):
    """A run that has not come to its end."""
    path = folder.run_dir(run).table
    path.write_text("".join(path.read_text().splitlines(keepends=True)[: rows + 1]))


def fail(folder, run, reason="diverged"):
    """A run that failed."""
    interrupt(folder, run)
    folder.write_failure(run, reason)


@cache
def _made(text):
    """A temporary folder with it: configuring the runs takes most of the time."""
    made = tempfile.TemporaryDirectory(prefix="tactilerl-tests-")
    file = Path(made.name, "study.toml")
    file.write_text(text)
    study, folder = grid.read(file), StudyFiles(Path(made.name))
    file.unlink()
    runs = study.runs()
    configs = {run.name: run.config() for run in runs}
    folder.create(study)
    made_with = [machine.origin()]
    for index, run in enumerate(runs):
        run_dir = folder.run_dir(run)
        run_dir.path.mkdir()
        content = {"format": FORMAT, **configs[run.name].as_dict(), "ranks": 1, "provenance": made_with}
        run_dir.config_file.write_text(json.dumps(content))
        steps = configs[run.name].run.total_timesteps
        write_progress(run_dir, run, np.random.default_rng(index), steps)
    return made


def write_progress(run_dir, run, rng, total, epochs=25):
    """A curve that rises to its level, with noise."""
    level = LEVEL.get(run.setting, 0.6) if run.group in ("on", "0.95") else LEVEL.get(run.setup, 0.55)
    level += rng.normal(0, 0.05)
    with run_dir.table.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        columns = "epoch env_steps success_rate test_success_rate final_test_success_rate diverged"
        writer.writerow([*columns.split(), "steps_per_s"])
        for epoch in range(1, epochs + 1):
            rate = level * (1 - np.exp(-epoch / 5)) + rng.normal(0, 0.03)
            rate = float(np.clip(rate, 0, 1))
            steps = round(epoch * total / epochs) + int(rng.integers(0, 20))
            tested = rate if epoch == epochs else ""
            writer.writerow([epoch, steps, rate, rate, tested, 0.0, 100.0])
