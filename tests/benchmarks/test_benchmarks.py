"""The benchmarks that reach into the library still find what they change."""

import importlib
import json
import sys

import pytest
from benchmarks.peers.env import STEPS, Steps, bullet, mj_step
from benchmarks.physics import hard_cases, hold_verdict
from benchmarks.physics.speed_vs_error import Setting, environment
from benchmarks.studies.layouts_study import part
from tactilerl.study.records import Record


@pytest.mark.pybullet
def test_simulators_with_other_settings():
    engine = importlib.import_module("tactilerl.envs.simulators.pybullet").ENGINE
    setting = Setting(options={"contactERP": 0.4}, added_inertia=0.5)
    with environment("mpl", "pybullet", 0.05, setting) as env:
        assert env.hand.file.added_inertia == 0.5
        assert engine["contactERP"] == 0.4
    assert engine.get("contactERP") != 0.4
    with environment("mpl", "mujoco", 0.05, Setting(timestep=2, options={"iterations": 7})) as env:
        assert env.simulator.model.opt.iterations == 7


@pytest.mark.pybullet
def test_a_simulator_is_stepped_alone():
    for contender, simulator in ((bullet, "pybullet"), (mj_step, "mujoco")):
        steps = Steps("mpl", "6", simulator=simulator, control_dt=1 / 240)
        assert contender(steps)() == STEPS


def test_verdicts_on_objects_that_vary():
    hand, choices, policy = hold_verdict.disturbed("mpl", "mujoco")
    choices |= {"object_size": ("0.04..0.05",), "hold_seconds": 0.2}
    tests = {"full": {"verdict": "full"}, "early": {"verdict": "settled"}}
    found = hold_verdict.measure(hand, choices, policy, 2, tests)
    assert found["holds"] == 2


@pytest.mark.slow
@pytest.mark.parametrize("hand", ["shadow", "mpl"])
def test_every_case_stays_within_its_stated_limits(hand, simulator, tmp_path, monkeypatch):
    out = tmp_path / "hard.json"
    args = ["--hand", hand, "--simulator", simulator, "--steps", "25", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["hard_cases", *args])
    assert hard_cases.main() == 0
    rows = json.loads(out.read_text())[f"{hand} in {simulator}"].values()
    assert len(rows) >= 20
    assert max(row["overlap"] for row in rows) > 1e-3  # the hand did touch something


def test_a_rate_counts_for_the_steps_up_to_its_own():
    rates = {100: 0.0, 200: 1.0, 400: 0.5}
    rows = [{"env_steps": float(steps), "success_rate": rate} for steps, rate in rates.items()]
    record = Record(None, "done", "", {}, rows)
    assert part(record, 0.0) == pytest.approx((100 * 1.0 + 200 * 0.5) / 400)
    assert part(record, 0.375) == pytest.approx((50 * 1.0 + 200 * 0.5) / 250)
    assert part(record, 0.8) == pytest.approx(0.5)
