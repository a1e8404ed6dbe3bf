"""Thousands of mutated flags and files: each ends with one line, none with a traceback, and no
flipped bit passes. `pytest -m slow -s tests/test_fuzz.py` prints how many were tried."""

import json
import random
import shutil
import string
from collections import Counter
from pathlib import Path

import pytest
import torch

from tactilerl import sealed
from tactilerl.cli import main

pytestmark = pytest.mark.slow
TRAIN = ["train", "--env", "lqr", "--hidden", "8", "--steps-per-epoch", "60", "--n-passes", "1"]
TRAIN += ["--total-timesteps", "1"]
FLAGS = ["algo", "env", "total-timesteps", "workers", "seed", "out", "device", "threads", "hidden"]
FLAGS += ["actor-lr", "critic-lr", "action-variance", "gamma", "gae-lambda", "clip-range", "n-passes"]
FLAGS += ["steps-per-epoch", "n-minibatches", "minibatch-size", "entropy-coef", "max-grad-norm"]
FLAGS += ["exploration", "final-variance", "orthogonal-init", "normalise-obs", "recipe"]
FLAGS += ["truncation", "target-kl", "resume", "layout", "task", "object-size", "timestep"]
WORDS = ["", "-1", "0", "1", "0.5", "nan", "-inf", "1e400", "9" * 400, "9" * 5000, "x", "None", "[]"]
WORDS += ["../x:Id", "no.module:Id", ":", "é", "\udcff", "x" * 5000, "../..", "true", "0x10", "meta"]
VALUES = [None, True, -1, 0, 1.5, 10**400, 2**63, float("inf"), float("nan"), "", "x", "../x:Id"]
VALUES += [[], {}, [[]], ["x"], {"x": 1}, "x" * 5000]
LAYOUT = """description = "mine"
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


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The folder of a run of three epochs."""
    monkeypatch.chdir(tmp_path)
    assert main([*TRAIN, "--total-timesteps", "180", "--out", "run"]) == 0
    shutil.copytree("run", "kept")
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
        if code:
            assert err.startswith("tactilerl: "), (what, err)
            assert err.count("\n") == 1, (what, err)
        counts[code] += 1
        return code

    yield run
    with capsys.disabled():
        print(f"\n{counts.total()} tried: {counts[0]} ran, {counts[1] + counts[2]} ended with one line")


def test_flags(run, tried):
    rng = random.Random(0)
    for i in range(300):
        args = [*TRAIN, "--out", f"runs/{i}"]
        for _ in range(rng.choice((1, 1, 2))):
            flag, word = f"--{rng.choice(FLAGS)}", rng.choice(WORDS)
            args += rng.choice(([flag, word], [f"{flag}={word}"], [flag]))
        tried(args, "flags")


def test_layouts(run, tried):
    rng = random.Random(1)
    Path("mine.toml").write_text(LAYOUT, encoding="utf-8")
    assert tried(["env", "--layout", "mine.toml"], LAYOUT) == 0
    for _ in range(150):
        Path("mine.toml").write_text(mutated(LAYOUT, rng), encoding="utf-8")
        tried(["env", "--layout", "mine.toml"], Path("mine.toml").read_text(encoding="utf-8"))


def test_configurations(run, tried):
    rng, good = random.Random(2), (run / "config.json").read_text()
    for i in range(250):
        if i % 2:
            text = mutated(good, rng)
        else:
            data = json.loads(good)
            replace_leaf(data, rng.choice(VALUES), rng)
            text = json.dumps(data)
        (run / "config.json").write_text(text, encoding="utf-8")
        tried(["evaluate", "run", "--episodes", "1"], text)


def test_progress(run, tried):
    rng, good = random.Random(3), (run / "progress.csv").read_text()
    for i in range(150):
        bad = mutated(good, rng).encode()
        bad = bad if i % 3 else bad[: rng.randrange(len(bad) + 1)]
        (run / "progress.csv").write_bytes(bad)
        code = tried(["train", "--resume", "run"], bad)
        after = (run / "progress.csv").read_bytes() if (run / "progress.csv").exists() else b""
        assert bad == after if code else bad.startswith(after)


def test_flipped_bits(run, tried):
    rng, path = random.Random(4), run / "checkpoint.pt"
    good = path.read_bytes()
    for i in range(500):
        bad, at = bytearray(good), rng.randrange(8 * len(good))
        bad[at // 8] ^= 1 << at % 8
        path.write_bytes(bad)
        args = ["evaluate", "run", "--episodes", "1"] if i % 2 else ["train", "--resume", "run"]
        assert tried(args, f"bit {at}") == 2
    path.write_bytes(good)
    assert tried(["evaluate", "run", "--episodes", "1"], "the good one") == 0


def test_checkpoints(run, tried):
    """With a checksum that fits: what is not of the learner's kind is found all the same."""
    rng, path = random.Random(5), run / "checkpoint.pt"
    good = path.read_bytes()
    values = [*VALUES, torch.zeros(3), torch.zeros(0), torch.zeros(2, 2, dtype=torch.int64)]
    sealed.write(path, torch.load(path, weights_only=True))
    assert tried(["evaluate", "run", "--episodes", "1"], "the same, sealed again") == 0
    for _ in range(150):
        path.write_bytes(good)
        content = torch.load(path, weights_only=True)
        replace_leaf(content, rng.choice(values), rng)
        sealed.write(path, content)
        tried(["evaluate", "run", "--episodes", "1"], "checkpoint")


def replace_leaf(data, value, rng):
    """Put a value in a random place, or drop what is there."""
    keys = list(data) if isinstance(data, dict) else range(len(data))
    key = rng.choice(keys)
    if isinstance(data[key], dict | list) and data[key] and rng.random() < 0.9:
        replace_leaf(data[key], value, rng)
    elif rng.random() < 0.1:
        del data[key]
    else:
        data[key] = value


def mutated(text, rng):
    """One to three edits: characters, lines, and pieces that parsers stumble over."""
    for _ in range(rng.randint(1, 3)):
        a, b = sorted(rng.randrange(len(text) + 1) for _ in range(2))
        piece = rng.choice(
            [*string.printable, "nan", "inf", "-1", "9" * 400, "9" * 5000, "[" * 2000, "é"]
        )
        text = rng.choice(
            [
                text[:a] + piece + text[a:],
                text[:a] + piece + text[a + 1 :],
                text[:a] + text[a + 1 :],
                text[:a] + text[min(b, a + 20) :],
                text[:b] + text[a:],
            ]
        )
    return text
