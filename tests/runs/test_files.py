"""Damaged files are refused with one line; what is written is whole; runs keep what made them; what
others own is never lost: what writes a file takes a new name, or replaces one of its own."""

import io
import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
import tactilerl
import torch
from tactilerl import files
from tactilerl.commands.cli import main
from tactilerl.envs import plugins
from tactilerl.envs.grasp import GraspEnv
from tactilerl.errors import BUSY, InputError
from tactilerl.runs import store
from tactilerl.runs.store import RunDir

from one_line import HER, PPO, REACH, TOY, fails_with, python
from study_records import make_study
from tiny_study import TINY

RESUME = ["train", "--resume", "run"]
PART = Path("run/experience/00000001-0000.pt")
pytestmark = pytest.mark.usefixtures("in_tmp")
CHECKPOINT, TABLE, CONFIG = Path("run/checkpoint.pt"), Path("run/progress.csv"), Path("run/config.json")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of each algorithm, of three epochs and of one; one of a hand, and a study."""
    folder = tmp_path_factory.mktemp("made")
    assert main([*TOY, "--total-timesteps", "180", "--out", str(folder / "ppo")]) == 0
    her = ["train", *HER, "--env", "point-reach", "--total-timesteps", "50"]
    assert main([*her, "--out", str(folder / "her")]) == 0
    hand = ["train", *PPO, "--env", "mpl", "--simulator", "mujoco", *REACH, "--max-episode-steps", "1"]
    assert main([*hand, "--total-timesteps", "1", "--out", str(folder / "hand")]) == 0
    make_study(folder / "study", TINY)
    return folder


@pytest.fixture
def ppo(made):
    shutil.copytree(made / "ppo", "run")


@pytest.fixture
def her(made):
    shutil.copytree(made / "her", "run")


def edit(path, change):
    """Change what a file of tensors holds."""
    content = torch.load(path, weights_only=True)
    change(content)
    store.write_tensors(path, content)


class TestCheckpoint:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda content: content["ranks"][0].pop("actor"), "a policy alone, or of another"),
            (lambda content: content.update(format=2), "not a checkpoint of this version"),
        ],
    )
    def test_another_kind_of_content_is_refused(self, ppo, capsys, change, words):
        """As another version may have written it."""
        edit(CHECKPOINT, change)
        before = TABLE.read_bytes()
        fails_with(capsys, RESUME, "checkpoint.pt", words)
        assert TABLE.read_bytes() == before

    def test_a_file_that_is_cut_off_is_named_in_few_words(self, ppo, capsys):
        CHECKPOINT.write_bytes(CHECKPOINT.read_bytes()[:500])
        fails_with(capsys, RESUME, "not a checkpoint of this version (not an archive, or cut off)")

    def test_a_wrong_value_is_wrong_before_it_is_another_one(self, ppo, capsys):
        again = [*TOY, "--out", "run", "--clip-range", "-3"]
        fails_with(capsys, again, "clip_range: found -3.0, allowed")

    def test_what_needs_too_much_memory_is_one_line(self, capsys):
        more = ["--batch-size", str(10**13), "--total-timesteps", "50", "--out", "new"]
        command = ["train", *HER, "--env", "point-reach", *more]
        fails_with(capsys, command, "Unable to allocate", code=1)

    def test_policies_of_a_version_with_fewer_hyperparameters_are_read(self, her, capsys):
        config = json.loads(CONFIG.read_text())
        del config["learner"]["normalize_rewards"]
        CONFIG.write_text(json.dumps(config))
        assert main(["evaluate", "run", "--episodes", "2", "--workers", "1"]) == 0

    def test_experience_that_is_missing_or_of_something_else_is_refused(self, her, capsys):
        edit(PART, lambda content: content.update(experience={"episodes": 3}))
        fails_with(capsys, [*RESUME, "--total-timesteps", "200"], "checkpoint.pt: damaged")
        PART.unlink()
        fails_with(capsys, RESUME, f"{PART.name}: missing")
        assert main(["evaluate", "run", "--episodes", "1"]) == 0  # which needs none of it

    def test_missing_checkpoint_of_a_run_with_progress(self, ppo, capsys):
        before = TABLE.read_bytes()
        CHECKPOINT.unlink()
        fails_with(capsys, RESUME, "checkpoint.pt: missing, but")
        assert TABLE.read_bytes() == before


class TestProgress:
    @pytest.mark.parametrize(
        ("damage", "words"),
        [
            (lambda rows: b"a,b,c\n" + b"".join(rows[1:]), "damaged"),
            (lambda rows: b"".join([rows[0].replace(b"epoch", b"epok"), *rows[1:]]), "damaged"),
            (lambda rows: b"".join([rows[0], b"," + rows[1].partition(b",")[2], *rows[2:]]), "damaged"),
            (lambda rows: b"".join([*rows[:-1], b"\xff\xfe", rows[-1]]), "damaged"),
            (lambda rows: b"".join(rows[:-1]), "found epochs up to 2, the checkpoint's is 3"),
        ],
    )
    def test_a_damaged_table_is_refused_and_kept(self, ppo, capsys, damage, words):
        bad = damage(TABLE.read_bytes().splitlines(keepends=True))
        TABLE.write_bytes(bad)
        before = CHECKPOINT.read_bytes(), CONFIG.read_bytes()
        fails_with(capsys, [*RESUME, "--total-timesteps", "240"], "progress.csv", words)
        assert TABLE.read_bytes() == bad
        assert (CHECKPOINT.read_bytes(), CONFIG.read_bytes()) == before

    def test_rows_after_the_checkpoint_and_a_line_that_was_cut_off_go(self, ppo):
        rows = TABLE.read_bytes()
        TABLE.write_bytes(rows + rows.splitlines()[-1].replace(b"3,", b"4,", 1) + b"\n5,300,")
        assert main([*RESUME]) == 0
        assert TABLE.read_bytes() == rows


@contextmanager
def disk_of(n_bytes):
    """No file becomes longer than so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


class TestWriting:
    def test_what_a_killed_process_left_goes(self, ppo):
        left = Path("run", f".x{files.LEFTOVER}")
        left.touch()
        assert main([*RESUME, "--total-timesteps", "240"]) == 0
        assert not left.exists()

    def test_a_full_disk_leaves_the_run_as_it_was(self, ppo, capsys):
        before = CHECKPOINT.read_bytes()
        more = [*RESUME, "--total-timesteps", "240"]
        words = "stopped: [Errno 27] File too large", "the last checkpoint is kept"
        with disk_of(len(before) // 2):
            fails_with(capsys, more, *words, code=1)
        assert CHECKPOINT.read_bytes() == before
        assert not list(Path("run").rglob("*.tmp"))
        assert main(more) == 0

    def test_a_full_disk_in_the_midst_of_what_pytorch_writes(self):
        """Of a file that is larger than what it holds back."""
        with disk_of(100_000), pytest.raises(OSError, match="File too large"):
            store.write_tensors(Path("x.pt"), {"x": torch.zeros(10**6)})
        assert not list(Path().iterdir())

    def test_divergence_stops_with_the_last_checkpoint_kept(self, ppo, capsys):
        edit(CHECKPOINT, lambda content: content["ranks"][0]["critic"]["0.weight"].fill_(math.nan))
        before = CHECKPOINT.read_bytes()
        fails_with(capsys, [*RESUME, "--total-timesteps", "600"], "stopped: ", "not finite", code=1)
        assert CHECKPOINT.read_bytes() == before

    def test_where_nothing_can_be_written(self, tmp_path):
        Path("file").touch()
        for path in ("file/x", "missing/x", "x" * 300, "."):
            with pytest.raises(InputError, match="cannot write"), files.replacing(tmp_path / path):
                pass
        assert [path.name for path in tmp_path.iterdir()] == ["file"]


class TestLock:
    def test_a_second_process_is_refused_and_a_killed_one_lets_go(self, ppo, capsys):
        code = "import time; from pathlib import Path; from tactilerl.files import locked\n"
        code += "with locked(Path('run')): print(flush=True); time.sleep(60)"  # without PyTorch
        first = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        first.stdout.readline()
        more = [*RESUME, "--total-timesteps", "240"]
        before = TABLE.read_bytes()
        fails_with(capsys, more, f"process {first.pid} on ", "is writing to this folder", code=BUSY)
        fails_with(capsys, more, f"process {first.pid} on ", code=BUSY)  # not that of who asked
        assert TABLE.read_bytes() == before
        first.send_signal(signal.SIGKILL)
        first.communicate()
        assert main(more) == 0


class TestModules:
    @pytest.fixture
    def foreign(self, monkeypatch):
        """A run in an environment of somebody's module, which is not imported yet."""
        Path("theirs.py").write_text(
            "import gymnasium\nfrom tactilerl.envs.toy import LQREnv\n"
            "gymnasium.register('Id-v0', entry_point=LQREnv)\n"
        )
        monkeypatch.setattr(sys, "path", [*sys.path])
        monkeypatch.setattr(plugins, "imported", [])
        args = [*TOY, "--total-timesteps", "60", "--out", "run"]
        args[args.index("lqr")] = "theirs:Id-v0"
        monkeypatch.delitem(sys.modules, "theirs", raising=False)
        assert main(args) == 0
        monkeypatch.delitem(sys.modules, "theirs")
        plugins.imported.clear()

    @pytest.mark.parametrize("args", [["evaluate", "run", "--episodes", "1"], RESUME])
    def test_a_module_of_a_saved_run_is_imported_only_when_asked_for(self, foreign, capsys, args):
        fails_with(capsys, args, "of the module theirs", "give --import theirs")
        assert "theirs" not in sys.modules
        assert main([*args, "--import", "theirs"]) == 0


class TestConfig:
    @pytest.mark.parametrize(
        ("part", "name", "value", "words"),
        [
            ("run", "total_timesteps", "x", "total_timesteps: found 'x'"),
            ("learner", "hidden", [0], "hidden: found 0, allowed"),
            (None, "format", 2, "this version reads runs of 0.5.0 on"),
        ],
    )
    def test_another_type_in_any_field(self, ppo, capsys, part, name, value, words):
        data = json.loads(CONFIG.read_text())
        (data[part] if part else data)[name] = value
        CONFIG.write_text(json.dumps(data))
        fails_with(capsys, ["evaluate", "run"], "config.json", words)
        fails_with(capsys, RESUME, "config.json", words)
        CONFIG.write_text("[]")
        fails_with(capsys, RESUME, "config.json: not a run's configuration")


class TestProvenance:
    def test_a_run_that_goes_on_with_other_versions_keeps_both(self, ppo):
        data = json.loads(CONFIG.read_text())
        data["provenance"][0]["versions"]["torch"] = "1.0"
        CONFIG.write_text(json.dumps(data))
        assert main([*RESUME, "--total-timesteps", "240"]) == 0
        first, second = json.loads(CONFIG.read_text())["provenance"]
        assert first == data["provenance"][0]
        assert (second["epoch"], second["env_steps"]) == (3, 180)
        assert second["versions"]["torch"] == torch.__version__
        assert main([*RESUME, "--total-timesteps", "300"]) == 0
        assert json.loads(CONFIG.read_text())["provenance"] == [first, second]


class TestTerminal:
    def test_output_that_nobody_reads(self):
        command = [sys.executable, "-m", "tactilerl", "--help"]
        read, written = os.pipe()
        os.close(read)
        result = subprocess.run(command, stdout=written, stderr=subprocess.PIPE)
        os.close(written)
        assert (result.returncode, result.stderr) == (1, b"")

    def test_a_terminal_that_cannot_show_every_character(self, ppo, monkeypatch):
        shown = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, "ascii"))
        assert main(["evaluate", "run", "--episodes", "2"]) == 0
        assert b" ? " in shown.getvalue()

    def test_an_interrupt_ends_the_process_at_once_with_one_line(self):
        code = "import os, signal, tactilerl.__main__\nos.kill(os.getpid(), signal.SIGINT)"
        result = python("-c", code)
        assert (result.returncode, result.stderr) == (130, "tactilerl: interrupted\n")

    def test_an_interrupt_of_training_is_put_in_order(self, monkeypatch, capsys):
        def append(run_dir, row):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)

        monkeypatch.setattr(RunDir, "append", append)
        assert main([*TOY, "--total-timesteps", "240", "--out", "new"]) == 130
        said = "tactilerl: interrupted; the last checkpoint is kept: --resume new\n"
        assert capsys.readouterr().err == said
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


DESIGN = ["design", "--scene", "handover_anywhere", "--taxels", "1", "--skin", "20mm", "--beside", "2"]
DESIGN += ["--starts", "1", "--test-starts", "2", "--workers", "1"]
WRITERS = {  # what it writes, and how; a folder's first file says whose the folder is
    "design/design.json": [*DESIGN, "--out", "design"],
    "x.tar.gz": ["study", "collect", "study", "--out", "x.tar.gz"],
    "x.png": ["render", "--pose", "start", "--out", "x.png"],
    "x.mp4": ["render", "hand", "--episodes", "1", "--video", "x.mp4"],
    "x.csv": ["evaluate", "hand", "--episodes", "1", "--record", "x.csv"],
    "x.onnx": ["export", "hand", "--out", "x.onnx"],
    "report/report.html": ["study", "report", "study", "--out", "report"],
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.usefixtures("few_reflexes")
def test_what_exists_stays_unless_it_is_to_be_overwritten(name, made, ppo):
    for other in ("hand", "study"):
        shutil.copytree(made / other, other)
    Path("victim").write_text("mine")
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    for put, content, flags in ((Path.write_text, ["mine"], []), (os.mkfifo, [], ["--overwrite"])):
        put(path, *content)
        before = path.lstat()
        assert main([*WRITERS[name], *flags]) == 2
        assert path.lstat()[:7] == before[:7]
        assert [*path.parent.glob(".lock")] == []
        path.unlink()
    assert Path("victim").read_text() == "mine"
    path.write_text("mine")
    assert main([*WRITERS[name], "--overwrite"]) == 0
    assert path.read_bytes() != b"mine"


@pytest.mark.parametrize("name", ["x.mp4", "x.csv"])
def test_what_is_cut_off_leaves_what_was_there(name, made, monkeypatch):
    """In the second episode, when one is written."""
    reset, numbers = GraspEnv.reset, iter("01")

    def ends_later(*args, **kwargs):
        if next(numbers) == "1":
            raise KeyboardInterrupt
        return reset(*args, **kwargs)

    shutil.copytree(made / "hand", "hand")
    Path(name).write_text("mine")
    monkeypatch.setattr(GraspEnv, "reset", ends_later)
    command = ["2" if word == "1" else word for word in WRITERS[name]]
    assert main([*command, "--overwrite"]) == 130
    assert Path(name).read_text() == "mine"


def test_a_folder_that_nobody_can_write_to_is_refused_at_once(monkeypatch, capsys):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    fails_with(capsys, [*DESIGN, "--out", "design"], "cannot write 'design'", "is read-only")


def test_a_policy_never_replaces_a_run(ppo):
    with pytest.raises(ValueError, match="not a policy"):
        tactilerl.PPO("lqr", hidden=(8,)).save("run/checkpoint.pt")
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
