"""The trained policies of examples/policies do what they are said to."""

import importlib
import json
import sys
from pathlib import Path

import pytest
from tactilerl.commands import cli

from one_line import printed

ROOT = Path(__file__).parents[2]
POLICIES = ROOT / "examples" / "policies"
TOY = ["--algo", "ddpg_her", "--env", "point-reach", "--n-cycles", "1", "--n-test-rollouts", "0"]
RATES = {"handover_touch": (0.7, 1.0), "handover_no_touch": (0.0, 0.5), "shadow_lift": (0.5, 1.0)}


def test_every_policy_is_evaluated_and_all_are_small():
    assert {path.name for path in POLICIES.iterdir()} == set(RATES)
    assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 3e6


@pytest.mark.parametrize("name", RATES)
def test_shipped_policies_succeed_as_they_did(name, capsys):
    evaluate = ["evaluate", POLICIES / name, "--episodes", "4", "--workers", "2", "--json"]
    low, high = RATES[name]
    assert low <= json.loads(printed(capsys, evaluate))["success_rate"] <= high


@pytest.fixture
def ship(monkeypatch):
    """tools/ship_policy.py RUN FOLDER: its exit code."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))

    def call(run, folder):
        monkeypatch.setattr(sys, "argv", ["ship_policy.py", str(run), str(folder)])
        return importlib.import_module("ship_policy").main()

    return call


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_ships_without_what_only_training_needs(ship, tmp_path, capsys):
    run, shipped = tmp_path / "run", tmp_path / "shipped"
    cli.main(["train", *TOY, "--total-timesteps", "50", "--workers", "1", "--out", str(run)])
    before = contents(run)
    for _ in range(2):  # the second time it is there already
        assert ship(run, shipped) == 0
    assert {path.name for path in shipped.iterdir()} == {"config.json", "progress.csv", "checkpoint.pt"}
    evaluated = (
        json.loads(printed(capsys, ["evaluate", folder, "--episodes", "5", "--workers", "1", "--json"]))
        for folder in (run, shipped)
    )
    assert len({found["mean_return"] for found in evaluated}) == 1
    assert contents(run) == before
