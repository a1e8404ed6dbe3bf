"""Studies on engines other than this machine's cores: Dask's schedulers, and batch systems."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from importlib.util import find_spec

import pytest
from tactilerl.commands.cli import main
from tactilerl.study.executors import cluster

from one_line import fails_with
from tiny_study import TINY, learned, trained, write

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="no Dask")
needs_jobqueue = pytest.mark.skipif(find_spec("dask_jobqueue") is None, reason="no dask-jobqueue")
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
    while not (tmp_path / "where.json").exists() and scheduler.poll() is None:
        time.sleep(0.1)
    address, out = json.loads((tmp_path / "where.json").read_text())["address"], tmp_path / "out"

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


DIRECTIVES = {  # as the manual of each has them
    "slurm": ["#SBATCH -n 1", "#SBATCH --cpus-per-task=2", "#SBATCH --mem=3G", "#SBATCH -t 02:00:00"],
    "pbs": ["#PBS -l select=1:ncpus=2:mem=2862MB", "#PBS -l walltime=02:00:00"],
    "lsf": ["#BSUB -n 2", '#BSUB -R "span[hosts=1]"', "#BSUB -M 3000000", "#BSUB -W 02:00\n"],
    "sge": ["#$ -l h_rt=02:00:00", "#$ -N dask-worker"],
}


@needs_jobqueue
@pytest.mark.parametrize("on", DIRECTIVES)
def test_the_job_script_of_each_batch_system(on):
    """But for HTCondor, which wants to know the disk space by dask-jobqueue's configuration."""
    with cluster(on, 2, "02:00" if on == "lsf" else "02:00:00", "3GB") as system:
        script = system.job_script()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    for line in DIRECTIVES[on]:
        assert line in script
    assert "distributed.cli.dask_worker tcp://" in script
    assert re.findall(r"--nthreads (\d+)", script)[-1] == "1"  # the last one counts


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--on", "moon"], ["'moon'", "slurm", "dask:ADDRESS"]),
        (["--on", "slurm"], ["--jobs N"]),
        (["--walltime", "1:00:00"], ["--walltime", "slurm"]),
    ],
)
def test_flags_that_do_not_fit(tmp_path, capsys, flags, words):
    fails_with(capsys, ["study", "run", write(tmp_path), "--out", tmp_path / "out", *flags], *words)


@needs_jobqueue
@pytest.mark.skipif(shutil.which("sbatch") is not None, reason="a machine with Slurm")
def test_a_batch_system_that_is_not_here(tmp_path, capsys):
    args = ["study", "run", write(tmp_path), "--out", tmp_path / "out"]
    args += ["--on", "slurm", "--jobs", "1", "--memory", "3GB"]
    said = fails_with(capsys, args, "--on slurm", "sbatch")
    assert said.count("--on slurm") == 1
