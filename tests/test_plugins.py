"""What modules add: tasks, touch rules, hands and learners, by --import; and by one registration,
simulators and sensor stages."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import tactilerl
from tactilerl import algos
from tactilerl.commands.cli import main
from tactilerl.envs import hands, observations, plugins, simulators, tasks, touch
from tactilerl.envs.simulators.mujoco import MujocoSimulator

from one_line import fails_with, printed

EXAMPLES = Path(__file__).parents[1] / "examples"
CUP = ["--import", "own_task", "--scene", str(EXAMPLES / "own_task.toml")]
TINY = ["--hidden", "8", "--steps-per-epoch", "64", "--n-passes", "1", "--total-timesteps", "64"]
PACKAGE = """
from pathlib import Path
from tactilerl.envs import hands, tasks, touch

class Numb(touch.ContactRule):
    def read(self, state):
        return super().read(state) & False

class Vague(tasks.ReachGoal):
    rewards = (*tasks.ReachGoal.rewards, "far")

    def compute_reward(self, achieved, desired):
        return "much"

class Half(tasks.Task):
    rewards = ("uncrushed",)

    def reset(self, state, rng):
        return state.object_position, state.object_position

class Broken(tasks.ReachGoal):
    def after_step(self, state, is_last):
        return {}["nothing"]

tasks.TASKS |= {"half": Half, "broken": Broken, "vague": Vague}
touch.RULES["numb"] = Numb
hands.OTHERS["claw"] = Path(__file__).with_name("claw.toml")
"""


@pytest.fixture(autouse=True)
def _nothing_stays(monkeypatch, in_tmp):
    for module, name in ((tasks, "TASKS"), (touch, "RULES"), (hands, "OTHERS")):
        monkeypatch.setattr(module, name, dict(getattr(module, name)))
    monkeypatch.setattr(plugins, "imported", [])
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    for module in ("own_task", "their_package"):
        monkeypatch.delitem(sys.modules, module, raising=False)


@pytest.fixture
def theirs(tmp_path):
    """Flags that import a module which adds tasks, a touch rule and a hand."""
    folder = Path(__file__).parent / "hands"
    Path("their_package.py").write_text(PACKAGE)
    Path("claw.toml").write_text((folder / "gripper.toml").read_text())
    Path("gripper.xml").write_bytes((folder / "gripper.xml").read_bytes())
    return ["env", "--import", "their_package"]


def test_a_module_adds_a_task_a_touch_rule_and_a_hand(theirs, capsys):
    own = [*theirs, "--env", "claw", "--task", "vague", "--touch-rule", "numb", "--json"]
    assert json.loads(printed(capsys, own))["taxels"] > 0


def test_what_a_module_adds_and_cannot_be_used_is_one_line(theirs, capsys):
    fails_with(capsys, [*theirs, "--task", "half"], "lacks after_step, compute_reward")
    fails_with(capsys, [*theirs, "--task", "vague", "--reward", "x"], "allowed: ", ", far")
    train = ["train", *theirs[1:], "--algo", "ddpg_her", "--n-test-rollouts", "1", "--task"]
    vague = "task vague: compute_reward: found 'much', allowed numbers of shape ()"
    fails_with(capsys, [*train, "vague"], vague)
    assert main([*train, "broken"]) == 1
    assert 'return {}["nothing"]' in capsys.readouterr().err
    fails_with(capsys, [*theirs, "--task", "esay"], "allowed: lift-and-hold", "vague")


@pytest.mark.slow
@pytest.mark.usefixtures("few_reflexes")
def test_the_cup_of_the_example_is_held_by_touch(capsys):
    found = printed(capsys, ["gate", *CUP, "--starts", "4", "--search", "1", "--json"])
    rates = {row["name"]: row["rate"] for row in json.loads(found)["reflexes"]}
    assert rates["touch"] > 0.7 > rates["timed"]


def test_a_run_is_trained_and_evaluated_with_import(capsys):
    """Without, its task is unknown."""
    out = printed(capsys, ["train", *CUP, *TINY, "--workers", "1", "--out", "cup"])
    assert "evaluate cup --import own_task" in out
    assert main(["evaluate", "cup", "--episodes", "2", "--import", "own_task", "--workers", "2"]) == 0
    del tasks.TASKS["hold-cup"]
    fails_with(capsys, ["evaluate", "cup"], "task: found 'hold-cup'", "--import MODULE")


def test_a_module_that_cannot_be_imported_is_one_line(capsys):
    Path("worse.py").write_text("1 / 0")
    fails_with(capsys, ["env", "--import", "worse"], "'worse'", "ZeroDivisionError")
    fails_with(capsys, ["env", "--import", "nowhere"], "No module named 'nowhere'")
    fails_with(capsys, ["env", "--import"], "import: found ''")


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


def test_a_learner_of_ones_own_learns_and_resumes_exactly(monkeypatch, capsys):
    monkeypatch.delitem(algos.ALGORITHMS, "cem", raising=False)
    imported, few = ["--import", "own_learner"], ["--population", "20", "--n-elite", "4"]
    args = ["train", *imported, "--algo", "cem", "--env", "lqr", *few, "--workers", "1"]
    assert main([*args, "--total-timesteps", "7_000", "--out", "whole"]) == 0
    assert main([*args, "--total-timesteps", "4_000", "--out", "cut"]) == 0
    assert main(["train", *imported, "--resume", "cut", "--total-timesteps", "7_000"]) == 0
    whole, cut = (
        json.loads(printed(capsys, ["evaluate", *imported, run, "--episodes", "20", "--json"]))
        for run in ("whole", "cut")
    )
    assert whole["mean_return"] == cut["mean_return"] > -40.0  # a first epoch: -89


def test_a_simulator_and_a_sensor_stage_of_somebody_else_work_in_every_command(monkeypatch, capsys):
    monkeypatch.setitem(simulators.SIMULATORS, "saturn", f"{__name__}:Saturn")
    stages = [*observations.STAGES, lambda config, n: Inverted()]
    monkeypatch.setattr(observations, "STAGES", stages)
    scene = ["--simulator", "saturn", "--task", "reach-goal", "--max-episode-steps", "4"]
    scene += ["--layout", "5", "--workers", "1"]
    assert main(["train", "--algo", "ppo", *scene, *TINY, "--out", "run"]) == 0
    assert json.loads(Path("run/config.json").read_text())["scene"]["simulator"] == "saturn"
    assert main(["train", "--resume", "run", "--total-timesteps", "128"]) == 0
    assert main(["evaluate", "run", "--episodes", "2", "--workers", "1"]) == 0
    env = tactilerl.make("shadow", simulator="saturn", task="reach-goal", layout=5)
    obs, _ = env.reset(seed=0)
    assert tactilerl.load_policy("run").act(obs).shape == env.action_space.shape
    assert env.unwrapped.simulator.model.opt.gravity[2] < -10
    assert np.array_equal(obs["observation"][-19:], np.ones(19))  # nothing touches, inverted
    env.close()
    words = "simulator: found 'mars', allowed: mujoco, pybullet, saturn"
    fails_with(capsys, ["gate", "--simulator", "mars"], words)
