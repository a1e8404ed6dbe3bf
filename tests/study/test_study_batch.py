"""`study run --on gpu`, on MuJoCo in a loop in place of a GPU."""

import json
import shutil
from importlib.util import find_spec

import pytest
import torch
from tactilerl.commands.cli import main
from tactilerl.runs.config import FINAL_TEST
from tactilerl.study import batch, grid, records
from tactilerl.study.records import StudyFiles
from tests.one_line import fails_with
from tests.tiny_study import write

STUDY = """
name = "small"
[grid]
layout = ["1", "2"]
seed = "0-1"
[setups.ppo]
scene = "handover_anywhere"
env = "mpl"
simulator = "mujoco"
algo = "ppo"
recipe = "robust"
hidden = [8]
steps_per_epoch = 60
total_timesteps = 100
n_test_episodes = 2
[setups.ddpg_her]
scene = "handover_anywhere"
env = "mpl"
simulator = "mujoco"
algo = "ddpg_her"
recipe = "robust"
hidden = [8]
n_cycles = 1
n_batches = 2
batch_size = 8
n_test_rollouts = 1
total_timesteps = 100
n_test_episodes = 2
grid = {touch = ["on", "off"], seed = 0}
compare = {touch = ["on", "off"]}
[setups.bullet]
env = "mpl"
simulator = "pybullet"
grid = {seed = 0}
"""


@pytest.fixture
def in_a_loop(monkeypatch, trained_here):
    monkeypatch.setattr(batch, "DEVICE", "loop")
    monkeypatch.setattr(batch, "SPARE", 0.5)


def test_a_study_of_batches_has_the_folders_of_any_study(tmp_path, in_a_loop, capsys):
    out, study = tmp_path / "out", write(tmp_path, STUDY)
    args = ["study", "run", str(study), "--out", str(out), "--on", "gpu", "--jobs", "1"]
    assert main(args) == 0
    said = capsys.readouterr().out
    assert "not on a GPU: bullet_s0: simulator of a batch: found 'pybullet'" in said
    all_records = [one for one in records.load(out)[1] if one.run.setup != "bullet"]
    logs = "".join(path.read_text() for path in sorted((out / "runs").glob("*.log")))
    assert "batch mpl ppo: 4 runs" in logs
    assert "batch mpl ddpg_her: 2 runs" in logs
    assert [one.state for one in all_records] == 6 * ["done"]
    for one in all_records:
        (made,) = one.config["provenance"]
        assert made["batch"]["runs"] == (4 if one.run.setup == "ppo" else 2)
    assert main(["study", "status", str(out)]) == 0
    files = StudyFiles(out)
    for one in all_records[::3]:
        run_dir = str(files.run_dir(one.run).path)
        capsys.readouterr()
        assert main(["evaluate", run_dir, "--episodes", "2", "--workers", "1", "--json"]) == 0
        tested = files.run_dir(one.run).rows()[-1][FINAL_TEST]
        assert json.loads(capsys.readouterr().out)["success_rate"] == tested
        args = ["train", "--resume", run_dir, "--total-timesteps", "140", "--workers", "1"]
        fails_with(capsys, args, "anneals")
    capsys.readouterr()


@pytest.mark.skipif(find_spec("distributed") is None, reason="no Dask")
def test_a_worker_of_dask_trains_a_batch(tmp_path, in_a_loop, monkeypatch, capsys):
    import distributed

    text = STUDY.partition("[setups.ddpg_her]")[0]
    study, out = write(tmp_path, text), tmp_path / "out"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        args = ["study", "run", study, "--out", out, "--on", f"dask-gpu:{cluster.scheduler_address}"]
        assert main([*map(str, args)]) == 0
        fails_with(capsys, [*args, "--jobs", "2"], "--jobs: found 2")
        monkeypatch.setattr(batch, "DEVICE", "cuda")
        fails_with(
            capsys, [*args[:4], tmp_path / "none", *args[5:]], "--on dask-gpu:", "worker", "found no"
        )
        assert not (tmp_path / "none").exists()
    (log,) = (out / "runs").glob("*.log")
    assert "batch mpl ppo: 4 runs" in log.read_text()
    assert [one.state for one in records.load(out)[1]] == 4 * ["done"]


@pytest.mark.slow
def test_a_batch_that_was_killed_goes_on_as_if_it_had_not_been(
    tmp_path, in_a_loop, monkeypatch, capsys
):
    """At another moment for each run: between their files."""
    text = STUDY.partition("[setups.bullet]")[0]
    study = write(tmp_path, text.replace("= 100", "= 200"))
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run = ["study", "run", str(study), "--on", "gpu", "--jobs", "1", "--out"]
    assert main([*run, str(whole)]) == 0
    monkeypatch.setattr(batch, "SAVE_EVERY", 0.0)
    save, saves = batch.Checkpoint.save, []

    def dies(self, epoch):
        saves.append(epoch)
        if len(saves) in (11, 23):
            raise KeyboardInterrupt
        save(self, epoch)

    with monkeypatch.context() as patch:
        patch.setattr(batch.Checkpoint, "save", dies)
        codes = [main([*run, str(cut)]) for _ in range(3)]
    assert codes[-1] == 0
    assert any(codes)
    capsys.readouterr()
    for one in grid.read(study).runs():
        first, second = (StudyFiles(out).run_dir(one) for out in (whole, cut))
        times = {"collect_s", "update_s", "steps_per_s"}
        tables = [
            [{k: v for k, v in row.items() if k not in times} for row in d.rows()]
            for d in (first, second)
        ]
        assert len(tables[0]) == len(tables[1])
        for want, got in zip(*tables, strict=True):
            assert got == pytest.approx(want, rel=1e-3, nan_ok=True)
        assert json.loads(second.config_file.read_text())["provenance"][0]["epoch"] == 0


def test_a_run_that_diverges_leaves_the_others_of_its_batch(tmp_path, in_a_loop, capsys):
    text = STUDY.partition("[setups.bullet]")[0]
    text = text.replace('touch = ["on", "off"], seed = 0}', "critic_lr = [1e-3, 1e30], seed = 0}", 1)
    study = write(tmp_path, text.replace('compare = {touch = ["on", "off"]}', ""))
    out = tmp_path / "out"
    assert main(["study", "run", str(study), "--out", str(out), "--on", "gpu", "--jobs", "1"]) == 1
    by_state = {one.run.name: one for one in records.load(out)[1]}
    failed = [name for name, one in by_state.items() if one.state == "failed"]
    assert len(failed) == 1
    assert [one.state for name, one in by_state.items() if name not in failed] == 5 * ["done"]
    assert "stopped: a loss or a parameter" in capsys.readouterr().out


def test_a_run_that_is_damaged_leaves_the_others_of_its_batch(tmp_path, in_a_loop, monkeypatch, capsys):
    study, out = write(tmp_path, STUDY.partition("[setups.ddpg_her]")[0]), tmp_path / "out"
    args = ["study", "run", str(study), "--out", str(out), "--on", "gpu", "--jobs", "1"]
    epoch = batch._Training.epoch

    def is_interrupted(self):
        epoch(self)
        self.save()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch._Training, "epoch", is_interrupted)
        assert main(args) == 1
    bad = out / "runs/ppo_layout-1_s1/checkpoint.pt"
    bad.write_bytes(bad.read_bytes()[:1000])
    assert main(args) == 1
    assert "failed: ppo_layout-1_s1: " in capsys.readouterr().out
    assert sorted(one.state for one in records.load(out)[1]) == [*3 * ["done"], "failed"]


def test_a_batch_that_is_interrupted_says_how_to_go_on(tmp_path, in_a_loop, monkeypatch, capsys):
    def ends(self, actions):
        raise KeyboardInterrupt

    monkeypatch.setattr(batch.BatchEnv, "step", ends)
    study = write(tmp_path, STUDY.partition("[setups.bullet]")[0])
    args = ["study", "run", str(study), "--out", str(tmp_path / "out"), "--on", "gpu", "--jobs", "1"]
    assert main(args) == 1
    assert "interrupted: 6; run the same command to go on" in capsys.readouterr().out


def test_a_full_gpu_leaves_runs_to_go_on(tmp_path, in_a_loop, monkeypatch, capsys):
    def is_full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB")

    study = write(tmp_path, STUDY.partition("[setups.ddpg_her]")[0])
    args = ["study", "run", str(study), "--out", str(tmp_path / "out"), "--on", "gpu", "--jobs", "1"]
    for where, name in ((batch, "BatchEnv"), (batch.BatchEnv, "step")):
        with monkeypatch.context() as patch:
            patch.setattr(where, name, is_full)
            assert main(args) == 1
        assert "interrupted: 4; run the same command to go on" in capsys.readouterr().out
    assert (
        "a batch has stopped: CUDA out of memory"
        in next((tmp_path / "out/runs").glob("*.log")).read_text()
    )
    assert main(args) == 0


def test_batches_have_room_and_are_of_one_size(tmp_path, monkeypatch):
    runs = grid.read(write(tmp_path, STUDY.partition("[setups.bullet]")[0])).runs()

    def sizes():
        return [len(one) for one in batch.form(runs)[0]]

    assert sizes() == [4, 2]
    worlds = batch.n_worlds(runs[0].config())
    monkeypatch.setattr(batch, "MAX_WORLDS", 3 * worlds)
    assert sizes() == [2, 2, 2]
    monkeypatch.setattr(batch, "MAX_REPLAY", 200 * batch.STEP_BYTES)  # twice the steps of one run
    assert sizes() == [2, 2, 1, 1]
    for n in (0.5, 1.7, 2.5, 3.5):  # what one batch trains is one batch
        monkeypatch.setattr(batch, "MAX_WORLDS", int(n * worlds))
        assert all(len(batch.form(one)[0]) == 1 for one in batch.form(runs)[0])


@pytest.mark.parametrize(
    ("flag", "said"),
    [
        ('object = "cone"', "object: found 'cone'"),
        ("no_flag = 3", "no_flag"),
        ("hidden = [0]", "hidden"),
        ('sensor = "nope.toml"', "nope.toml"),
        ('grid = {touch = ["on", "off"], sensor = ["fsr", "nope"]}', "nope"),
        ('layout = "nope.toml"', "nope.toml"),
    ],
)
def test_bad_input_is_said_as_without_a_gpu(tmp_path, in_a_loop, capsys, flag, said):
    """Of runs that can be in a batch, and of others."""
    setups = '[setups.good]\nenv = "mpl"\n[setups.bad]\nenv = "mpl"\n'
    study = write(tmp_path, f'name = "bad"\n{setups}{flag}')
    args = ["study", "run", study, "--out", tmp_path / "out"]
    assert fails_with(capsys, [*args, "--on", "gpu"], said) == fails_with(capsys, args, said)
    assert not (tmp_path / "out").exists()


def test_a_study_without_a_batch_is_refused(tmp_path, in_a_loop, capsys):
    study = write(tmp_path, "\n".join(['name = "toy"', "[setups.toy]", 'env = "lqr"']))
    args = ["study", "run", study, "--out", tmp_path / "out", "--on", "gpu"]
    fails_with(capsys, args, "toy_s0: env: found lqr", "leave out --on")
    assert not (tmp_path / "out").exists()


def test_what_one_batch_cannot_train_is_one_line(tmp_path, in_a_loop, capsys):
    study, out = write(tmp_path, STUDY), tmp_path / "out"
    records.StudyFiles(out).create(grid.read(study))
    train = ["study", "train", out, "--batch"]
    names = [run.name for run in grid.read(study).runs()]
    fails_with(capsys, [*train, *names[:1], "bullet_s0"], "run bullet_s0", "found 'pybullet'")
    one, other = (next(n for n in names if n.startswith(kind)) for kind in ("ppo", "ddpg_her"))
    fails_with(capsys, [*train, one, other], "--batch: found 2 batches in these runs, allowed 1")
    args = ["study", "run", study, "--out", tmp_path / "new", "--on", "gpu", "--ranks-per-run", "2"]
    fails_with(capsys, args, "--ranks-per-run: found 2, allowed 1 on a GPU")


def test_without_a_gpu_nothing_is_written(tmp_path, capsys):
    args = ["study", "run", write(tmp_path, STUDY), "--out", tmp_path / "out", "--on", "gpu"]
    has_extra = shutil.which("nvidia-smi") or torch.cuda.is_available()
    if has_extra:
        pytest.skip("there is one")
    fails_with(capsys, args, "gpu")
    assert not (tmp_path / "out").exists()
