"""Thousands of mutated flags, files and arguments: each ends with one line, none with a traceback, and
nothing is written outside of the folder where it happens.

`pytest -m slow -s tests/commands/test_fuzz.py` tries all and prints how many that were; without
`-m slow` a few of each are tried."""

import random
import shutil
import string
from collections import Counter
from pathlib import Path

import pytest
from tactilerl.algos.ppo import PPOConfig
from tactilerl.commands.cli import main
from tactilerl.envs import validation
from tactilerl.runs.config import RunOptions
from tactilerl.study import jobs

from tiny_study import GOOD

FEW = 40  # times as many cases are tried with `-m slow`
TRAIN = ["train", "--env", "lqr", "--hidden", "8", "--steps-per-epoch", "60", "--n-passes", "1"]
TRAIN += ["--total-timesteps", "1"]
FLAGS = {"recipe", "resume", "out", "layout", "task", "object_size", "timestep"}
FLAGS = sorted(validation.names(RunOptions) | validation.names(PPOConfig) | FLAGS)
WORDS = ["", "-1", "0", "1", "0.5", "nan", "-inf", "1e400", "9" * 400, "9" * 5000, "x", "None", "[]"]
WORDS += ["..x:Id", "no.module:Id", ":", "é", "\udcff", "x" * 5000, "../..", "true", "0x10", "meta"]
LAYOUT = """description = "mine"
partial = true
[[patch]]
digits = ["thumb", "index"]
segments = ["distal", "palm"]
offsets_mm = [[0, 0], [2.5, -1]]
radius_mm = 2.5
[[patch]]
digits = ["index"]
segments = ["middle"]
offsets_mm = [[0, 0]]
radius_mm = 1
"""
SCENE = """about = "mine"
base = "handover"
env = "mpl"
[scene]
layout = "5"
object_size = "0.04..0.05"
joint_noise = 0.02
touch = "off"
[train]
algo = "ppo"
recipe = "steady"
hidden = [16, 16]
total_timesteps = 2_000
"""


@pytest.fixture(params=["a few", pytest.param("all", marks=pytest.mark.slow)])
def cases(request):
    """How many cases of so many are tried now."""
    return lambda n: range(n if request.param == "all" else -(-n // FEW))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path = tmp_path_factory.mktemp("trained") / "run"
    assert main([*TRAIN, "--total-timesteps", "180", "--out", str(path)]) == 0
    return path


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working directory with something beside it that stays as it is."""
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "victim").write_text("mine")
    monkeypatch.chdir(tmp_path / "a/b")
    yield tmp_path / "a/b"
    assert {path.name for path in tmp_path.iterdir()} == {"a", "victim"}
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]
    assert (tmp_path / "victim").read_text() == "mine"


@pytest.fixture
def run(here, trained):
    """The folder of a run of three epochs."""
    shutil.copytree(trained, "run")
    return Path("run")


@pytest.fixture
def tried(capsys):
    """Runs a command that may fail with one line, and counts how they ended."""
    counts = Counter()

    def run(args, what):
        capsys.readouterr()
        code = main(args)
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err, (what, args, err)
        assert code in (0, 1, 2), (what, code)
        if err:
            is_line = err.startswith("tactilerl: ") and err.count("\n") == 1
            assert is_line or "For full helptext" in err, (what, err)
        counts[code] += 1
        return code

    yield run
    with capsys.disabled():
        print(f"\n{counts.total()} tried: {counts[0]} ran, {counts[1] + counts[2]} ended with one line")


def test_flags(run, tried, cases):
    rng = random.Random(0)
    for i in cases(300):
        args = [*TRAIN, "--out", f"runs/{i}"]
        for _ in range(rng.choice((1, 1, 2))):
            flag, word = f"--{rng.choice(FLAGS)}".replace("_", "-"), rng.choice(WORDS)
            args += rng.choice(([flag, word], [f"{flag}={word}"], [flag]))
        tried(args, "flags")


HAND = Path(__file__).parents[1] / "hands"
FILES = [  # which is damaged, what reads it, what it holds, and how often
    ("mine.toml", ["env", "--layout", "mine.toml"], LAYOUT, 150),
    ("mine.toml", ["env", "--scene", "mine.toml"], SCENE, 150),
    ("gripper.toml", ["env", "--env", "gripper.toml"], (HAND / "gripper.toml").read_text(), 400),
    ("run/config.json", ["evaluate", "run", "--episodes", "1"], None, 250),
]


@pytest.mark.parametrize(("file", "args", "good", "n"), FILES)
def test_files(run, tried, cases, file, args, good, n):
    rng, path = random.Random(1), Path(file)
    shutil.copy(HAND / "gripper.xml", ".")
    good = good or path.read_text()
    path.write_text(good, encoding="utf-8")
    assert tried(args, good) == 0
    for _ in cases(n):
        bad = mutated(good, rng)
        path.write_text(bad, encoding="utf-8")
        tried(args, bad)


def test_studies(here, tried, cases, monkeypatch):
    """Everything but the training itself, which takes minutes where a study is still one."""
    monkeypatch.setattr(jobs, "run_all", lambda todo, pool, on_end: None)
    rng = random.Random(6)
    for i in cases(400):
        Path("study.toml").write_text(mutated(GOOD, rng) if i else GOOD, encoding="utf-8")
        code = tried(["study", "run", "study.toml", "--out", f"out/{i}"], f"study {i}")
        assert i or code == 1  # nothing is trained


def mutated(text, rng):
    """One to three edits: characters, lines, and pieces that parsers stumble over."""
    for _ in range(rng.randint(1, 3)):
        a, b = sorted(rng.randrange(len(text) + 1) for _ in range(2))
        piece = rng.choice(
            [*string.printable, "nan", "inf", "-1", "9" * 400, "9" * 5000, "[" * 2000, "é"]
        )
        cut = text[a:], text[a + 1 :], text[min(b, a + 20) :]
        edits = [text[:a] + piece + cut[0], text[:a] + piece + cut[1], text[:a] + cut[1]]
        text = rng.choice([*edits, text[:a] + cut[2], text[:b] + cut[0]])
    return text
