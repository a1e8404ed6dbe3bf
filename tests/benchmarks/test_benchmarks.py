"""The benchmarks that reach into the library still find what they change."""

import importlib
import json
import sys
from dataclasses import replace

import pytest
from benchmarks.command import run_missing
from benchmarks.learners import steady
from benchmarks.peers import clients
from benchmarks.peers.client_check import Check
from benchmarks.physics import hold_verdict
from benchmarks.physics.speed_vs_error import Setting, environment

from benchmarks import command, tables, times


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


@pytest.mark.parametrize("learn", [steady.ours, steady.theirs])
def test_curves_of_both_libraries_have_points_where_the_task_says(learn):
    task = replace(steady.TASKS["point-reach"], steps=200, every=100, sizes={"hidden": (8,)})
    curve = learn(replace(steady.STEADY, n_batches=2, batch_size=16), task, seed=10_000)
    assert curve.steps == [100, 200]
    assert all(0.0 <= rate <= 1.0 for rate in curve.rates)
    assert -25.0 <= curve.returns[-1] <= 0.0


def test_a_client_works_or_says_why_in_a_line_or_is_not_there(monkeypatch):
    monkeypatch.setitem(clients.CHECKS, "nothing", Check("gymnasium", "what is not there", dict))
    monkeypatch.setitem(clients.CHECKS, "elsewhere", Check("no-such-package", "nothing", dict))
    rows = clients.measure(["check_env", "nothing", "elsewhere"])
    assert [row["result"] for row in rows] == [clients.WORKS, "KeyError: 'nothing'"]


def test_times_of_commands_are_a_table(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(times, "COMMANDS", ("env --env lqr", "env --env shadow --export OUT.toml"))
    monkeypatch.setattr(sys, "argv", ["times", "--out", str(tmp_path / "times.json")])
    times.main()
    table = capsys.readouterr().out
    assert "| `tactilerl env --env lqr` | " in table
    monkeypatch.setattr(command, "DATA", tmp_path)
    page = "<!-- table times -->\nold\n<!-- end -->\n"
    assert tables.filled(page) == page.replace("old\n", table)
