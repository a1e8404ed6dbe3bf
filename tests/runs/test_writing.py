"""What others own is never lost: what writes a file takes a new name, or replaces one of its own."""

import os
import shutil
from pathlib import Path

import pytest
import tactilerl
from tactilerl.commands.cli import main

from one_line import TOY
from study_records import make_study
from tiny_study import TINY

HAND = ["train", "--algo", "ppo", "--env", "mpl", "--simulator", "mujoco", "--task", "reach-goal"]
HAND += ["--max-episode-steps", "1", "--hidden", "8", "--steps-per-epoch", "2", "--n-passes", "1"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    assert main([*TOY, "--total-timesteps", "60", "--out", str(folder / "run")]) == 0
    assert main([*HAND, "--total-timesteps", "1", "--out", str(folder / "hand")]) == 0
    make_study(folder / "study", TINY)
    return folder


@pytest.fixture(autouse=True)
def here(made, in_tmp):
    for name in ("run", "hand", "study"):
        shutil.copytree(made / name, name)


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
def test_what_exists_stays_unless_it_is_to_be_overwritten(name, capsys):
    Path("victim").write_text("mine")
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    for put, flags in (
        (lambda: path.write_text("mine"), ()),
        (lambda: os.mkfifo(path), ("--overwrite",)),
    ):
        put()
        before = path.lstat()
        assert main([*WRITERS[name], *flags]) == 2
        assert path.lstat()[:7] == before[:7]
        assert [*path.parent.glob(".lock")] == []
        path.unlink()
    assert Path("victim").read_text() == "mine"
    path.write_text("mine")
    assert main([*WRITERS[name], "--overwrite"]) == 0
    assert path.read_bytes() != b"mine"


def test_a_policy_never_replaces_a_run():
    with pytest.raises(ValueError, match="not a policy"):
        tactilerl.PPO("lqr", hidden=(8,)).save("run/checkpoint.pt")
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
