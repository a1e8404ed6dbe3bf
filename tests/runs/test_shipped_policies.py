"""The trained policies of examples/policies do what they are said to."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tactilerl.commands import cli

ROOT = Path(__file__).parents[2]
POLICIES = ROOT / "examples" / "policies"
TOY = ["--algo", "ddpg_her", "--env", "point-reach", "--n-cycles", "1", "--n-test-rollouts", "0"]
RATES = {"handover_touch": (0.6, 1.0), "handover_blind": (0.0, 0.4), "shadow_lift": (0.7, 1.0)}


def test_every_policy_is_evaluated_and_all_are_small():
    assert {path.name for path in POLICIES.iterdir()} == set(RATES)
    assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 3e6


@pytest.mark.parametrize("name", RATES)
def test_shipped_policies_succeed_as_they_did(name, capsys):
    cli.main(["evaluate", str(POLICIES / name), "--episodes", "20", "--workers", "2", "--json"])
    low, high = RATES[name]
    assert low <= json.loads(capsys.readouterr().out)["success_rate"] <= high


def ship(run, folder):
    command = [sys.executable, str(ROOT / "tools" / "ship_policy.py"), str(run), str(folder)]
    return subprocess.run(command, capture_output=True, text=True)


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_ships_without_what_only_training_needs(tmp_path, capsys):
    run, shipped = tmp_path / "run", tmp_path / "shipped"
    cli.main(["train", *TOY, "--total-timesteps", "50", "--workers", "1", "--out", str(run)])
    before = contents(run)
    for _ in range(2):  # the second time it is there already
        assert ship(run, shipped).returncode == 0
    assert {path.name for path in shipped.iterdir()} == {"config.json", "progress.csv", "checkpoint.pt"}
    rates = []
    for folder in (run, shipped):
        capsys.readouterr()
        cli.main(["evaluate", str(folder), "--episodes", "5", "--workers", "1", "--json"])
        rates.append(json.loads(capsys.readouterr().out)["mean_return"])
    assert rates[0] == rates[1]
    assert contents(run) == before


@pytest.mark.parametrize("case", ["itself", "a whole run", "other files", "no run"])
def test_shipping_loses_nothing(tmp_path, case):
    run, folder = tmp_path / "run", tmp_path / "folder"
    cli.main(["train", *TOY, "--total-timesteps", "50", "--workers", "1", "--out", str(run)])
    (run / ".lock").unlink(missing_ok=True)
    shutil.rmtree(run / "experience")
    shutil.copytree(run, folder)
    if case == "other files":
        (folder / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    source = tmp_path / "nowhere" if case == "no run" else run
    result = ship(source, run if case == "itself" else folder)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert contents(tmp_path) == before
