"""The trained policies of examples/policies do what they are said to."""

import json
from pathlib import Path

import pytest

from one_line import printed

ROOT = Path(__file__).parents[2]
POLICIES = ROOT / "examples" / "policies"
RATES = {"handover_touch": (0.7, 1.0), "handover_no_touch": (0.0, 0.5), "shadow_lift": (0.5, 1.0)}


def test_every_policy_is_evaluated_and_all_are_small():
    assert {path.name for path in POLICIES.iterdir()} == set(RATES)
    assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 3e6


@pytest.mark.parametrize("name", RATES)
def test_shipped_policies_succeed_as_they_did(name, capsys):
    evaluate = ["evaluate", POLICIES / name, "--episodes", "4", "--workers", "2", "--json"]
    low, high = RATES[name]
    assert low <= json.loads(printed(capsys, evaluate))["success_rate"] <= high
