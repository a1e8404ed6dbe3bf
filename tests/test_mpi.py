"""Several processes: equal parameters on all ranks, one writer, and no rank left waiting."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("mpi4py")
MPIRUN = Path(sys.executable).with_name("mpirun")
pytestmark = pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside this Python (extra: mpi)")
TOY = ["train", "--env", "lqr", "--hidden", "16", "--steps-per-epoch", "240", "--n-passes", "2"]


def mpirun(args, ranks=2, timeout=120):
    command = [str(MPIRUN), "--oversubscribe", "-n", str(ranks), sys.executable, *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


def tactilerl(*args):
    return mpirun(["-m", "tactilerl.cli", *args])


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_two_ranks_train_one_writes_and_resume_is_exact():
    whole = tactilerl(*TOY, "--total-timesteps", "960", "--out", "whole")
    assert whole.returncode == 0, whole.stderr
    assert whole.stdout.count("The run is in whole") == 1
    assert json.loads(Path("whole/config.json").read_text())["ranks"] == 2
    tactilerl(*TOY, "--total-timesteps", "480", "--out", "parts")
    assert tactilerl("train", "--resume", "parts", "--total-timesteps", "960").returncode == 0
    states = [Path(run, "checkpoint.pt") for run in ("whole", "parts")]
    code = (
        "import sys, torch; a, b = (torch.load(p, weights_only=True)['ranks'] for p in sys.argv[1:])\n"
        "for x, y in zip(a, b, strict=True):\n"
        "    for k in x['actor']: assert torch.equal(x['actor'][k], y['actor'][k])\n"
        "    assert x['rng'] == y['rng']\n"
        "assert all(torch.equal(a[0]['actor'][k], a[1]['actor'][k]) for k in a[0]['actor'])\n"
        "assert a[0]['rng'] != a[1]['rng']\n"
    )
    checked = subprocess.run([sys.executable, "-c", code, *states], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr


def test_another_number_of_ranks_is_refused():
    tactilerl(*TOY, "--total-timesteps", "1", "--out", "run")
    command = [sys.executable, "-m", "tactilerl.cli", "train", "--resume", "run"]
    alone = subprocess.run(command, capture_output=True, text=True)
    assert alone.returncode == 2
    assert "ranks: found 1, the run was made with 2" in alone.stderr


def test_bad_input_on_one_rank_ends_all():
    Path("taken").mkdir()
    started = time.monotonic()
    result = tactilerl(*TOY, "--out", "taken")
    assert result.returncode == 2
    assert "'taken' exists" in result.stderr
    assert time.monotonic() - started < 60


def test_reductions_agree_with_numpy():
    code = """
import numpy as np, torch
from tactilerl.algos import mpi
comm = mpi.world()
assert comm.size == 3
x = torch.arange(4.0) + comm.rank
comm.sum_(x)
assert x.tolist() == [3.0, 6.0, 9.0, 12.0]
y = torch.full((2,), float(comm.rank))
comm.broadcast_(y)
assert y.tolist() == [0.0, 0.0]
assert comm.sum(np.array([comm.rank, 1.0])).tolist() == [3.0, 3.0]
assert comm.average(comm.rank) == 1.0
assert comm.min(5 - comm.rank) == 3
assert comm.all_gather(comm.rank) == [0, 1, 2]
assert comm.gather(comm.rank) == ([0, 1, 2] if comm.rank == 0 else [])
assert comm.local_size == 3
assert mpi.same_on_all_ranks(comm, torch.ones(3))
assert not mpi.same_on_all_ranks(comm, torch.full((3,), float(comm.rank)))
"""
    Path("check.py").write_text(code)
    result = mpirun(["check.py"], ranks=3)
    assert result.returncode == 0, result.stderr
