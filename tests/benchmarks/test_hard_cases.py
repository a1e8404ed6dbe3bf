"""The physics under what it was not made for: the benchmark hard_cases, few steps of each case."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmarks.physics import hard_cases
from tactilerl.envs.grasp import GraspEnv

ROOT = Path(__file__).resolve().parents[2]
PAIRS = [(hand, simulator) for hand in ("shadow", "mpl") for simulator in ("mujoco", "pybullet")]
SLOWEST = ("shadow", "pybullet")


@pytest.mark.parametrize("steps", [8, pytest.param(25, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("hand", "simulator"),
    [pytest.param(*pair, marks=pytest.mark.slow if pair == SLOWEST else ()) for pair in PAIRS],
)
def test_every_case_stays_within_its_stated_limits(hand, simulator, steps, tmp_path):
    out = tmp_path / "hard.json"
    command = [sys.executable, "-m", "benchmarks", "hard_cases", "--hand", hand]
    command += ["--simulator", simulator, "--steps", str(steps), "--out", str(out)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    rows = json.loads(out.read_text())[f"{hand} in {simulator}"]
    assert len(rows) >= 22
    assert max(row["overlap"] for row in rows.values()) > 1e-3  # the hand did touch something
    assert max(row["speed"] for row in rows.values()) > 0.01
    assert rows["actions that are not finite"]["refused"] >= steps // 5
    assert {row["steps"] for row in rows.values()} == {steps}


def worst(case, steps=5):
    return hard_cases.run("shadow", "mujoco", case, steps)


def test_a_case_beyond_its_limits_is_a_failure():
    strict = hard_cases.Case(hard_cases.squeeze, {}, hard_cases.Limits(overlap=0.0))
    assert not worst(strict)["ok"]


def test_warnings_are_a_failure(little_memory):
    row = worst(hard_cases.CASES["pressed down"])
    assert row["warnings"] > 0
    assert not row["ok"]


@pytest.mark.parametrize("harm", ["accepts", "moves"])
def test_bad_actions_that_are_let_through_are_a_failure(monkeypatch, harm):
    step = GraspEnv.step

    def careless(env, action):
        done = step(env, np.nan_to_num(action))
        if harm == "moves" and not np.isfinite(action).all():
            raise ValueError("too late")
        return done

    monkeypatch.setattr(GraspEnv, "step", careless)
    row = worst(hard_cases.CASES["actions that are not finite"], 10)
    assert row["let_through"] > 0
    assert not row["ok"]


def test_without_a_reset_there_is_one_episode(monkeypatch):
    begun = []
    begin = hard_cases.begin
    monkeypatch.setattr(hard_cases, "begin", lambda *args: begun.append(begin(*args)))
    row = hard_cases.run("mpl", "mujoco", hard_cases.CASES["squeezed without a reset"], 100)
    assert len(begun) == 1
    assert (row["steps"], row["physics_steps"]) == (100, 2400)
