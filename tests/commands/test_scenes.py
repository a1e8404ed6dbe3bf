"""Named scenes: files of choices, usable wherever a hand is named; and the flags of harder ones."""

import json
from pathlib import Path

import gymnasium as gym
import pytest
from tactilerl.commands.cli import main
from tactilerl.envs import scenes, scripted
from tactilerl.envs.hands import HANDS, get
from tactilerl.runs.config import configure, defaults

from one_line import fails_with, printed

pytestmark = pytest.mark.usefixtures("in_tmp")
SHORT = ["--total-timesteps", "1", "--steps-per-epoch", "60", "--n-passes", "1", "--workers", "1"]


@pytest.mark.parametrize("name", scenes.names())
def test_a_scene_says_who_learns_there_and_is_registered_listed_and_described(name, capsys):
    named = scenes.load(name)
    assert named.env in HANDS
    scene = defaults(named.train["algo"], named.env, scene=name).scene
    for field, value in named.scene.items():
        found = getattr(scene, field)
        assert list(found) == value if isinstance(value, list) else str(found) == str(value)
    assert gym.make(scenes.gymnasium_id(name)).unwrapped.config == scene
    assert main(["env", "--scene", name]) == main(["env"]) == 0
    assert name in capsys.readouterr().out.split()


def test_flags_change_what_a_scene_says():
    args = ["train", "--scene", "handover", "--layout", "1", "--touch", "off", *SHORT]
    assert main([*args, "--out", "run"]) == 0
    saved = json.loads(Path("run/config.json").read_text())
    assert saved["run"]["algo"] == "ppo"
    assert saved["run"]["env"] == "mpl"
    scene = saved["scene"]
    assert (scene["task"], scene["layout"], scene["touch"]) == ("handover", "1", "off")
    assert saved["learner"]["orthogonal_init"] is True  # of the recipe


class TestOtherLearner:
    def test_a_scene_may_say_how_it_learns(self):
        for scene, steps, hold in (("handover", 8_000, 8.0), ("dark_mpl", 95_000_000, 1.0)):
            config = configure({"scene": scene, "algo": "ddpg_her"})
            assert (config.run.total_timesteps, config.learner.random_hold) == (steps, hold)
        config = configure({"scene": "handover"})
        assert (config.run.algo, config.run.total_timesteps) == ("ppo", 24_000)

    @pytest.mark.parametrize(
        ("train", "steps", "n_batches"),
        [
            ('[train]\nalgo = "ddpg_her"\ntotal_timesteps = 70', 70, 40),
            ("[train.ddpg_her]\nn_batches = 5", 8_000, 5),
        ],
    )
    def test_a_scene_that_builds_on_another_says_what_differs(self, train, steps, n_batches):
        Path("mine.toml").write_text(f'base = "handover"\n{train}\n')
        config = configure({"scene": "mine.toml", "algo": "ddpg_her"})
        assert (config.run.total_timesteps, config.learner.random_hold) == (steps, 8.0)
        assert config.learner.n_batches == n_batches


class TestOwnFile:
    def test_builds_on_a_scene_of_the_library(self):
        Path("mine.toml").write_text(
            'about = "Mine."\nbase = "handover"\n[scene]\nlayout = 6\n[train]\ntotal_timesteps = 70\n'
        )
        mine, base = scenes.load("mine.toml"), scenes.load("handover")
        assert mine.scene == {**base.scene, "layout": 6}
        assert mine.train == {**base.train, "total_timesteps": 70}
        assert (mine.env, mine.about) == (base.env, "Mine.")
        assert main(["train", "--scene", "mine.toml", *SHORT, "--out", "run"]) == 0
        assert json.loads(Path("run/config.json").read_text())["scene"]["layout"] == "6"

    @pytest.mark.parametrize(
        ("text", "named"),
        [
            ("[scene", "scene file mine.toml: not valid TOML"),
            ("colour = 3", "colour: unknown; allowed: about, base, env, scaled, scene, train"),
            ("env = 3", "env: found 3, allowed a str"),
            ('base = "handover"\nscaled = ["history"]', "scaled: found 'history', allowed: "),
            ('env = "foot"', "found 'foot'"),
            ('base = "mine.toml"', "base: found 'mine.toml', allowed: dark_mpl"),
            ("[scene]\ncolour = 3", "colour"),
            ("[scene]\nlayout = 99", "layout"),
            ("[train]\ncolour = 3", "colour"),
            ("[scene]\nhistory = 2.5", "history: found 2.5"),
            ('[train]\nalgo = "magic"', "magic"),
            ('[train]\nalgo = ["ppo"]', "algo: found ['ppo'], allowed a string"),
            ("[train.dpg_her]", "train.dpg_her: unknown; did you mean ddpg_her"),
        ],
    )
    def test_what_is_wrong_is_one_line(self, text, named, capsys):
        Path("mine.toml").write_text(text)
        fails_with(capsys, ["train", "--scene", "mine.toml", *SHORT, "--out", "run"], named)
        assert not Path("run").exists()

    def test_a_scene_that_is_not_there(self, capsys):
        fails_with(capsys, ["train", "--scene", "gone.toml"], "gone.toml")
        fails_with(capsys, ["train", "--scene", "gone"], "scene: found 'gone', allowed: dark_mpl, hand")

    def test_lengths_grow_with_the_fingers_of_another_hand(self):
        Path("mine.toml").write_text(
            'base = "handover_anywhere"\nenv = "shadow"\n[scene]\nstart_offset = 0.01\n'
        )
        named, mine = scenes.load("handover_anywhere"), scenes.load("mine.toml")
        factor = get("shadow").finger_length / get("mpl").finger_length
        assert factor == pytest.approx(96.0 / 74.6, abs=0.01)  # of their models
        assert named.on("mpl") == named.scene
        for scene, offset in ((named.on("shadow"), 0.02 * factor), (mine.on("shadow"), 0.01)):
            assert scene["start_offset"] == pytest.approx(offset, abs=1e-4)
            low, high = map(float, scene["handover_reach"].split(".."))
            assert (low, high) == pytest.approx((0.02 * factor, 0.04 * factor), abs=1e-4)
        assert named.on("shadow")["object_size"] == named.scene["object_size"]


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


class TestEvaluateWithOtherSensors:
    def test_flags_override_the_saved_scene_for_once(self, capsys):
        scene = ["--env", "shadow", *COMMON, "--layout", "5", "--reward", "dense"]
        main(["train", *HER, *scene, "--total-timesteps", "12", "--out", "run"])
        before = Path("run/config.json").read_text()
        evaluate = ["evaluate", "run", "--episodes", "2", "--workers", "1", "--json"]
        same = ["--taxel-dead", "0", "--object-seen", "exact"]
        blind = ["--object-seen", "hidden", "--taxel-stuck", "1"]
        plain, same, blind = (
            json.loads(printed(capsys, [*evaluate, *given])) for given in ([], same, blind)
        )
        assert plain == same
        assert "sensors" not in plain
        assert blind["sensors"] == {"object_seen": "hidden", "taxel_stuck": 1.0}
        assert blind["mean_return"] != plain["mean_return"]
        assert Path("run/config.json").read_text() == before
        wrong = ["evaluate", "run", "--taxel-dead", "-1"]
        fails_with(capsys, wrong, "taxel_dead: found -1.0, allowed [0, 1]")

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
