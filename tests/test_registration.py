"""One file and one registration: what is added from outside works in every command."""

import json
from pathlib import Path

import numpy as np
import pytest
import tactilerl
from tactilerl import algos
from tactilerl.commands.cli import main
from tactilerl.envs import observations, simulators, tasks
from tests import outside

from one_line import fails_with

TINY = ["--hidden", "8", "--steps-per-epoch", "8", "--n-passes", "1", "--workers", "1"]


@pytest.fixture(autouse=True)
def _registered(monkeypatch, in_tmp):
    brave = algos.LearnerSpec("BraveConfig", "Brave", 500, "reach-goal", module="tests.outside")
    monkeypatch.setitem(simulators.SIMULATORS, "saturn", "tests.outside:Saturn")
    monkeypatch.setitem(tasks.TASKS, "nudge", outside.Nudge)
    monkeypatch.setitem(algos.ALGORITHMS, "brave", brave)
    stages = [*observations.STAGES, lambda config, n: outside.Inverted()]
    monkeypatch.setattr(observations, "STAGES", stages)


def test_all_of_them_train_together_and_are_evaluated():
    scene = ["--simulator", "saturn", "--task", "nudge", "--max-episode-steps", "4", "--layout", "5"]
    args = ["train", "--algo", "brave", "--courage", "3", *scene, *TINY, "--total-timesteps", "8"]
    assert main([*args, "--out", "run"]) == 0
    saved = json.loads(Path("run/config.json").read_text())
    assert saved["learner"]["courage"] == 3.0
    assert (saved["scene"]["simulator"], saved["scene"]["task"]) == ("saturn", "nudge")
    assert main(["train", "--resume", "run", "--total-timesteps", "16"]) == 0
    assert main(["evaluate", "run", "--episodes", "2", "--workers", "1"]) == 0
    env = tactilerl.make("shadow", simulator="saturn", task="nudge", layout=5)
    obs, _ = env.reset(seed=0)
    assert tactilerl.load_policy("run").act(obs).shape == env.action_space.shape
    assert env.unwrapped.simulator.model.opt.gravity[2] < -10
    assert np.array_equal(obs["observation"][-19:], np.ones(19))  # nothing touches, inverted
    assert bool(env.step(env.action_space.sample())[-1]["is_success"])
    env.close()


def test_what_is_not_registered_is_refused(capsys):
    words = "simulator: found 'mars', allowed: mujoco, pybullet, saturn"
    fails_with(capsys, ["gate", "--simulator", "mars"], words)
