"""Studies on the machines of a Dask scheduler."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from importlib.util import find_spec

import pytest
from tactilerl.commands.cli import main

from one_line import fails_with
from tiny_study import TINY, learned, trained, write

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="no Dask")
# One run, since each of its processes imports PyTorch for seconds.
LONG = TINY.replace("= 200", "= 2000").replace("[0.9, 0.95]", "0.9")
LONG = LONG.replace("[compare]\npolyak = [0.95, 0.9]\n", "")


def test_a_study_on_dask_learns_what_it_learns_here(tmp_path, trained_here):
    import distributed

    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        out, on = tmp_path / "out", f"dask:{cluster.scheduler_address}"
        assert main(["study", "run", str(write(tmp_path)), "--out", str(out), "--on", on]) == 0
    (tmp_path / "local").mkdir()
    assert learned(out) == learned(trained(tmp_path / "local"))


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_no_bit(tmp_path):
    import distributed

    out = tmp_path / "out"
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        (worker,) = cluster.workers.values()
        killed = worker.pid

        def kill():
            while not any(p.stat().st_size > 500 for p in out.glob("runs/*/progress.csv")):
                time.sleep(0.02)
            os.kill(killed, signal.SIGKILL)

        threading.Thread(target=kill, daemon=True).start()
        on = f"dask:{cluster.scheduler_address}"
        assert main(["study", "run", str(write(tmp_path, LONG)), "--out", str(out), "--on", on]) == 0
        assert killed not in [worker.pid for worker in cluster.workers.values()]
    (tmp_path / "local").mkdir()
    assert learned(out) == learned(trained(tmp_path / "local", LONG))
    (log,) = out.glob("runs/*.log")
    assert log.read_text().count("resumed") == 1


def test_no_scheduler_there(tmp_path, capsys):
    import dask
    import distributed  # noqa: F401  (else its settings go with the one below)

    on = ["--on", "dask:tcp://127.0.0.1:9"]
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        args = ["study", "run", write(tmp_path), "--out", tmp_path / "x", *on]
        fails_with(capsys, args, " ".join(on))
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_a_scheduler_that_dies(tmp_path, capfd):
    import dask
    import distributed  # noqa: F401

    command = ["-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    command += ["--host", "127.0.0.1", "--scheduler-file", str(tmp_path / "where.json")]
    scheduler = subprocess.Popen([sys.executable, *command], stderr=subprocess.DEVNULL)
    where, out = tmp_path / "where.json", tmp_path / "out"
    while not (where.exists() and where.read_text()) and scheduler.poll() is None:
        time.sleep(0.1)
    address = json.loads(where.read_text())["address"]

    def kill():
        while not (out / "study.json").exists():
            time.sleep(0.1)
        time.sleep(1.0)  # so that its jobs are there
        scheduler.kill()

    threading.Thread(target=kill, daemon=True).start()
    args = ["study", "run", str(write(tmp_path)), "--out", str(out), "--on", f"dask:{address}"]
    try:
        with dask.config.set({"distributed.comm.timeouts.connect": "2s"}):
            assert main(args) == 1
    finally:
        scheduler.kill()
        scheduler.wait()
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"tactilerl: stopped: --on dask:{address}: Dask's scheduler has gone")


def test_a_place_that_is_none(tmp_path, capsys):
    args = ["study", "run", write(tmp_path), "--out", tmp_path / "out", "--on", "moon"]
    fails_with(capsys, args, "--on: found 'moon', allowed: local, gpu, dask:ADDRESS, dask-gpu:ADDRESS")
