"""Running studies: each run once and to its end, whatever is killed, on any executor."""

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import filelock
import psutil
import pytest
from tactilerl.commands.cli import main
from tactilerl.envs import plugins
from tactilerl.runs.store import Checkpoint
from tactilerl.study import grid, jobs, records
from tactilerl.study.records import StudyFiles

from one_line import fails_with, printed
from study_records import interrupt, make_study
from tiny_study import TINY, learned, trained, write

CHOSEN = Path(__file__).resolve().parents[2] / "docs/data/chosen"
GRIPPER = Path(__file__).parents[1] / "hands/gripper.toml"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """TINY, run in one go."""
    return trained(tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture
def copied(undisturbed, tmp_path):
    """The same in a folder that a test may change."""
    shutil.copytree(undisturbed, tmp_path / "out")
    return StudyFiles(tmp_path / "out")


class TestRun:
    def test_every_run_is_done_and_nothing_is_left_to_do(self, undisturbed, tmp_path, capsys):
        assert "│ reach  │ 2    │ 0      │" in printed(capsys, ["study", "status", undisturbed])
        for table in undisturbed.glob("runs/*/progress.csv"):  # tested, from the same starts
            *others, last = csv.DictReader(table.open())
            assert {row["final_test_success_rate"] for row in others} == {""}
            run = str(table.parent)
            told = json.loads(printed(capsys, ["evaluate", run, "--episodes", 3, "--json"]))
            assert float(last["final_test_success_rate"]) == told["success_rate"]
        before = {p: p.stat().st_mtime_ns for p in undisturbed.rglob("progress.csv")}
        assert len(before) == 2
        again = ["study", "run", write(tmp_path), "--out", undisturbed]
        assert "2 runs, 0 to do" in printed(capsys, again)
        assert {p: p.stat().st_mtime_ns for p in undisturbed.rglob("progress.csv")} == before

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ("n_batches = 2", "n_batches = 3", "n_batches: found 3"),
            ('"tiny"', '"other"', "holds tiny, not the study 'other'"),
        ],
    )
    def test_another_run_or_study_is_refused(self, undisturbed, tmp_path, capsys, old, new, words):
        before = (undisturbed / "study.json").read_bytes()
        args = ["study", "run", write(tmp_path, TINY.replace(old, new)), "--out", undisturbed]
        fails_with(capsys, args, words)
        assert (undisturbed / "study.json").read_bytes() == before

    def test_a_folder_that_holds_something_else_is_refused(self, tmp_path, capsys):
        (tmp_path / "thesis.tex").write_text("")
        fails_with(capsys, ["study", "run", write(tmp_path), "--out", tmp_path], "holds no study")

    def test_a_study_file_is_no_folder_of_runs(self, tmp_path, capsys):
        fails_with(capsys, ["study", "status", write(tmp_path)], "a study file, allowed the folder")

    def test_copied_folders_of_runs_are_a_merged_study(self, undisturbed, tmp_path, capsys):
        runs = StudyFiles(undisturbed).study().runs()
        for place, run in zip("ab", runs, strict=True):
            StudyFiles(tmp_path / place).create(StudyFiles(undisturbed).study())
            folder = f"runs/{run.name}"
            shutil.copytree(undisturbed / folder, tmp_path / place / folder)
        states = [[one.state for one in records.load(tmp_path / place)[1]] for place in "ab"]
        assert states == [["done", "left"], ["left", "done"]]
        shutil.copytree(tmp_path / "a/runs", tmp_path / "b/runs", dirs_exist_ok=True)  # as rsync does
        args = ["study", "run", write(tmp_path), "--out", tmp_path / "b"]
        assert "2 runs, 0 to do" in printed(capsys, args)
        assert learned(tmp_path / "b") == learned(undisturbed)

    def test_a_run_by_its_name(self, undisturbed, copied, capsys):
        run = copied.study().runs()[0]
        shutil.rmtree(copied.run_dir(run).path)
        args = ["study", "train", str(copied.path), run.name]
        assert main(args) == main(args) == 0
        assert learned(copied.path) == learned(undisturbed)
        fails_with(capsys, args[:-1], "run: found none, allowed one name or more")

    def test_a_run_that_is_cut_off_before_its_last_checkpoint_goes_on(
        self, undisturbed, copied, trained_here, tmp_path, monkeypatch
    ):
        """Its table has come to its end by then."""
        run = copied.study().runs()[0]
        shutil.rmtree(copied.run_dir(run).path)
        args = ["study", "run", str(write(tmp_path)), "--out", str(copied.path), "--jobs", "1"]
        save = Checkpoint.save

        def dies(self, epoch):
            if self.learner.env_steps >= self.learner.total_timesteps:
                raise KeyboardInterrupt
            save(self, epoch)

        with monkeypatch.context() as patch:
            patch.setattr(Checkpoint, "save", dies)
            assert main(args) == 1
        assert len(copied.run_dir(run).rows()) == len(StudyFiles(undisturbed).run_dir(run).rows())
        assert copied.record(run).state == "interrupted"
        assert main(args) == 0
        assert learned(copied.path) == learned(undisturbed)


class TestBeforeItStarts:
    def test_a_module_in_a_study_file_is_imported_by_users_alone(self, tmp_path, capsys, monkeypatch):
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr(plugins, "imported", [])
        (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'pwned')!r}, 'w')")
        text = 'name = "x"\n[setups.x]\nenv = "evil:x-v0"\n'
        args = ["study", "run", write(tmp_path, text), "--out", tmp_path / "out"]
        fails_with(capsys, args, "the module evil", "--import evil")
        assert not (tmp_path / "pwned").exists()
        fails_with(capsys, [*args, "--import", "evil"], "x-v0")
        assert (tmp_path / "pwned").exists()

    def test_a_measure_that_the_learner_does_not_have(self, tmp_path, capsys):
        text = 'name = "x"\nmeasure = "test_success_rate"\n[setups.x]\nenv = "lqr"\n'
        args = ["study", "run", write(tmp_path, text), "--out", tmp_path / "out"]
        fails_with(capsys, args, "measure: found test_success_rate, but the run has no tests")

    def test_a_score_without_its_tests(self, tmp_path, capsys):
        text = 'name = "x"\nscore = "test"\n[setups.x]\nenv = "lqr"\nn_test_episodes = 0\n'
        args = ["study", "run", write(tmp_path, text), "--out", tmp_path / "out"]
        fails_with(capsys, args, "score: found test, but n_test_episodes is 0")

    def test_a_layout_that_was_changed_since(self, tmp_path, capsys):
        layout = tmp_path / "own.toml"
        shutil.copy(CHOSEN / "shadow_touch_4.toml", layout)
        text = f'name = "x"\n[setups.x]\nenv = "shadow"\nlayout = "{layout}"\ntotal_timesteps = 1\n'
        text += "steps_per_epoch = 1\nhidden = [8]\nn_passes = 1\nmax_episode_steps = 2\n"
        text += "n_test_episodes = 1\n"
        out = trained(tmp_path, text)
        args = ["study", "run", tmp_path / "study.toml", "--out", out]
        assert "0 to do" in printed(capsys, args)
        layout.rename(tmp_path / "away.toml")
        assert "0 to do" in printed(capsys, args)  # each run has its own copy
        shutil.copy(CHOSEN / "shadow_touch_8.toml", layout)
        fails_with(capsys, args, "own.toml: found other taxels than when this run began")
        run = str(next((out / "runs").glob("x_*[0-9]")))
        assert main(["train", "--resume", run, "--total-timesteps", "2"]) == 0  # with its own

    def test_a_hand_that_was_changed_since(self, tmp_path, capsys):
        hand = tmp_path / "own.toml"
        shutil.copy(GRIPPER.with_suffix(".xml"), tmp_path)
        text = GRIPPER.read_text()
        hand.write_text(text)
        study = f'name = "x"\n[setups.x]\nenv = "{hand}"\ntotal_timesteps = 1\n'
        study += 'simulator = "mujoco"\nsteps_per_epoch = 1\nhidden = [8]\nn_passes = 1\n'
        study += "max_episode_steps = 2\nn_test_episodes = 1\n"
        out = trained(tmp_path, study)
        args = ["study", "run", tmp_path / "study.toml", "--out", out]
        hand.write_text("# a comment\n" + text)
        assert "0 to do" in printed(capsys, args)
        hand.write_text(text.replace('_tip" = 0.4', '_tip" = 0.5'))
        fails_with(capsys, args, "own.toml: found another file than when this run began")

    @pytest.mark.parametrize(
        ("was", "now", "said"),
        [
            ("= 200", "= 100", "total_timesteps: found 100, allowed from 200"),
            ("_episodes = 3", "_episodes = 4", "n_test_episodes: found 4, the run has ended with a"),
        ],
    )
    def test_other_lengths_and_tests_than_those_of_runs_that_are_there(
        self, tmp_path, capsys, was, now, said
    ):
        out = trained(tmp_path)
        study = write(tmp_path, TINY.replace(was, now))
        fails_with(capsys, ["study", "run", study, "--out", out], said)


class TestFailures:
    @pytest.mark.parametrize("is_deadly", [True, False])
    def test_only_runs_that_kill_workers_are_recorded(self, tmp_path, monkeypatch, is_deadly):
        """Any other error ends the study, which goes on when it is run again."""
        files, study = StudyFiles(tmp_path / "out"), grid.read(write(tmp_path))
        files.create(study)
        error = type("KilledWorker" if is_deadly else "Other", (Exception,), {})

        def make_done(job):
            raise error("gone")

        monkeypatch.setattr(jobs, "make_done", make_done)
        todo = [jobs.Job(files.path, (run,)) for run in study.runs()]
        with ThreadPoolExecutor(1) as pool, nullcontext() if is_deadly else pytest.raises(error):
            jobs.run_all(todo, pool, lambda run: None)
        states = {files.record(run).state for run in study.runs()}
        assert states == {"failed" if is_deadly else "left"}

    def test_what_diverges_is_tried_twice_and_the_study_goes_on(self, tmp_path, capsys, trained_here):
        small = 'env = "lqr"\nhidden = [8]\nsteps_per_epoch = 60\nn_passes = 1\ntotal_timesteps = 60\n'
        small += "n_test_episodes = 1\n"
        text = f'name = "x"\n[setups.x]\n{small}critic_lr = 1e30\n[setups.y]\n{small}'
        run = ["study", "run", write(tmp_path, text), "--out", tmp_path / "out", "--jobs", "1"]
        said = printed(capsys, run, code=1)
        assert "failed: x_s0: stopped:" in said
        assert "[2/2] y_s0 done" in said
        assert (tmp_path / "out/runs/x_s0.log").read_text().count("study train: x_s0") == 2
        assert "2 runs, 0 to do" in printed(capsys, run, code=1)

    def test_damaged_runs_cost_a_line_and_nothing_is_lost(self, copied, trained_here, tmp_path, capsys):
        first, second = (copied.run_dir(run) for run in copied.study().runs())
        args = ["study", "run", write(tmp_path), "--out", tmp_path / "out", "--jobs", "1"]
        second.config_file.unlink()
        said = "exists but is not a run folder; choose another"
        assert said in printed(capsys, args, code=1)
        assert second.table.exists()
        first.config_file.write_text("{")
        assert [one.state for one in records.load(copied.path)[1]] == ["interrupted", "failed"]
        fails_with(capsys, args, "config.json: not a run's configuration")
        assert first.checkpoint_file.exists()

    @pytest.mark.skipif(sys.platform != "linux", reason="Linux only")
    def test_a_batch_of_many_runs_holds_a_lock_for_each(self, tmp_path, monkeypatch):
        import resource

        files = make_study(tmp_path / "out")
        job = jobs.Job(files.path, (*files.study().runs(),), is_batch=True)
        for run in job.runs:
            interrupt(files, run)
        trained_runs, (soft, most) = [], resource.getrlimit(resource.RLIMIT_NOFILE)
        monkeypatch.setattr(jobs, "_train", lambda _, job: trained_runs.extend(job.runs))
        resource.setrlimit(
            resource.RLIMIT_NOFILE, (psutil.Process().num_fds() + len(job.runs) // 2, most)
        )
        try:
            jobs.make_done(job)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, most))
        assert trained_runs == [*job.runs]

    def test_why_it_failed_is_of_this_attempt(self, tmp_path):
        log = tmp_path / "run.log"
        log.write_text("tactilerl: interrupted\nTraceback\nMemoryError\n")
        assert jobs.reason(1, log, 23) == "MemoryError (exit code 1)"
        assert jobs.reason(-9, log, 0) == "killed by signal 9 (Killed)"


def test_a_run_that_somebody_else_trains_is_left_to_them(copied, tmp_path, capsys, monkeypatch):
    """Without a process, a line in its log or a failure."""
    run = copied.study().runs()[0]
    copied.run_dir(run).table.unlink()
    log = copied.beside(run, "log").read_bytes()
    monkeypatch.setattr(jobs, "_process", None)
    monkeypatch.setattr(jobs, "LOCK_WAIT", 0)
    args = ["study", "run", write(tmp_path), "--out", copied.path]
    with filelock.FileLock(copied.beside(run, "lock")):
        assert copied.record(run).state == "running"
        assert "1 runs are trained by another" in printed(capsys, args)
    assert copied.record(run).state == "interrupted"
    assert copied.beside(run, "log").read_bytes() == log


@pytest.mark.parametrize("how", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)])
def test_however_a_study_ends_all_ranks_of_a_run_end_and_it_can_go_on(tmp_path, one_launch, how):
    study = write(tmp_path, TINY.replace("= 200", "= 100_000_000"))
    command = ["study", "run", study, "--out", tmp_path / "out", "--jobs", "1", "--ranks-per-run", "2"]
    process = subprocess.Popen([sys.executable, "-m", "tactilerl", *map(str, command)])
    while not list(tmp_path.glob("out/runs/*/progress.csv")):
        assert process.poll() is None
        time.sleep(0.05)
    below = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(how)
    assert process.wait() == (130 if how == signal.SIGINT else -how)
    assert len(below) >= 3  # mpirun, two ranks
    assert not psutil.wait_procs(below, timeout=300)[1]
    (config,) = tmp_path.glob("out/runs/*/config.json")
    assert json.loads(config.read_text())["ranks"] == 2
    folder = StudyFiles(tmp_path / "out")
    assert {folder.record(run).state for run in folder.study().runs()} == {"interrupted", "left"}
