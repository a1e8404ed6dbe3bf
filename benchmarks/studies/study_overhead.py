"""What does a study cost beside its runs? Many runs of a toy: time per run, memory of the parent.

python -m benchmarks study_overhead --runs 1000 --jobs 2 --out docs/data/study_overhead.json
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from benchmarks.command import count, parser, python, write

FLAGS = {"env": "lqr", "hidden": 8, "steps_per_epoch": 60, "n_passes": 1, "total_timesteps": 60}
ALONE = 5  # plain runs to compare with


def study_file(folder: Path, runs: int) -> Path:
    """A study of as many seeds of LQR."""
    flags = "\n".join(f"{name} = {json.dumps(value)}" for name, value in FLAGS.items())
    path = folder / "study.toml"
    path.write_text(f'name = "many"\n[grid]\nseed = "0-{runs - 1}"\n[setups.lqr]\n{flags}\n')
    return path


def alone(folder: Path) -> float:
    """Seconds of a plain `tactilerl train`, the process's start included."""
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in FLAGS.items()]
    seconds = []
    for index in range(ALONE):
        started = time.perf_counter()
        python("-m", "tactilerl", "train", *flags, "--workers=1", f"--out={folder / str(index)}")
        seconds.append(time.perf_counter() - started)
    return median(seconds)


def measure(runs: int, jobs: int) -> dict[str, Any]:
    """Seconds per run and job, and the parent's memory over time, MB."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain = alone(folder)
        command = [sys.executable, "-m", "tactilerl", "study", "run", str(study_file(folder, runs))]
        command += ["--jobs", str(jobs), "--out", str(folder / "study")]
        started, memory = time.perf_counter(), []
        study = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert study.stdout is not None
        for line in study.stdout:
            if line.startswith("["):
                memory.append(psutil.Process(study.pid).memory_info().rss / 1e6)
        if study.wait():
            raise SystemExit(f"study run ended with exit code {study.returncode}")
        each = (time.perf_counter() - started) * jobs / runs
    quarter = max(1, len(memory) // 4)
    return {
        "runs": runs,
        "jobs": jobs,
        "train_alone_s": plain,
        "run_of_study_s": each,
        "memory_first_quarter_mb": median(memory[:quarter]),
        "memory_last_quarter_mb": median(memory[-quarter:]),
    }


def main() -> None:
    """Measure, show, write."""
    flags = parser(__doc__)
    flags.add_argument("--runs", type=count, default=1000)
    flags.add_argument("--jobs", type=count, default=2)
    options = flags.parse_args()
    result = measure(options.runs, options.jobs)
    print(json.dumps(result, indent=1))
    write(options.out, result)
