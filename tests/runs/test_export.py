"""Policies leave the library: shipped ones, as a graph that does what they do, as a record of that."""

import csv
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from tactilerl.commands.cli import main
from tactilerl.runs import policies

from one_line import HER, PPO, TOY, fails_with, printed, python

ROOT = Path(__file__).resolve().parents[2]
POLICIES = ROOT / "examples/policies"
HANDOVER = POLICIES / "handover_touch"
RATES = {"handover_touch": (0.7, 1.0), "handover_no_touch": (0.0, 0.5), "shadow_lift": (0.5, 1.0)}
RUNS = {
    "slides and fingers": ["--env", "mpl", "--recipe", "robust", "--touch-rule", "force", *PPO],
    "goals": ["--task", "reach-goal", "--observe-targets", "--history", "3", *HER],
}
SHORT = ["--simulator", "mujoco", "--max-episode-steps", "5", "--total-timesteps", "20"]
pytestmark = pytest.mark.usefixtures("in_tmp")


def opened(run, out):
    """A session of onnxruntime that runs a run's exported policy, and what its metadata say."""
    pytest.importorskip("onnx", reason="of the extra `export`")
    runtime = pytest.importorskip("onnxruntime", reason="of the extra `export`")
    assert main(["export", str(run), "--out", str(out)]) == 0
    session = runtime.InferenceSession(out)
    texts = session.get_modelmeta().custom_metadata_map
    return session, {name: json.loads(text) for name, text in texts.items()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folders of the runs, by name."""
    folder = tmp_path_factory.mktemp("runs")
    for name, flags in RUNS.items():
        assert main(["train", *flags, *SHORT, "--out", str(folder / name)]) == 0
    return {"shipped": HANDOVER} | {name: folder / name for name in RUNS}


@pytest.mark.parametrize("name", [*RUNS, "shipped"])
def test_the_graph_does_what_the_policy_does(name, made, tmp_path):
    run = made[name]
    session, about = opened(run, tmp_path / "policy.onnx")
    trained = policies.read_run(run)
    lowest, highest = np.array([*about["targets"].values()]).T
    with closing(trained.config.make_env()) as env:
        names, outputs = env.observation_names(), [output.name for output in session.get_outputs()]
        shapes = {i.name: i.shape for i in session.get_inputs()}
        for seed in range(2):
            obs, _ = env.reset(seed=seed)
            inputs = {name: np.full(shape, np.nan, np.float32) for name, shape in shapes.items()}
            last = about["start"]
            for _ in range(6):
                known = last | dict(zip(names, obs["observation"], strict=True)) | obs
                for entry in inputs.keys() & known.keys():
                    inputs[entry][:] = known[entry]
                found = dict(zip(outputs, session.run(None, inputs), strict=True))
                last = {f"last_{name}": value for name, value in found.items()}
                action = trained.policy.act(obs)
                targets = env.hand.action_map(np.float64(action), env.state.targets)
                assert np.abs(found["action"] - action).max() < 1e-5
                assert np.abs(found["targets"] - targets).max() < 1e-5
                assert (lowest - 1e-6 <= targets).all()
                assert (targets <= highest + 1e-6).all()
                obs, *_ = env.step(action)


def test_the_graph_says_what_it_is_fed(tmp_path):
    session, about = opened(HANDOVER, tmp_path / "policy.onnx")
    inputs = [i.name for i in session.get_inputs()]
    assert inputs == [*about["inputs"], "last_targets", "desired_goal", "last_readings"]
    assert about["control_dt"] == 0.1
    assert about["actions"] == ["closing of the hand"]
    assert {"position of index_MCP", "taxel index.distal[+0,+0]"} <= {*inputs}
    assert all(any(name.startswith(begin) for begin in about["units"]) for name in about["inputs"])
    assert about["targets"]["index_MCP"] == pytest.approx([0.314, 1.57])


def test_the_control_loop_moves_a_hand_behind_a_socket(tmp_path):
    """As `evaluate` does: it holds what it is handed from the same start."""
    opened(HANDOVER, tmp_path / "policy.onnx")
    done = python(str(ROOT / "examples/control_loop.py"), "policy.onnx", "--seed", "236135986")
    assert done.stdout.split("\n")[-2:] == ["success", ""], done.stderr


@pytest.mark.parametrize("name", RUNS)
def test_a_record_has_every_step_in_named_columns(name, made, capsys):
    args = ["evaluate", made[name], "--episodes", "2", "--workers", "1", "--json"]
    told = json.loads(printed(capsys, [*args, "--record", "steps.csv"]))
    each = told["each"]
    assert [episode["episode"] for episode in each] == [0, 1]
    assert np.mean([episode["return"] for episode in each]) == pytest.approx(told["mean_return"])
    rows = [*csv.DictReader(Path("steps.csv").read_text().splitlines())]
    assert len(rows) == sum(episode["length"] for episode in each)
    trained = policies.read_run(made[name])
    with closing(trained.config.make_env()) as env:
        for episode in each:
            mine = [row for row in rows if row["episode_index"] == str(episode["episode"])]
            rewards = [float(row["next.reward"]) for row in mine]
            assert sum(rewards) == pytest.approx(episode["return"])
            obs, _ = env.reset(seed=episode["seed"])
            for step, row in enumerate(mine):
                assert row["frame_index"] == str(step)
                assert float(row["timestamp"]) == pytest.approx(step * env.config.control_dt)
                for entry, value in zip(env.observation_names(), obs["observation"], strict=True):
                    assert entry.endswith(")") or np.float32(row[entry]) == value
                action = trained.policy.act(obs)
                taken = [row[f"action {entry}"] for entry in env.hand.action_names]
                assert taken == [*map(str, action)]
                obs, reward, terminated, truncated, info = env.step(action)
                assert rewards[step] == reward
                assert row["next.done"] == str(int(terminated or truncated))
                assert row["next.success"] == str(int(info["is_success"] and (terminated or truncated)))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["export", HANDOVER, "--out", "x.pb"], ["found 'x.pb'", ".onnx"]),
        (["export", HANDOVER, "--out", "no/x.onnx"], ["found no folder 'no'"]),
        (["export", "begun", "--out", "x.onnx"], ["checkpoint.pt: missing"]),
        (["export", "toy", "--out", "x.onnx"], ["LQREnv", "allowed runs of hands"]),
        (["evaluate", HANDOVER, "--record", "x.xls"], ["found 'x.xls'", ".csv"]),
        (["evaluate", "toy", "--record", "x.csv"], ["LQREnv", "allowed runs of hands"]),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(args, words, toy, capsys):
    fails_with(capsys, args, *words)
    assert not [*Path().glob("x*")]


@pytest.fixture
def toy():
    """A run that is not of a hand, and one that was killed before its first checkpoint."""
    assert main([*TOY, "--total-timesteps", "60", "--out", "toy"]) == 0
    Path("begun").mkdir()
    Path("begun/config.json").write_bytes((HANDOVER / "config.json").read_bytes())


def test_every_policy_is_evaluated_and_all_are_small():
    assert {path.name for path in POLICIES.iterdir()} == set(RATES)
    assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 3e6


@pytest.mark.parametrize("name", RATES)
def test_shipped_policies_succeed_as_they_did(name, capsys):
    evaluate = ["evaluate", POLICIES / name, "--episodes", "4", "--workers", "2", "--json"]
    low, high = RATES[name]
    assert low <= json.loads(printed(capsys, evaluate))["success_rate"] <= high
