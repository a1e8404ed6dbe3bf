"""The command: what it prints, what it refuses, and that a run goes on bit for bit."""

import csv
import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from tactilerl.algos import recipes
from tactilerl.commands.cli import COMMANDS, main
from tactilerl.commands.study import PARTS
from tactilerl.envs import plugins
from tactilerl.runs import evaluation

from one_line import fails_with, printed, python
from states import TIMES, flat

POLICIES = Path(__file__).resolve().parents[2] / "examples/policies"
FAST = ["--hidden", "16", "--steps-per-epoch", "120", "--n-passes", "2"]
TOY = ["train", "--env", "lqr", *FAST]
HER = ["train", "--algo", "ddpg_her", "--hidden", "16", "--n-cycles", "2", "--n-batches", "4"]
HER += ["--n-test-rollouts", "1", "--batch-size", "32"]
REACH = [*HER, "--env", "point-reach"]
pytestmark = pytest.mark.usefixtures("in_tmp")


def render(capsys, *flags):
    """Return what `tactilerl render` prints; where neither EGL nor OSMesa is there, it says so."""
    capsys.readouterr()
    code = main(["render", *flags])
    out, err = capsys.readouterr()
    if code:
        assert "cannot draw here" in err, err
        pytest.skip("no OpenGL without a display here")
    return out


def progress(path):
    """The progress table without the columns that hold times."""
    with open(path / "progress.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(file)]


def same_checkpoint(a, b):
    """Are two checkpoints equal in everything, bit for bit, with what the learner remembers?"""
    saved = [
        {path.relative_to(run): flat(torch.load(path, weights_only=True)) for path in run.rglob("*.pt")}
        for run in (a, b)
    ]
    return saved[0] == saved[1]


class TestTrain:
    def test_run_folder(self, capsys):
        out = printed(capsys, [*TOY, "--total-timesteps", "240", "--out", "run"])
        assert "6 minibatches of about 20 transitions, 2 passes: 12 updates" in out
        assert "epoch    2" in out
        assert "tactilerl evaluate run" in out
        assert "tactilerl render" not in out
        config = json.loads(Path("run/config.json").read_text())
        assert config["learner"]["gae_lambda"] == 0.97
        assert config["provenance"][0]["versions"]["torch"]
        assert config["ranks"] == 1
        assert [row["epoch"] for row in progress(Path("run"))] == ["1", "2"]

    @pytest.mark.parametrize(
        ("hand", "algo"),
        [
            ("mpl --simulator mujoco", "ppo"),
            pytest.param("shadow", "ddpg_her", marks=pytest.mark.slow),
            pytest.param("mpl", "ppo", marks=[pytest.mark.pybullet, pytest.mark.slow]),
            pytest.param("mpl", "ddpg_her", marks=[pytest.mark.pybullet, pytest.mark.slow]),
            pytest.param("Pendulum-v1", "ppo", marks=pytest.mark.slow),  # has no goals for the other
        ],
    )
    def test_same_run_with_any_number_of_workers(self, algo, hand, capsys):
        """In threads and in processes, of ours and not; a run may also go on with another number."""
        args = HER if algo == "ddpg_her" else ["train", *FAST, "--steps-per-epoch", "40"]
        args = [*args, "--env", *hand.split()]
        if hand != "Pendulum-v1":
            args += ["--max-episode-steps", "8", "--layout", "5"]
        more = "2" if hand in ("mpl", "Pendulum-v1") else "3"  # processes take seconds to start
        for workers in ("1", more):
            run = [*args, "--workers", workers, "--out", workers]
            assert main([*run, "--total-timesteps", "60"]) == 0
        assert main(["train", "--resume", "1", "--workers", more, "--total-timesteps", "90"]) == 0
        assert main(["train", "--resume", more, "--workers", "1", "--total-timesteps", "90"]) == 0
        assert progress(Path("1")) == progress(Path(more))
        assert same_checkpoint(Path("1"), Path(more))
        evaluate = ["evaluate", "1", "--episodes", "3", "--stochastic", "--json", "--workers"]
        assert printed(capsys, [*evaluate, "1"]) == printed(capsys, [*evaluate, more])

    def test_ddpg_her_means_the_papers_mujoco_set_up(self, capsys):
        out = printed(capsys, [*HER, "--max-episode-steps", "3", "--total-timesteps", "12"])
        out = " ".join(out.split())
        assert "epochs of up to 12 steps and 8 updates in each process, gamma 0.666667" in out
        assert "HER probability 0.8, replay of 1,000,000 transitions: 0." in out
        run = Path("runs/ddpg_her_shadow_reach-goal_layout2_touch-on_s0")
        config = json.loads((run / "config.json").read_text())
        assert config["scene"]["task"] == "reach-goal"
        learner = config["learner"]
        assert (learner["polyak"], learner["reduction"]) == (0.95, "sum")
        assert progress(run)[0]["updates"] == "8"
        assert 0 <= float(progress(run)[0]["test_success_rate"]) <= 1
        assert main(["evaluate", str(run), "--episodes", "2"]) == 0

    def test_tensorboard_shows_every_epoch_once_also_those_before_it_was_asked_for(self):
        module = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
        main([*TOY, "--total-timesteps", "1", "--out", "run"])
        for steps in ("121", "241"):
            main(["train", "--resume", "run", "--total-timesteps", steps, "--tensorboard"])
        read = module.EventAccumulator("run").Reload()
        steps = [event.step for event in read.Scalars("train/mean_return")]
        assert steps == [int(row["env_steps"]) for row in progress(Path("run"))] == [120, 240, 360]
        assert "train/success_rate" not in read.Tags()["scalars"]  # the toy has none


class TestResume:
    @pytest.mark.parametrize("toy", [TOY, [*TOY, "--recipe", "robust", "--no-anneal-lr"], REACH])
    def test_resumed_run_equals_the_uninterrupted_one(self, toy, capsys):
        main([*toy, "--total-timesteps", "600", "--out", "whole"])
        main([*toy, "--total-timesteps", "200", "--out", "parts"])  # whole epochs, the last one too
        out = printed(capsys, ["train", "--resume", "parts", "--total-timesteps", "600"])
        assert "resumed  after epoch " in out
        assert progress(Path("whole")) == progress(Path("parts"))
        assert same_checkpoint(Path("whole"), Path("parts"))
        main([*toy, "--total-timesteps", "600", "--out", "other", "--seed", "1"])
        assert progress(Path("other")) != progress(Path("whole"))

    def test_experience_is_rewritten_when_its_parts_outgrow_the_memory(self):
        """A replay of eight episodes: its parts become one when they hold more than sixteen."""
        args = [*REACH, "--buffer-size", "200"]
        main([*args, "--total-timesteps", "700", "--out", "whole"])
        parts = sorted(Path("whole/experience").glob("*.pt"))
        assert 1 <= len(parts) < 7
        main([*args, "--total-timesteps", "300", "--out", "cut"])
        assert main(["train", "--resume", "cut", "--total-timesteps", "700"]) == 0
        assert same_checkpoint(Path("whole"), Path("cut"))

    def test_experience_of_a_lost_epoch_is_removed(self):
        main([*REACH, "--total-timesteps", "100", "--out", "run"])
        Path("run/experience/00000007-0000.pt").write_bytes(b"written, but its checkpoint was not")
        main(["train", "--resume", "run", "--total-timesteps", "200"])
        assert len(list(Path("run/experience").iterdir())) == 2

    def test_what_was_cut_off_before_the_first_checkpoint_begins_anew(self):
        for name in ("whole", "cut"):
            main([*TOY, "--total-timesteps", "240", "--out", name])
        for name in ("checkpoint.pt", "progress.csv"):
            Path("cut", name).unlink()
        assert main(["train", "--resume", "cut"]) == 0
        assert progress(Path("whole")) == progress(Path("cut"))
        assert same_checkpoint(Path("whole"), Path("cut"))

    def test_length_counts_where_something_is_annealed(self, capsys):
        run = [*TOY, "--anneal-lr", "--total-timesteps", "1", "--out", "run"]
        main(run)
        more = ["train", "--resume", "run", "--anneal-lr", "--total-timesteps", "240"]
        fails_with(capsys, more, "total_timesteps: found 240")
        assert "raise" not in printed(capsys, run)

    def test_a_goal_that_is_behind_the_run_is_refused_and_changes_nothing(self, capsys):
        main([*TOY, "--total-timesteps", "240", "--out", "run"])
        before = Path("run/config.json").read_bytes()
        again = ["train", "--resume", "run", "--total-timesteps"]
        fails_with(capsys, [*again, "100"], "found 100 for a run that has made 2", "from the run's beg")
        assert Path("run/config.json").read_bytes() == before
        assert "nothing to do; raise --total-timesteps" in printed(capsys, [*again, "240"])

    @pytest.mark.parametrize("flag", ["resume", "out", "scene"])
    def test_an_empty_name_starts_no_other_run(self, flag, capsys):
        """As of a variable of the shell that is not set."""
        fails_with(
            capsys,
            [*TOY, f"--{flag}", ""],
            f"{flag}: found an empty value; give one, or leave out --{flag}",
        )
        assert not list(Path().iterdir())

    def test_a_recipe_is_where_the_other_flags_start(self, capsys):
        main([*TOY, "--recipe", "steady", "--gamma", "0.9", "--total-timesteps", "1", "--out", "run"])
        chosen = json.loads(Path("run/config.json").read_text())["learner"]
        steady = json.loads(json.dumps(asdict(recipes.recipe("ppo", "steady"))))
        mine = {"gamma": 0.9, "hidden": [16], "steps_per_epoch": 120, "n_passes": 2}
        assert chosen.items() >= {**steady, **mine}.items()
        for _ in range(2):
            out = printed(capsys, ["train", "--resume", "run", "--total-timesteps", "240"])
        assert "nothing to do" in out
        again = ["train", "--resume", "run", "--total-timesteps", "360", "--recipe", "steady"]
        fails_with(capsys, again, "recipe: found with resume; a resumed run keeps its settings")
        fails_with(capsys, [*TOY, "--recipe", "stedy"], "recipe: found 'stedy'", "paper, steady")
        fails_with(capsys, [*REACH, "--recipe", "calm"], "for ddpg_her: paper, steady, scaled")
        both = [*TOY, "--recipe", "steady", "--n-minibatches", "6"]
        fails_with(capsys, both, "found both", "None unsets")
        assert main([*both, "--minibatch-size", "None", "--total-timesteps", "1", "--out", "six"]) == 0


class TestBadInput:
    @pytest.mark.parametrize(
        ("args", "words"),
        [
            (["fly"], ["unknown command 'fly'", "allowed: train"]),
            (["train", "--env", "CartPole-v1"], ["action space", "allowed Box"]),
            (["train", "--algo", "sac"], ["algo: found 'sac'", "allowed: ppo, ddpg_her"]),
            ([*HER, "--env", "lqr"], ["observation space", "goal environment"]),
            ([*REACH, "--buffer-size", "9" * 13], ["Unable to allocate", "TiB"]),
            (["train", "--total-timesteps", "-5"], ["total_timesteps: found -5", "allowed [1, 1e15]"]),
            (["train", "--gama", "0.9"], ["Unrecognized options: --gama", "--gamma FLOAT"]),
            (["train", "--touch", "x"], ["invalid choice 'x'", "'on', 'off', 'absent'"]),
            (["train", "--n_passes=0"], ["n_passes: found 0, allowed [1, inf)"]),
            (["evaluate"], ["PATH", "tactilerl evaluate --help"]),
            (["train", "--device", "cuda:99"], ["device", "cuda:99"]),
            (["train", "--resume", "nowhere"], ["'nowhere' is not a run folder"]),
            (["render", "none", "--video", "x.gif"], ["found 'x.gif' as a new file", ".mp4"]),
            (["render", "--out", "no/x.png"], ["found no folder 'no'"]),
            (["render", "none", "--layout", "2"], ["found scene flags"]),  # also its default
            (["render", "none", "--no-jitter"], ["found scene flags"]),
            (
                ["render", "none", "--episode", "1", "--episodes", "3"],
                ["episode and episodes: found both"],
            ),
            (["render", "none", "--pose", "start"], ["pose: allowed only without a run folder"]),
            (["render", "--episode", "1"], ["episode: allowed only with a run folder"]),
            (["render", "--video", "x.mp4"], ["video: allowed only with a run folder"]),
            (["train", "--scen", "handover"], ["--scene STR"]),
            (["train", "--env", "shadwo"], ["did you mean shadow?"]),
            (["train", "--env", "../x:Id"], ["found '../x', which cannot be imported"]),
            (["train", "--resume", "nowhere", "--scene", "handover"], ["scene: found with resume"]),
        ],
    )
    def test_one_clear_line(self, capsys, args, words):
        fails_with(capsys, args, *words)
        assert not list(Path().iterdir())

    def test_an_environment_that_breaks_when_it_is_made(self, capsys, monkeypatch):
        """One line of ours, and below it what the person's own code raised."""
        monkeypatch.setattr(plugins, "imported", [])
        code = "import gymnasium as gym\ndef make():\n    assert 0\ngym.register('Broken-v0', make)"
        Path("broken.py").write_text(code)
        monkeypatch.syspath_prepend(".")
        assert main(["train", "--env", "broken:Broken-v0"]) == 2
        line, _, own = capsys.readouterr().err.partition("\n")
        assert "cannot be made here (AssertionError" in line
        assert 'broken.py", line 3, in make' in own

    def test_existing_run_folder_is_kept(self, capsys):
        Path("mine").mkdir()
        Path("mine/thesis.txt").write_text("years of work")
        fails_with(capsys, [*TOY, "--out", "mine"], "'mine' exists but is not a run folder")
        assert Path("mine/thesis.txt").read_text() == "years of work"
        assert len(list(Path("mine").iterdir())) == 1

    def test_a_run_that_was_killed_before_its_config_was_written_begins_anew(self):
        Path("run").mkdir()
        Path("run/.lock").touch()
        assert main([*TOY, "--total-timesteps", "1", "--out", "run"]) == 0


class TestOtherCommands:
    def test_an_evaluation_counts_faults_and_has_wilsons_interval(self):
        played = {"held": 1, "return": 1.0, "length": 5, "diverged": 0, "warnings": 2}
        episodes = [{**played, "success": float(i < 8)} for i in range(9)]
        result = evaluation.summarise([*episodes, {**played, "success": 0.0, "diverged": 1}])
        assert (result["diverged"], result["warnings"]) == (1, 20)
        expected = pytest.approx((0.4902, 0.9433), abs=1e-4)  # Wilson 1927, 8 of 10
        assert tuple(result["success_rate_ci"]) == expected

    def test_a_layouts_notes_are_shown(self, capsys):
        Path("far.toml").write_text(
            'partial = true\n[[patch]]\ndigits = ["thumb", "index"]\nsegments = ["distal", "palm"]\n'
            "offsets_mm = [[0, 0], [30, 0]]\nradius_mm = 2\n"
        )
        out = printed(capsys, ["env", "--env", "shadow", "--layout", "far.toml"])
        out = " ".join(out.split())
        assert "no taxels at thumb.palm, which shadow does not have" in out
        assert "off the skin of their segment: thumb.distal[+30,+0 mm], index.distal[" in out

    def test_env_describe(self, capsys):
        out = printed(capsys, ["env", "--env", "shadow", "--layout", "5", "--describe"])
        assert out.startswith("env: shadow\ntask: lift-and-hold in mujoco, up to 100 actions of 0.2 s")
        assert "inf" not in out
        assert "action[0] slide_x" in out
        assert "observation[61] taxel thumb.proximal[+0,+0]" in out
        assert out.count("observation[") == 80

    def test_render_draws_the_hand_and_its_taxels(self, capsys):
        imageio = pytest.importorskip("imageio.v2")
        out = render(capsys, "--scene", "handover", "--layout", "1", "--out", "x.png")
        picture = imageio.imread("x.png")
        picture, taxel_map = np.split(picture, [720], axis=1)
        assert picture.shape == (540, 720, 3)
        assert (taxel_map[0] > 240).all()  # the hand unrolled, on white
        red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
        assert ((blue > 100) & (red < 60)).sum() > 20  # taxels that are off
        assert "taxels fire" in out
        assert not out.startswith("x.png: 0 taxels")  # the object is in the hand

    @pytest.mark.slow
    def test_a_film_shows_runs_side_by_side_from_the_same_starts_with_the_score(self, capsys):
        iio = pytest.importorskip("imageio.v3")
        pytest.importorskip("imageio_ffmpeg")
        short = ["--scene", "dark_mpl", "--max-episode-steps", "2", "--n-passes", "1"]
        short += ["--total-timesteps", "4", "--steps-per-epoch", "4"]
        for name, touch in (("a", "on"), ("b", "off")):
            assert main(["train", *short, "--touch", touch, "--out", name]) == 0
        near = ["--elevation", "-10", "--episodes", "1"]
        out = render(capsys, "a", "b", *near, "--video", "x.mp4")
        assert out.count("no success, no success (hold tests of 2 s)") == 1
        pictures = np.array(list(iio.imiter("x.mp4"))).astype(int)
        height, width = pictures.shape[1:3]
        touch, blind = pictures[:, :, : width // 2], pictures[:, :, width // 2 :]
        head = height - width // 2
        # The same start, but for the hand unrolled in the corner, and the word above.
        assert np.abs(touch[0, head:-200] - blind[0, head:-200]).mean() < 3
        assert np.abs(touch[0, :head] - blind[0, :head]).mean() > 1
        out = render(capsys, "a", *near[:2], "--episode", "7", "--video", "y.mp4")
        assert out == "y.mp4: no success\n"

    @pytest.mark.parametrize("command", [*COMMANDS, *(f"study {part}" for part in PARTS)])
    def test_every_command_has_help(self, command, capsys):
        assert f"usage: tactilerl {command}" in printed(capsys, [*command.split(), "--help"])

    def test_the_help_of_train_is_that_of_its_scene(self, capsys):
        out = printed(capsys, ["train", "--scene", "handover", "--help"])
        assert out.index("examples:") < out.index("--scene STR") < out.index("--layout STR")
        assert re.search(r"--env STR .*?\(default:\W+mpl\)", out, re.DOTALL)
        assert "{on,off,absent}" in out

    def test_installed_command_starts_fast_enough_to_be_pleasant(self):
        """No simulator for the list of commands, and no PyTorch for what is asked before training."""
        code = "import sys; from tactilerl.commands import cli; cli.main(['--help'])"
        code += "; assert not {'torch', 'mujoco', 'gymnasium', 'scipy'} & set(sys.modules)"
        code += "; from tactilerl.commands import design, env, gate, hand"
        code += "; assert 'torch' not in sys.modules"
        done = python("-c", code)
        assert done.returncode == 0, done.stderr
