"""What others own is never lost: what writes a file takes a new name, or replaces one of its own."""

import os
import shutil
from pathlib import Path

import pytest
import tactilerl
from tactilerl.commands.cli import main

from study_records import make_study

TRAIN = ["train", "--env", "lqr", "--hidden", "8", "--steps-per-epoch", "60", "--n-passes", "1"]
STUDY = """
name = "toy"
[grid]
n_passes = [2, 4]
seed = "0-{last}"
[setups.ppo]
env = "lqr"
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    assert main([*TRAIN, "--total-timesteps", "60", "--out", str(folder / "run")]) == 0
    make_study(folder / "study", STUDY, n_seeds=2)
    return folder


@pytest.fixture(autouse=True)
def here(made, in_tmp):
    for name in ("run", "study"):
        shutil.copytree(made / name, name)


# What it writes, and how; a folder's first file says whose the folder is.
WRITERS = {
    "design/design.json": lambda name, *more: main(
        ["design", "--taxels", "1..2", "--starts", "20", "--out", "design", *more]
    ),
    "x.tar.gz": lambda name, *more: main(["study", "collect", "study", "--out", name, *more]),
    "x.jpg": lambda name, *more: main(["render", "--pose", "start", "--out", name, *more]),
    "x.png": lambda name, *more: main(["render", "--pose", "start", "--out", name, *more]),
    "x.mp4": lambda name, *more: main(["render", "examples", "--video", name, *more]),
    "report/report.html": lambda name, *more: main(
        ["study", "report", "study", "--out", "report", *more]
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_exists_stays_unless_it_is_to_be_overwritten(name, capsys):
    Path("victim").write_text("mine")
    policies = Path(__file__).parents[2] / "examples/policies"
    os.symlink(policies / "handover_touch", "examples")
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    for put, flags in (
        (lambda: path.write_text("mine"), ()),
        (lambda: path.symlink_to(Path("victim").resolve()), ("--overwrite",)),
        (lambda: os.mkfifo(path), ("--overwrite",)),
    ):
        put()
        before = path.lstat()
        assert WRITERS[name](name, *flags) == 2
        assert path.lstat()[:7] == before[:7]
        assert [*path.parent.glob(".lock")] == []
        path.unlink()
    assert Path("victim").read_text() == "mine"
    path.write_text("mine")
    assert WRITERS[name](name, "--overwrite") == 0
    assert path.read_bytes() != b"mine"


def test_a_policy_never_replaces_a_run():
    with pytest.raises(ValueError, match="not a policy"):
        tactilerl.PPO("lqr", hidden=(8,)).save("run/checkpoint.pt")
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
