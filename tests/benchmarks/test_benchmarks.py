"""The benchmarks that reach into the library still find what they change."""

import importlib

import pytest
from benchmarks.physics import hold_verdict
from benchmarks.physics.speed_vs_error import Setting, environment


@pytest.mark.pybullet
def test_bullet_with_other_settings():
    engine = importlib.import_module("tactilerl.envs.simulators.pybullet").ENGINE
    setting = Setting(options={"contactERP": 0.4}, added_inertia=0.5)
    with environment("mpl", "pybullet", 0.05, setting) as env:
        assert env.hand.added_inertia == 0.5
        assert engine["contactERP"] == 0.4
    assert engine.get("contactERP") != 0.4


def test_mujoco_with_other_settings():
    with environment("mpl", "mujoco", 0.05, Setting(timestep=2, options={"iterations": 7})) as env:
        assert env.simulator.model.opt.iterations == 7


def test_verdicts_on_objects_that_vary():
    hand, choices, policy = hold_verdict.disturbed("mpl", "mujoco")
    choices |= {"object_size": ("0.04..0.05",), "hold_seconds": 0.2}
    tests = {"full": {"verdict": "full"}, "early": {"verdict": "settled"}}
    found = hold_verdict.measure(hand, choices, policy, 2, tests)
    assert found["holds"] == 2
