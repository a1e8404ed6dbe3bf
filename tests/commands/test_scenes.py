"""Named scenes: files of choices, usable wherever a hand is named; flags of harder and wrong ones."""

import json
from pathlib import Path

import gymnasium as gym
import pytest
from tactilerl import envs
from tactilerl.commands.cli import main
from tactilerl.envs import scenes, scripted
from tactilerl.envs.grasp import GraspEnv
from tactilerl.envs.hands import HANDS, get
from tactilerl.runs.config import configure, defaults

from one_line import HER, PPO, REACH, fails_with, printed

pytestmark = pytest.mark.usefixtures("in_tmp")


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
    config = configure({"scene": "handover", "layout": "1", "touch": "off"})
    assert (config.run.algo, config.run.env) == ("ppo", "mpl")
    assert (config.scene.task, config.scene.layout, config.scene.touch) == ("handover", "1", "off")
    assert config.learner.orthogonal_init is True  # of the recipe


TRAIN = ["train", *PPO, *REACH, "--total-timesteps", "12"]


@pytest.mark.parametrize("command", [TRAIN, ["env", "--json"]])
def test_flags_that_say_no_reach_the_scene(command, capsys):
    config, make = {}, GraspEnv.__init__

    def seen(env, hand, scene):
        config.update(vars(scene))
        make(env, hand, scene)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GraspEnv, "__init__", seen)
        assert main([*command, "--env", "shadow", "--no-jitter", "--no_observe-targets"]) == 0
    assert (config["jitter"], config["observe_targets"]) == (False, False)


def test_a_recipe_that_is_given_has_its_own_values_not_the_scenes():
    Path("mine.toml").write_text('base = "handover"\n[train]\nsteps_per_epoch = 777\n')
    for recipe, steps in ((None, 777), ("robust", 500)):
        config = configure({"scene": "mine.toml", "recipe": recipe})
        assert (config.learner.steps_per_epoch, config.run.total_timesteps) == (steps, 24_000)


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
        assert configure({"scene": "mine.toml"}).scene.layout == "6"

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
            ("[train]\ncolour = 3", "colour"),
            ("[scene]\nhistory = 2.5", "history: found 2.5"),
            ('[train]\nalgo = "magic"', "magic"),
            ('[train]\nalgo = ["ppo"]', "algo: found ['ppo'], allowed a string"),
            ("[train.dpg_her]", "train.dpg_her: unknown; did you mean ddpg_her"),
        ],
    )
    def test_what_is_wrong_is_one_line(self, text, named, capsys):
        Path("mine.toml").write_text(text)
        fails_with(capsys, ["train", "--scene", "mine.toml", "--out", "run"], named)
        assert not Path("run").exists()

    def test_a_scene_that_is_not_there(self, capsys):
        fails_with(capsys, ["train", "--scene", "gone.toml"], "gone.toml")
        fails_with(capsys, ["train", "--scene", "gone"], "scene: found 'gone', allowed: dark_mpl, hand")

    def test_lengths_grow_with_the_fingers_of_another_hand(self):
        text = 'base = "handover_anywhere"\nenv = "shadow"\n[scene]\nstart_offset = 0.01\n'
        Path("mine.toml").write_text(text)
        named, mine = scenes.load("handover_anywhere"), scenes.load("mine.toml")
        factor = get("shadow").finger_length / get("mpl").finger_length
        assert factor == pytest.approx(96.0 / 74.6, abs=0.01)  # of their models
        assert named.on("mpl") == named.scene
        for scene, offset in ((named.on("shadow"), 0.02 * factor), (mine.on("shadow"), 0.01)):
            assert scene["start_offset"] == pytest.approx(offset, abs=1e-4)
            low, high = map(float, scene["handover_reach"].split(".."))
            assert (low, high) == pytest.approx((0.02 * factor, 0.04 * factor), abs=1e-4)
        assert named.on("shadow")["object_size"] == named.scene["object_size"]


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
    scene = ["--env", env, "--simulator", simulator, *REACH, *HARD]
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
        scene = ["--env", "shadow", *REACH, "--layout", "5", "--reward", "dense"]
        main(["train", *HER, *scene, "--total-timesteps", "12", "--out", "run"])
        before = Path("run/config.json").read_text()
        evaluate = ["evaluate", "run", "--episodes", "2", "--workers", "1", "--json"]
        same = ["--taxel-dead", "0", "--object-seen", "exact"]
        blind = ["--object-seen", "hidden", "--taxel-stuck", "1"]
        told = (printed(capsys, [*evaluate, *given]) for given in ([], same, blind))
        plain, same, blind = map(json.loads, told)
        assert plain == same
        assert "sensors" not in plain
        assert blind["sensors"] == {"object_seen": "hidden", "taxel_stuck": 1.0}
        assert blind["mean_return"] != plain["mean_return"]
        assert Path("run/config.json").read_text() == before
        wrong = ["evaluate", "run", "--taxel-dead", "-1"]
        fails_with(capsys, wrong, "taxel_dead: found -1.0, allowed [0, 1]")

    def test_noise_that_was_annealed_to_zero_cannot_be_kept(self, capsys):
        train = ["train", *HER, "--env", "shadow", *REACH, "--anneal-noise", "--total-timesteps"]
        evaluate = ["evaluate", "run", "--episodes", "1", "--workers", "1"]
        main([*train, "12", "--out", "run"])
        assert "--stochastic" not in printed(capsys, evaluate)
        fails_with(capsys, [*evaluate, "--stochastic"], "exploration noise was annealed to zero")

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
        train = ["train", *HER, *goal, "--total-timesteps", 1, "--buffer-size", 1000, "--workers", 1]
        told = printed(capsys, [*train, "--out", tmp_path / str(is_said)])
        assert (words in " ".join(told.split())) == is_said


TO_GOAL, HANDOVER = {"task": "reach-goal"}, {"scene": "handover"}
WRONG = [
    ({"control_dt": 0.005}, "control_dt"),
    *(({name: 1e300}, name) for name in ("hold_seconds", "joint_noise", "slide_noise", "finger_gain")),
    ({"history": 0}, r"history: found 0, allowed \[1, 100\]"),
    ({"observe_targets": "no"}, "observe_targets: found 'no'"),
    ({"object_seen": "blurred"}, "object_seen: found 'blurred', allowed: exact, noisy, start"),
    ({"sight_noise": (0.01, 0.1)}, "sight_noise: found .* allowed only with object_seen noisy"),
    ({"object_seen": "hidden", "sight_noise_kind": "held"}, "sight_noise_kind: found held"),
    ({"object_seen": "noisy", "sight_noise": (-0.01, 0.1)}, "sight_noise: found -0.01"),
    ({"touch": "off", "taxel_dead": 0.1}, "taxel_dead: found 0.1, allowed only with touch"),
    ({"touch_rule": "force", "taxel_stuck": 0.1}, "taxel_stuck: .* only with Boolean taxels"),
    ({"taxel_threshold": 0.1, "touch": "off"}, "taxel_threshold: .* only with touch on"),
    ({"taxel_threshold": 0.1, "taxel_release": 0.2}, "taxel_release: .* allowed up to taxel_threshold"),
    ({"taxel_noise": 0.1}, "taxel_noise: found 0.1, allowed only with taxels that read a force"),
    ({"taxel_threshold_spread": 0.1, "touch_rule": "force"}, "_spread: .* only with touch_rule skin"),
    ({"sensor": "switch", "taxel_threshold": 0.1}, "taxel_release: found 0.2 N, allowed up to"),
    ({"sensor": "fsr", "control_dt": 0.0}, "control_dt: found 0.0"),
    ({"sensor": "fsr3"}, "sensor: found 'fsr3', did you mean fsr\\? allowed: biotac"),
    ({"giver_force": 1.0}, "giver_force: found 1.0, allowed only with task handover"),
    ({"object": "box,torus"}, "object: found 'torus', allowed: box, sphere, cylinder"),
    ({"object": "box,cylinder", "object_size": ("0.04..0.05", 0.05)}, "object_size: found 2 numbers"),
    ({"object_size": "0.05..0.04"}, r"object_size: found '0.05..0.04', allowed a number, or LOW..HIGH"),
    ({"object_size": "0.04..0.09"}, "object_size: found 0.09 m, allowed up to 0.08 m across"),
    ({"object_size": (0.02, 0.02, 0.16)}, "object_size: found 0.16 m, allowed up to 0.15 m in height"),
    ({"friction": "0..1"}, r"friction: found 0.0, allowed \(0, 10\]"),
    ({"start_offset": 0.02, "jitter": False}, "start_offset: found 0.02, allowed only with jitter"),
    ({"object": "capsule", "object_size": (0.03, 0.03, 0.05)}, "3 numbers, allowed for a capsule"),
    ({"object": "ellipsoid", "simulator": "pybullet"}, "object: found ellipsoid, allowed only with"),
    ({"skin_thickness": 0.003, "simulator": "pybullet"}, "skin_thickness: found 0.003, allowed only"),
    ({"skin_modulus": 5e4}, "skin_modulus: found 50000.0, allowed only with skin_thickness"),
    (TO_GOAL | {"goal_range": 0.09}, "goal_range: found 0.09 m, allowed from 0 to goal_height, 0.08 m"),
    ({"goal_range": 0.01}, "goal_range: .* only with task reach-goal"),
    (HANDOVER | {"handover_reach": "0.02..0.4"}, r"handover_reach: found 0.4, allowed \[0, 0.3\]"),
    (TO_GOAL | {"lift_clearance": 0.2}, "lift_clearance: .* only with task lift-and-hold"),
    ({"actions": "all", "start_closing": 0.5}, "start_closing: .* only with actions fingers or grip"),
    (HANDOVER | {"reward": "staged"}, "reward: found 'staged'"),
    (HANDOVER | {"max_episode_steps": 20}, "max_episode_steps: found 20, allowed 53 or more"),
    (HANDOVER | {"control_dt": 0.0125, "timestep": 0.0025}, "found 0.0125 s, allowed 0.041 s"),
]


@pytest.mark.parametrize(("choices", "named"), WRONG)
def test_what_cannot_be_or_not_together_is_named(choices, named):
    with pytest.raises(ValueError, match=named):
        envs.make("shadow", **choices)
