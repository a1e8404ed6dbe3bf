"""The trained policies of examples/policies do what they are said to."""

import json
from pathlib import Path

import pytest

from tactilerl.commands import cli

POLICIES = Path(__file__).parents[1] / "examples" / "policies"
RATES = {"handover_touch": (0.6, 1.0), "handover_blind": (0.0, 0.4), "shadow_lift": (0.7, 1.0)}


def test_every_policy_is_evaluated_and_all_are_small():
    assert {path.name for path in POLICIES.iterdir()} == set(RATES)
    assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 3e6


@pytest.mark.parametrize("name", RATES)
def test_shipped_policies_succeed_as_they_did(name, capsys):
    cli.main(["evaluate", str(POLICIES / name), "--episodes", "20", "--workers", "2", "--json"])
    low, high = RATES[name]
    assert low <= json.loads(capsys.readouterr().out)["success_rate"] <= high
