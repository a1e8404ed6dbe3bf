"""Mutated flags and files end with at most one line, and never with a traceback. `pytest -m slow` tries
forty times as many."""

import random
import shutil
import string
from pathlib import Path

import pytest
from tactilerl import envs
from tactilerl.algos.ppo import PPOConfig
from tactilerl.commands.cli import main
from tactilerl.envs import validation
from tactilerl.runs.config import RunOptions

from one_line import TOY

FEW = 40
TRAIN = [*TOY, "--total-timesteps", "1"]
FLAGS = {"recipe", "resume", "out", "layout", "task", "object_size", "timestep"}
FLAGS = sorted(validation.names(RunOptions) | validation.names(PPOConfig) | FLAGS)
WORDS = ["", "-1", "0", "1", "0.5", "nan", "-inf", "1e400", "9" * 400, "9" * 5000, "x", "None", "[]"]
WORDS += ["..x:Id", "no.module:Id", ":", "é", "\udcff", "x" * 5000, "../..", "true", "0x10", "meta"]
ENVS, HANDS = Path(envs.__file__).parent, Path(__file__).parents[1] / "hands"


@pytest.fixture(params=["a few", pytest.param("all", marks=pytest.mark.slow)])
def cases(request):
    """How many cases of so many are tried now."""
    return lambda n: range(n if request.param == "all" else -(-n // FEW))


@pytest.fixture
def tried(capsys, tmp_path, monkeypatch):
    """Runs a command, two folders below the temporary one, that may fail with one line."""
    (tmp_path / "a/b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a/b")

    def run(args, what):
        capsys.readouterr()
        code = main(args)
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err, (what, args, err)
        assert code in (0, 1, 2), (what, code)
        is_line = err.startswith("tactilerl: ") and err.count("\n") == 1
        assert not err or is_line or "For full helptext" in err, (what, err)
        return code

    yield run
    assert [path.name for path in (*tmp_path.iterdir(), *(tmp_path / "a").iterdir())] == ["a", "b"]


def mutated(text, rng):
    """One to three edits: characters, lines, and pieces that parsers stumble over."""
    pieces = [*string.printable, "nan", "inf", "-1", "9" * 400, "9" * 5000, "[" * 2000, "é"]
    for _ in range(rng.randint(1, 3)):
        a, b = sorted(rng.randrange(len(text) + 1) for _ in range(2))
        piece, end = rng.choice(pieces), rng.choice([a, a + 1, min(b, a + 20)])
        text = text[:a] + rng.choice([piece, ""]) + text[end:]
    return text


def test_flags(tried, cases):
    rng = random.Random(0)
    assert main([*TRAIN, "--out", "run"]) == 0
    for i in cases(300):
        args = [*TRAIN, "--out", f"runs/{i}"]
        for _ in range(rng.choice((1, 1, 2))):
            flag, word = f"--{rng.choice(FLAGS)}".replace("_", "-"), rng.choice(WORDS)
            args += rng.choice(([flag, word], [f"{flag}={word}"], [flag]))
        tried(args, "flags")


@pytest.mark.parametrize(
    ("file", "args", "source", "n"),
    [
        ("mine.toml", ["env", "--layout", "mine.toml"], ENVS / "layout_files/zhang.toml", 150),
        ("mine.toml", ["env", "--scene", "mine.toml"], ENVS / "scenes/handover_anywhere.toml", 200),
        ("gripper.toml", ["env", "--env", "gripper.toml"], HANDS / "gripper.toml", 400),
        ("run/config.json", ["evaluate", "run", "--episodes", "1"], None, 250),
    ],
)
def test_files(tried, cases, file, args, source, n):
    rng, path = random.Random(1), Path(file)
    shutil.copy(HANDS / "gripper.xml", ".")
    if source is None:
        assert main([*TRAIN, "--out", "run"]) == 0
    else:
        shutil.copy(source, path)
    good = path.read_text(encoding="utf-8")
    assert tried(args, good) == 0
    for _ in cases(n):
        bad = mutated(good, rng)
        path.write_text(bad, encoding="utf-8")
        tried(args, bad)
