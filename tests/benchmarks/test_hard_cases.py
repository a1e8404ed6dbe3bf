"""The physics under what it was not made for: the benchmark hard_cases, few steps of each case."""

import json
import sys

import pytest
from benchmarks.physics import hard_cases

PAIRS = [(hand, simulator) for hand in ("shadow", "mpl") for simulator in ("mujoco", "pybullet")]


@pytest.mark.parametrize(
    ("hand", "simulator", "steps"),
    [
        ("shadow", "mujoco", 8),
        ("mpl", "pybullet", 8),
        *(pytest.param(*pair, 25, marks=pytest.mark.slow) for pair in PAIRS),
    ],
)
def test_every_case_stays_within_its_stated_limits(hand, simulator, steps, tmp_path, monkeypatch):
    out = tmp_path / "hard.json"
    args = ["--hand", hand, "--simulator", simulator, "--steps", str(steps), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["hard_cases", *args])
    assert hard_cases.main() == 0
    rows = json.loads(out.read_text())[f"{hand} in {simulator}"]
    assert len(rows) >= 22
    assert max(row["overlap"] for row in rows.values()) > 1e-3  # the hand did touch something
    assert max(row["speed"] for row in rows.values()) > 0.01
    assert rows["actions that are not finite"]["refused"] >= steps // 5
    assert {row["steps"] for row in rows.values()} == {steps}
