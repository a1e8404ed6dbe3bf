"""One file and one registration: a simulator, a sensor stage and a learner of somebody else work in
every command."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tactilerl
from tactilerl import algos
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.commands.cli import main
from tactilerl.envs import observations, simulators
from tactilerl.envs.simulators.mujoco import MujocoSimulator

from one_line import fails_with

TINY = ["--hidden", "8", "--steps-per-epoch", "8", "--n-passes", "1", "--workers", "1"]


class Saturn(MujocoSimulator):
    """A little heavier than on Earth."""

    def __init__(self, scene):
        super().__init__(scene)
        self.model.opt.gravity[2] *= 1.06


class Inverted:
    """What was on is off."""

    def reset(self, rng):
        pass

    def __call__(self, reading):
        return 1.0 - reading


@dataclass(frozen=True)
class BraveConfig(PPOConfig):
    """PPO's, and one of its own."""

    courage: float = 2.0
    """How much more it explores."""


class Brave(PPO):
    def __init__(self, config, *args):
        super().__init__(config, *args)
        self.explored = np.float64(config.courage)


@pytest.fixture(autouse=True)
def _registered(monkeypatch, in_tmp):
    brave = algos.LearnerSpec("BraveConfig", "Brave", 500, "reach-goal", module=__name__)
    monkeypatch.setitem(simulators.SIMULATORS, "saturn", f"{__name__}:Saturn")
    monkeypatch.setitem(algos.ALGORITHMS, "brave", brave)
    stages = [*observations.STAGES, lambda config, n: Inverted()]
    monkeypatch.setattr(observations, "STAGES", stages)


def test_all_of_them_train_together_and_are_evaluated():
    scene = ["--simulator", "saturn", "--max-episode-steps", "4", "--layout", "5"]
    args = ["train", "--algo", "brave", "--courage", "3", *scene, *TINY, "--total-timesteps", "8"]
    assert main([*args, "--out", "run"]) == 0
    saved = json.loads(Path("run/config.json").read_text())
    assert saved["learner"]["courage"] == 3.0
    assert saved["scene"]["simulator"] == "saturn"
    assert main(["train", "--resume", "run", "--total-timesteps", "16"]) == 0
    assert main(["evaluate", "run", "--episodes", "2", "--workers", "1"]) == 0
    env = tactilerl.make("shadow", simulator="saturn", task="reach-goal", layout=5)
    obs, _ = env.reset(seed=0)
    assert tactilerl.load_policy("run").act(obs).shape == env.action_space.shape
    assert env.unwrapped.simulator.model.opt.gravity[2] < -10
    assert np.array_equal(obs["observation"][-19:], np.ones(19))  # nothing touches, inverted
    env.close()


def test_what_is_not_registered_is_refused(capsys):
    words = "simulator: found 'mars', allowed: mujoco, pybullet, saturn"
    fails_with(capsys, ["gate", "--simulator", "mars"], words)
