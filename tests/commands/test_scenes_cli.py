"""The flags of harder scenes, from train to evaluate: both learners, both simulators."""

import json
from pathlib import Path

import pytest
from tactilerl.commands.cli import main
from tactilerl.envs import scripted

from one_line import fails_with, printed

pytestmark = pytest.mark.usefixtures("in_tmp")
PPO = ["--algo", "ppo", "--hidden", "8", "--steps-per-epoch", "16", "--n-passes", "1"]
HER = ["--algo", "ddpg_her", "--hidden", "8", "--n-cycles", "1", "--n-batches", "1"]
HER += ["--n-test-rollouts", "1", "--batch-size", "8", "--n-rollouts", "1"]
COMMON = ["--task", "reach-goal", "--max-episode-steps", "6", "--workers", "1", "--seed", "5"]
HARD = ["--object-seen", "noisy", "--sight-noise", "0.02", "0.2", "--sight-noise-kind", "held"]
HARD += ["--history", "2", "--joint-noise", "0.05", "--goal-range", "0.02", "--taxel-delay", "1"]
HARD += ["--taxel-false-on", "0.1", "--taxel-false-off", "0.1"]
HARD += ["--taxel-dead", "0.1", "--taxel-stuck", "0.1"]
HARD += ["--object", "box,sphere", "--object-size", "0.04..0.05", "--friction", "0.5..1"]
HARD += ["--object-density", "400..800", "--start-offset", "0.02", "--start-yaw", "0.5"]


@pytest.mark.parametrize(
    ("learner", "env", "simulator"), [(PPO, "allegro", "mujoco"), (HER, "mpl", "pybullet")]
)
def test_every_flag_trains_resumes_and_is_evaluated(learner, env, simulator, capsys):
    scene = ["--env", env, "--simulator", simulator, *COMMON, *HARD]
    assert main(["train", *learner, *scene, "--total-timesteps", "12", "--out", "run"]) == 0
    saved = json.loads(Path("run/config.json").read_text())["scene"]
    assert saved["friction"] == "0.5..1"
    assert saved["object_size"] == ["0.04..0.05"]
    assert saved["sight_noise"] == [0.02, 0.2]
    assert main(["train", "--resume", "run", "--total-timesteps", "24"]) == 0
    found = printed(capsys, ["evaluate", "run", "--episodes", "6", "--json", "--workers", "1"])
    assert json.loads(found)["episodes"] == 6


def test_forces_are_learned_from():
    scene = ["--env", "shadow", *COMMON, "--touch-rule", "force", "--object-seen", "hidden"]
    assert main(["train", *HER, *scene, "--total-timesteps", "12", "--out", "run"]) == 0


class TestEvaluateWithOtherSensors:
    @pytest.fixture
    def trained(self):
        scene = ["--env", "shadow", *COMMON, "--layout", "5", "--reward", "dense"]
        main(["train", *HER, *scene, "--total-timesteps", "12", "--out", "run"])

    def evaluated(self, capsys, *given):
        evaluate = ["evaluate", "run", "--episodes", "2", "--workers", "1", "--json"]
        return json.loads(printed(capsys, [*evaluate, *given]))

    def test_flags_override_the_saved_scene_for_once(self, trained, capsys):
        before = Path("run/config.json").read_text()
        plain = self.evaluated(capsys)
        same = self.evaluated(capsys, "--taxel-dead", "0", "--object-seen", "exact")
        blind = self.evaluated(capsys, "--object-seen", "hidden", "--taxel-stuck", "1")
        assert plain == same
        assert "sensors" not in plain
        assert blind["sensors"] == {"object_seen": "hidden", "taxel_stuck": 1.0}
        assert blind["mean_return"] != plain["mean_return"]
        assert Path("run/config.json").read_text() == before

    @pytest.mark.parametrize(
        ("given", "named"),
        [
            (["--taxel-dead", "-1"], "taxel_dead: found -1.0, allowed [0, 1]"),
            (["--history", "2"], "--history"),
        ],
    )
    def test_bad_values_are_one_line(self, given, named, trained, capsys):
        fails_with(capsys, ["evaluate", "run", "--episodes", "1", *given], named)

    def test_a_run_without_a_hand_has_no_sensors(self, capsys):
        main(["train", *PPO, "--env", "lqr", "--total-timesteps", "16", "--out", "run"])
        fails_with(capsys, ["evaluate", "run", "--taxel-dead", "0.1"], "which has no hand")
        assert main(["evaluate", "run", "--episodes", "1", "--json"]) == 0


def test_a_goal_that_is_reached_without_a_move_is_said(capsys, tmp_path, monkeypatch):
    """Before training, and by `env`."""
    monkeypatch.setattr(scripted, "N_STILL", 4)
    low = ["--env", "mpl", "--simulator", "mujoco", "--layout", "5"]
    low += ["--task", "reach-goal", "--goal-range", "0.01"]
    words = "a hand that stands still reaches the goal in 4 of 4 episodes"
    for height, tolerance, is_said in ((0.02, 0.03, True), (0.08, 0.03, False)):
        goal = [*low, "--goal-height", height, "--goal-tolerance", tolerance]
        assert (words in printed(capsys, ["env", *goal])) == is_said
        train = ["train", "--algo", "ddpg_her", *goal, "--total-timesteps", 1, "--n-cycles", 1]
        train += ["--hidden", 8, "--n-batches", 1, "--n-test-rollouts", 0, "--buffer-size", 1000]
        told = printed(capsys, [*train, "--workers", 1, "--out", tmp_path / str(is_said)])
        assert (words in " ".join(told.split())) == is_said
