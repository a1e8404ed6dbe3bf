"""Several processes: equal parameters on all ranks, one writer, and no rank left waiting."""

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from states import flat
from tiny_study import TINY, learned, write

from tactilerl.commands.cli import main
from tactilerl.study import records

pytest.importorskip("mpi4py")
MPIRUN = Path(sys.executable).with_name("mpirun")
pytestmark = [
    pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside this Python (extra: mpi)"),
    pytest.mark.usefixtures("one_launch"),
]
PARTS = ("whole", "parts")
REACH = ["train", "--algo", "ddpg_her", "--env", "point-reach", "--hidden", "16", "--n-cycles", "2"]
REACH += ["--n-batches", "5", "--n-test-rollouts", "1"]
TOY = ["train", "--env", "lqr", "--hidden", "16", "--steps-per-epoch", "240", "--n-passes", "2"]


def mpirun(args, ranks=2, timeout=400):
    command = [str(MPIRUN), "--oversubscribe", "-n", str(ranks), sys.executable, *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


def tactilerl(*args):
    return mpirun(["-m", "tactilerl", *args])


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    "toy", [pytest.param(TOY, marks=pytest.mark.slow), REACH], ids=["ppo", "ddpg_her"]
)
def test_two_ranks_train_one_writes_and_resume_is_exact(toy):
    whole = tactilerl(*toy, "--total-timesteps", "600", "--out", "whole")
    assert whole.returncode == 0, whole.stderr
    assert whole.stdout.count("The run is in whole") == 1
    assert json.loads(Path("whole/config.json").read_text())["ranks"] == 2
    tactilerl(*toy, "--total-timesteps", "200", "--out", "parts")
    resumed = tactilerl("train", "--resume", "parts", "--total-timesteps", "600")
    assert resumed.returncode == 0, resumed.stderr
    whole, parts = (torch.load(Path(run, "checkpoint.pt"), weights_only=True) for run in PARTS)
    # Whole epochs: of PPO 240 steps.
    assert [rank["env_steps"] for rank in whole["ranks"]] == 2 * [720 if toy is TOY else 600]
    for a, b in zip(whole["ranks"], parts["ranks"], strict=True):
        assert flat(a) == flat(b)
    first, second = whole["ranks"]
    assert flat(first) == flat(second)  # bit-equal parameters


@pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_ppo_learns_the_same_on_any_number_of_ranks(ranks):
    """The same episodes, and the same steps up to rounding; an epoch is not longer for it."""
    args = ["train", "--env", "lqr", "--hidden", "16", "--steps-per-epoch", "300", "--n-passes", "3"]
    args += ["--total-timesteps", "600"]
    assert main([*args, "--out", "1"]) == 0
    mpirun(["-m", "tactilerl", *args, "--out", "more"], ranks=ranks)
    tables = []
    for run in ("1", "more"):
        with open(f"{run}/progress.csv", newline="") as file:
            tables.append([{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)])
    one, more = tables
    assert [row["env_steps"] for row in one] == [300, 600]
    for key in ("env_steps", "episodes", "mean_return", "policy_loss", "value_loss", "kl"):
        np.testing.assert_allclose(
            [row[key] for row in more], [row[key] for row in one], rtol=1e-3, atol=1e-4
        )
    assert more[0]["mean_return"] == one[0]["mean_return"]  # before anything was learned


@pytest.mark.slow
def test_ddpg_reaches_points_from_sparse_rewards_on_two_ranks():
    args = ["train", "--algo", "ddpg_her", "--env", "point-reach", "--hidden", "64", "64"]
    args += ["--action-l2", "0.1", "--polyak", "0.9", "--batch-size", "128", "--n-cycles", "10"]
    result = tactilerl(*args, "--n-test-rollouts", "1", "--total-timesteps", "12000", "--out", "run")
    assert result.returncode == 0, result.stderr
    command = [sys.executable, "-m", "tactilerl", "evaluate", "run", "--episodes", "200", "--json"]
    evaluated = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(evaluated.stdout)["success_rate"] >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("toy", ["ppo", "ddpg_her"])
def test_another_number_of_ranks_is_refused_unless_asked_for(toy, capsys):
    toy = TOY if toy == "ppo" else REACH
    tactilerl(*toy, "--total-timesteps", "1", "--out", "run")
    resume = ["train", "--resume", "run"]
    assert main([*resume, "--total-timesteps", "800"]) == 2
    assert "ranks: found 1, the run was made with 2" in capsys.readouterr().err
    assert main([*resume, "--total-timesteps", "800", "--any-ranks"]) == 0
    if toy is REACH:  # four episodes of each of two ranks, and those that followed, all with rank 0
        parts = [torch.load(path, weights_only=True) for path in Path("run/experience").iterdir()]
        steps = torch.load("run/checkpoint.pt", weights_only=True)["ranks"][0]["env_steps"]
        assert 25 * sum(len(p["experience"]["slots"]) for p in parts) == steps == 800
    more = [*resume, "--total-timesteps", "1600", "--any-ranks"]
    three = mpirun(["-m", "tactilerl", *more], ranks=3)
    assert three.returncode == 0, three.stderr
    assert json.loads(Path("run/config.json").read_text())["ranks"] == 3


def test_bad_input_on_one_rank_ends_all():
    Path("taken").mkdir()
    Path("taken/notes.txt").touch()  # it holds no run
    started = time.monotonic()
    result = tactilerl(*TOY, "--out", "taken")
    assert result.returncode == 2
    assert "'taken' exists" in result.stderr
    assert time.monotonic() - started < 60


# A goal environment with a fault: after 40 steps rank 1 sees what is not a number, or raises.
FAULTY = """
import os
import gymnasium as gym
import numpy as np
from tactilerl.envs.toy import PointReachEnv

class Faulty(PointReachEnv):
    calls = 0
    def step(self, action):
        Faulty.calls += 1
        obs, *rest = super().step(action)
        if Faulty.calls > 40 and os.environ["OMPI_COMM_WORLD_RANK"] == "1":
            if os.environ["FAULT"] == "raise":
                raise RuntimeError("the cable came off")
            obs["observation"] = obs["observation"] * np.nan
        return obs, *rest

gym.register("Faulty-v0", entry_point=Faulty)
"""


@pytest.mark.parametrize("fault", ["nan", pytest.param("raise", marks=pytest.mark.slow)])
def test_a_fault_on_one_rank_ends_all_with_the_reason(fault, monkeypatch):
    Path("faulty.py").write_text(FAULTY)
    monkeypatch.setenv("PYTHONPATH", str(Path.cwd()))
    monkeypatch.setenv("FAULT", fault)
    args = ["faulty:Faulty-v0" if arg == "point-reach" else arg for arg in REACH]
    started = time.monotonic()
    result = tactilerl(*args, "--out", "run")
    assert result.returncode == 1
    reason = {"nan": "observation of the environment is not finite", "raise": "the cable came off"}
    assert reason[fault] in result.stderr
    assert time.monotonic() - started < 60


def start(*args):
    """A run in the background that has written its first checkpoint."""
    command = [str(MPIRUN), "--oversubscribe", "-n", "2", sys.executable, "-m", "tactilerl"]
    process = subprocess.Popen([*command, *args, "--out", "run"], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not Path("run/checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    return process


def ranks_of(process):
    """The ranks that mpirun started: Pythons below it that run our command."""
    below = psutil.Process(process.pid).children(recursive=True)
    return [p for p in below if "tactilerl" in p.cmdline() and "python" in p.name()]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["kill -9 of a rank", "Ctrl-C"])
def test_an_end_from_outside_ends_all_and_loses_nothing(how):
    args = [*REACH, "--total-timesteps", "1000"]
    process = start(*args)
    ranks = ranks_of(process)
    assert len(ranks) == 2
    if how == "Ctrl-C":
        process.send_signal(signal.SIGINT)
    else:
        ranks[1].kill()
    _, errors = process.communicate(timeout=10)
    assert process.returncode != 0
    if how != "Ctrl-C":
        assert "signal 9" in errors
    _, alive = psutil.wait_procs(ranks, timeout=10)
    assert not [rank for rank in alive if rank.status() != psutil.STATUS_ZOMBIE]
    assert tactilerl("train", "--resume", "run").returncode == 0
    assert tactilerl(*args, "--out", "whole").returncode == 0
    whole, run = (torch.load(Path(p, "checkpoint.pt"), weights_only=True) for p in ("whole", "run"))
    assert [flat(a) for a in whole["ranks"]] == [flat(b) for b in run["ranks"]]


def test_two_ranks_equal_one_with_both_batches():
    """Gradients averaged over two ranks with batch B take the steps of one with batch 2 B."""
    code = """
import numpy as np, torch
from tactilerl.algos import mpi
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl import envs
from tactilerl.envs import vector
world, alone = mpi.world(), mpi.Communicator()
pool = vector.start(lambda: envs.make("point-reach"))
config = DDPGHERConfig(hidden=(32, 32), reduction="mean")
halves, both = (DDPGHER(config, pool, comm, 0, 1) for comm in (world, alone))
rng = np.random.default_rng(0)
for _ in range(50):
    parts = [torch.from_numpy(rng.standard_normal(shape).astype(np.float32))
             for shape in ((64, 4), (64, 2), (64,))]
    mine = slice(32 * world.rank, 32 * world.rank + 32)
    halves._minibatch(*(part[mine].contiguous() for part in parts))
    both._minibatch(*parts)
assert mpi.same_on_all_ranks(world, halves.adam.vector)
start = DDPGHER(config, pool, alone, 0, 1).adam.vector
moved = (both.adam.vector - start).norm()
assert (both.adam.vector - halves.adam.vector).norm() < 1e-3 * moved
# and the normaliser has seen one stream
rows = 1e6 + rng.standard_normal((5, 2, 10, 2))
for both_rows in rows:
    halves.goal_stats.update(both_rows[world.rank])
    both.goal_stats.update(both_rows.reshape(-1, 2))
np.testing.assert_allclose(halves.goal_stats.std, both.goal_stats.std, rtol=1e-9)
"""
    Path("check.py").write_text(code)
    result = mpirun(["check.py"])
    assert result.returncode == 0, result.stderr


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
assert min(comm.all_gather(5 - comm.rank)) == 3
assert comm.all_gather(comm.rank) == [0, 1, 2]
assert list(comm.receive(comm.rank)) == ([0, 1, 2] if comm.rank == 0 else [])
assert comm.local_size == 3
assert mpi.same_on_all_ranks(comm, torch.ones(3))
assert not mpi.same_on_all_ranks(comm, torch.full((3,), float(comm.rank)))
"""
    Path("check.py").write_text(code)
    result = mpirun(["check.py"], ranks=3)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_two_ranks_play_the_grasps_of_one():
    pytest.importorskip("sklearn")
    args = ["probe", "--env", "mpl", "--simulator", "mujoco", "--layout", "5", "--object-size", "0.05"]
    args += ["--grasps", "14", "--closing", "0.4", "1.1", "--joint-noise", "0", "--folds", "2"]
    args += ["--resamples", "100", "--shuffles", "2", "--workers", "1", "--json", "--out"]
    alone = subprocess.run(
        [sys.executable, "-m", "tactilerl", *args, "1"], capture_output=True, text=True, timeout=400
    )
    both = tactilerl(*args, "2")
    assert both.returncode == 0, both.stderr
    assert json.loads(both.stdout) == json.loads(alone.stdout)
    with np.load("1/grasps.npz") as one, np.load("2/grasps.npz") as two:
        assert set(one.files) == set(two.files)
        assert all(np.array_equal(one[name], two[name]) for name in one.files if name != "settings")


@pytest.mark.slow
def test_a_study_over_the_ranks_of_a_launch(tmp_path):
    study = ["study", "run", str(write(tmp_path)), "--out"]
    assert main([*study, "alone", "--jobs", "2"]) == 0
    shown = tactilerl(*study, "together")
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert "[2/2]" in shown.stdout
    assert learned(Path("together")) == learned(Path("alone"))


def test_several_ranks_for_each_run_of_a_study(tmp_path):
    text = TINY.replace("polyak = [0.9, 0.95]\n", "").replace("polyak = [0.95, 0.9]\n", "")
    args = ["study", "run", str(write(tmp_path, text)), "--out", "out"]
    assert main([*args, "--ranks-per-run", "2"]) == 0
    _, (record,) = records.load(Path("out"))
    assert record.config["ranks"] == 2
