"""What others own is never lost: what writes a file takes a new name, or replaces one of its own."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import tactilerl
from tactilerl import files
from tactilerl.commands.cli import main
from tactilerl.pictures.hand_map import save_picture

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


def save(path):
    learner = tactilerl.PPO("lqr", hidden=(8,))
    try:
        learner.save(path)
    except ValueError:
        return 2
    return 0


# What it writes, and how; a folder's first file says whose the folder is.
WRITERS = {
    "x.toml": lambda name: main(["env", "--export", name]),
    "x.csv": lambda name: main(["env", "--export", name]),
    "x.pt": save,
    "design.json": lambda name: main(["design", "--taxels", "1..2", "--out", "."]),
    "x.tar.gz": lambda name: main(["study", "collect", "study", "--out", name]),
    "x.jpg": lambda name: main(["render", "--pose", "start", "--out", name]),
    "x.png": lambda name: main(["render", "--pose", "start", "--out", name]),
    "x.mp4": lambda name: main(["render", "examples", "--video", name]),
    "report/report.html": lambda name: main(["study", "report", "study", "--out", "report"]),
    "report/tables/runs.csv": lambda name: main(["study", "report", "study", "--out", "report"]),
}
DRAWN = ("x.jpg", "x.png", "x.mp4")


@pytest.fixture
def foreign():
    Path("victim").write_text("mine")
    yield
    assert Path("victim").read_text() == "mine"


@pytest.mark.parametrize("name", WRITERS)
def test_the_files_of_others_stay(name, foreign, capsys):
    policies = Path(__file__).parents[2] / "examples/policies"
    os.symlink(policies / "handover_touch", "examples")
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    for there in (
        lambda: path.write_text("mine"),
        lambda: path.write_text("[1]"),
        lambda: path.symlink_to(Path("victim").resolve()),
        lambda: os.mkfifo(path),
    ):
        there()
        before = path.lstat()
        assert WRITERS[name](name) == 2
        assert path.lstat()[:7] == before[:7]
        path.unlink()


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in DRAWN])
def test_what_is_ours_is_replaced(name):
    for _ in range(2):
        assert WRITERS[name](name) == 0
    assert Path(name).is_file()


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_a_picture_says_who_made_it(ending):
    path, picture = Path(f"x{ending}"), np.zeros((4, 4, 3), np.uint8)
    for _ in range(2):
        with files.replacing(path, files.is_picture) as file:
            save_picture(picture, file, ending)
    assert files.is_picture(path)


def test_a_policy_never_replaces_a_run():
    assert save("run/checkpoint.pt") == 2
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
