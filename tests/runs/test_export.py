"""A policy leaves the library: as a graph that does what it does, and as a record of what it did."""

import csv
import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from tactilerl.commands.cli import main
from tactilerl.runs import evaluation, policies

from one_line import fails_with, printed

ROOT = Path(__file__).resolve().parents[2]
HANDOVER = ROOT / "examples/policies/handover_touch"
PPO = ["--hidden", "16", "--steps-per-epoch", "20", "--n-passes", "1"]
HER = ["--algo", "ddpg_her", "--hidden", "16", "--n-cycles", "1", "--n-batches", "2"]
HER += ["--n-test-rollouts", "0", "--batch-size", "32"]
SHORT = ["--simulator", "mujoco", "--max-episode-steps", "5", "--total-timesteps", "20"]
RUNS = {
    "lift": ["--env", "shadow", "--layout", "4", *PPO],
    "slides and fingers": ["--env", "mpl", "--recipe", "robust", "--touch-rule", "force", *PPO],
    "fingers": ["--scene", "handover", "--actions", "fingers", "--recipe", "steady", *PPO],
    "goals": ["--env", "shadow", "--task", "reach-goal", "--observe-targets", "--history", "3", *HER],
    "scaled": ["--env", "mpl", "--task", "reach-goal", "--recipe", "scaled", *HER],
    "shipped": HANDOVER,
}
pytestmark = pytest.mark.usefixtures("in_tmp")


def opened(run, out):
    """A session of onnxruntime that runs a run's exported policy, and what its metadata say."""
    pytest.importorskip("onnx", reason="of the extra `export`")
    runtime = pytest.importorskip("onnxruntime", reason="of the extra `export`")
    assert main(["export", str(run), "--out", str(out)]) == 0
    session = runtime.InferenceSession(out)
    texts = session.get_modelmeta().custom_metadata_map
    return session, {name: json.loads(text) for name, text in texts.items()}


@pytest.mark.parametrize("name", RUNS)
def test_the_graph_does_what_the_policy_does(name, tmp_path):
    run = RUNS[name]
    if run != HANDOVER:
        run = tmp_path / "run"
        assert main(["train", *RUNS[name], *SHORT, "--out", str(run)]) == 0
    session, about = opened(run, tmp_path / "policy.onnx")
    trained = policies.read_run(run)
    with closing(trained.config.make_env()) as env:
        assert about["control_dt"] == env.config.control_dt
        names, outputs = env.observation_names(), [output.name for output in session.get_outputs()]
        inputs = {i.name: i.shape for i in session.get_inputs()}
        for seed in range(2):
            obs, _ = env.reset(seed=seed)
            state = {name: np.full(shape, np.nan, np.float32) for name, shape in inputs.items()}
            if "last_targets" in inputs:  # else an action says where to go, not how far
                state["last_targets"] = np.float32(about["start_targets"])
            for _ in range(6):
                told = dict(zip(names, obs["observation"], strict=True)) | obs
                sensors = {name: told[name] for name in inputs if name in told}
                given = {name: np.float32(value).reshape(inputs[name]) for name, value in sensors.items()}
                found = dict(zip(outputs, session.run(None, state | given), strict=True))
                action = trained.policy.act(obs)
                targets = env.hand.action_map(np.float64(action), env.state.targets)
                assert np.abs(found["action"] - action).max() < 1e-5
                assert np.abs(found["targets"] - targets).max() < 1e-5
                bounds = np.array([*about["targets"].values()]).T
                assert (bounds[0] - 1e-6 <= targets).all() and (targets <= bounds[1] + 1e-6).all()
                state |= {f"last_{n}": value for n, value in found.items() if f"last_{n}" in inputs}
                obs, *_ = env.step(action)
