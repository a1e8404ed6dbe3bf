"""The physics under what it was not made for: benchmarks/hard_cases.py, few steps of each case."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tactilerl.envs.grasp import GraspEnv, setup

pytest.importorskip("pybullet")
SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "hard_cases.py"
PAIRS = [(hand, simulator) for hand in ("shadow", "mpl") for simulator in ("mujoco", "pybullet")]


@pytest.mark.parametrize(("hand", "simulator"), PAIRS)
def test_every_case_stays_within_its_stated_limits(hand, simulator, tmp_path):
    out = tmp_path / "hard.json"
    command = [sys.executable, str(SCRIPT), "--hand", hand, "--simulator", simulator]
    result = subprocess.run(
        [*command, "--steps", "40", "--out", str(out)], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    rows = json.loads(out.read_text())[f"{hand} in {simulator}"]
    assert len(rows) >= 15
    assert max(row["overlap"] for row in rows.values()) > 1e-3  # the hand did touch something
    assert max(row["speed"] for row in rows.values()) > 0.01


def test_a_case_beyond_its_limits_is_a_failure(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    import hard_cases

    strict = hard_cases.Case(hard_cases.squeeze, {}, hard_cases.Limits(overlap=0.0))
    assert not hard_cases.run("shadow", "mujoco", strict, 5)["ok"]


@pytest.mark.parametrize(("hand", "simulator"), PAIRS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_actions_that_are_not_finite_change_nothing(hand, simulator, bad):
    env = GraspEnv(hand, setup(hand, simulator=simulator, task="reach-goal"))
    env.reset(seed=0)
    before = env.simulator.object_state().position, env.simulator.joint_state()[0].copy()
    action = np.zeros(env.action_space.shape)
    action[1] = bad
    with pytest.raises(ValueError, match="action: found"):
        env.step(action)
    np.testing.assert_array_equal(env.simulator.object_state().position, before[0])
    np.testing.assert_array_equal(env.simulator.joint_state()[0], before[1])
    env.close()


@pytest.mark.parametrize(("hand", "simulator"), PAIRS)
def test_huge_actions_are_those_at_the_limit(hand, simulator):
    def last(size):
        env = GraspEnv(hand, setup(hand, simulator=simulator, task="reach-goal"))
        env.reset(seed=0)
        obs = [env.step(np.full(env.action_space.shape, size))[0]["observation"] for _ in range(3)]
        env.close()
        return np.array(obs)

    np.testing.assert_array_equal(last(1e30), last(1.0))
