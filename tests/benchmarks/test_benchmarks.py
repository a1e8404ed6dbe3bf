"""The benchmarks that reach into the library still find what they change."""

import importlib
import json

import pytest
from benchmarks.command import run_missing
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
    tests = {"full": ({"verdict": "full"}, 0.0), "early": ({"verdict": "settled"}, 0.0)}
    found = hold_verdict.measure(hand, choices, policy, 2, tests)
    assert (found["holds"], found["changed_by_push"]) == (2, None)


def doubled(number):
    return {"doubled": 2 * number}


def test_a_second_call_runs_what_is_missing(tmp_path):
    out = tmp_path / "runs.json"
    run_missing(out, {"sizes": (1, 2)}, [(3,)], doubled, 1)
    content = json.loads(out.read_text())
    assert content == {"sizes": [1, 2], "runs": {"3": {"doubled": 6}}}
    out.write_text(json.dumps(content | {"runs": {"3": "kept"}}))
    assert run_missing(out, {"sizes": (1, 2)}, [(3,), (4,)], doubled, 1) == {
        "3": "kept",
        "4": {"doubled": 8},
    }
    with pytest.raises(SystemExit, match="other configurations"):
        run_missing(out, {"sizes": (1, 3)}, [(3,)], doubled, 1)
