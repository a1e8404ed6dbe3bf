"""The flags of harder scenes, from train to evaluate: both learners, both simulators."""

import json
from pathlib import Path

import pytest

from tactilerl.cli import main

PPO = ["--algo", "ppo", "--hidden", "8", "--steps-per-epoch", "16", "--n-passes", "1"]
HER = ["--algo", "ddpg_her", "--hidden", "8", "--n-cycles", "1", "--n-batches", "1"]
HER += ["--n-test-rollouts", "1", "--batch-size", "8", "--n-rollouts", "1"]
COMMON = ["--task", "reach-goal", "--max-episode-steps", "6", "--workers", "1", "--seed", "5"]
HARD = ["--object-seen", "noisy", "--sight-noise", "0.02", "0.2", "--sight-noise-kind", "held"]
HARD += [
    "--history",
    "2",
    "--joint-noise",
    "0.05",
    "--taxel-false-on",
    "0.1",
    "--taxel-false-off",
    "0.1",
]
HARD += ["--taxel-dead", "0.1", "--taxel-stuck", "0.1", "--taxel-delay", "1", "--goal-range", "0.02"]
HARD += ["--object", "box,sphere", "--object-size", "0.04..0.05", "--friction", "0.5..1"]
HARD += ["--object-density", "400..800", "--start-offset", "0.02", "--start-yaw", "0.5"]


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("learner", [PPO, HER], ids=["ppo", "ddpg_her"])
@pytest.mark.parametrize(("env", "simulator"), [("shadow", "mujoco"), ("mpl", "pybullet")])
def test_every_flag_trains_resumes_and_is_evaluated(learner, env, simulator, capsys):
    scene = ["--env", env, "--simulator", simulator, *COMMON, *HARD]
    assert main(["train", *learner, *scene, "--total-timesteps", "12", "--out", "run"]) == 0
    saved = json.loads(Path("run/config.json").read_text())["scene"]
    assert saved["friction"] == "0.5..1"
    assert saved["object_size"] == ["0.04..0.05"]
    assert saved["sight_noise"] == [0.02, 0.2]
    assert main(["train", "--resume", "run", "--total-timesteps", "24"]) == 0
    capsys.readouterr()
    assert main(["evaluate", "run", "--episodes", "6", "--json", "--workers", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    parts = {part["object"]: part["episodes"] for part in result["by_object"]}
    assert parts["box"] + parts["sphere"] == 6
    for measure in ("width", "density", "friction"):
        assert sum(n for name, n in parts.items() if name.startswith(measure)) == 6
    assert main(["evaluate", "run", "--episodes", "6", "--workers", "1"]) == 0
    assert "success rate, sphere (" in capsys.readouterr().out


@pytest.mark.parametrize("learner", [PPO, HER], ids=["ppo", "ddpg_her"])
@pytest.mark.parametrize(("env", "simulator"), [("shadow", "pybullet"), ("mpl", "mujoco")])
def test_forces_are_learned_from(learner, env, simulator):
    scene = [
        "--env",
        env,
        "--simulator",
        simulator,
        *COMMON,
        "--touch",
        "force",
        "--object-seen",
        "hidden",
    ]
    assert main(["train", *learner, *scene, "--total-timesteps", "12", "--out", "run"]) == 0


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--run-type", "control", "--taxel-dead", "0.1"], "taxel_dead: found 0.1, allowed only with"),
        (
            ["--sight-noise", "0.1", "0.1"],
            "sight_noise: found (0.1, 0.1), allowed only with",
        ),
        (["--object-size", "0.05..0.04"], "object_size: found '0.05..0.04'"),
        (["--friction", "rough"], "friction: found 'rough'"),
        (["--touch", "force", "--taxel-stuck", "0.1"], "taxel_stuck: found 0.1"),
        (["--touch", "smell"], "touch: found 'smell', allowed: skin, contact, force"),
        (["--task", "fly"], "task: found 'fly', allowed: lift-and-hold, reach-goal"),
        (["--history", "0"], "history: found 0"),
    ],
)
def test_bad_values_are_one_line(flags, named, capsys):
    assert main(["train", *flags, "--out", "run"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("tactilerl: error: ")
    assert err.count("\n") == 1
    assert named in err
    assert not Path("run").exists()
