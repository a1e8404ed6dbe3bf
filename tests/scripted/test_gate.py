"""Gates: reflexes of each sense, and the sentence that is made of them; which taxels fire in grasps."""

import json
import re

import numpy as np
import pytest
from tactilerl import envs
from tactilerl.commands.cli import main
from tactilerl.envs.grasp import setup
from tactilerl.scripted import gate, reflexes, taxels
from tactilerl.scripted.gate import HandResult
from tactilerl.scripted.reflexes import Reflex
from tactilerl.terminal import console
from tactilerl.terminal.console import Progress

from one_line import fails_with, printed

FEW = ["--starts", "12", "--search", "1", "--workers", "1", "--seed", "10000"]


def found(n=100, **rates):
    reflex = Reflex("time", 0, 1)
    return [HandResult(name, reflex, rate, (0, 1), n) for name, rate in rates.items()]


@pytest.mark.parametrize(
    ("timed", "joints", "touch", "sighted", "words"),
    [
        (0.3, 0.2, 0.9, 1.0, ["Touch pays: it closes 0.60 of the 0.70 gap", "(timed, 0.30)"]),
        (0.2, 0.8, 0.9, 0.95, ["This scene cannot tell: ", "(joints)", "0.80", "0.95"]),
        (0.4, 0.3, 0.2, 1.0, ["does not pay: it closes 0.00 of the 0.60 gap", "Try tactilerl design"]),
        (0.1, 0.0, 0.4, 0.5, ["closes 0.30 of the 0.40 gap", "Even with sight the hand often fails"]),
    ],
)
def test_what_touch_can_win_of_what_there_is(timed, joints, touch, sighted, words):
    rates = dict(timed=timed, joints=joints, touch=touch, sighted=sighted)
    said = " ".join(gate.sentences(setup("mpl", task="handover"), found(**rates)))
    assert all(word in said for word in words)
    assert "Few" not in said
    said = gate.sentences(setup("mpl", task="handover"), found(n=3, **rates))
    assert "Few starts were judged (3): they cannot tell a difference of 0.3; play 40 or more." in said


def test_another_seed_has_other_starts_and_every_episode_is_counted(monkeypatch):
    played, ticks = [], []

    def note(self, env, number, is_wanted=lambda: True):
        played.append(number)
        return False

    monkeypatch.setattr(Reflex, "play", note)
    for seed in (0, 1):
        config = setup("mpl", task="handover", simulator="mujoco")
        numbers = gate.numbers(seed, 2, gate.SEARCH), gate.numbers(seed, 20)
        gate.examine("mpl", config, *numbers, 1, lambda: ticks.append(1), ["timed"])
    assert len(ticks) == 2 * gate.n_played(20, 2) == 100
    assert len(set(played)) == 2 * 22


def won(reflex, env, number):
    """Return the targets of an episode that succeeds."""
    steps, step_to = [], env.step_to
    env.step_to = lambda targets: (steps.append(targets.copy()), step_to(targets))[1]
    assert reflex.play(env, number)
    return steps


class TestReflexes:
    @pytest.mark.parametrize("scene", ["handover", "dark_mpl"])
    def test_every_sense_that_a_scene_has_use_for_has_as_many_candidates(self, scene):
        env = envs.make(scene=scene)
        found = {sense: len(reflexes.candidates(env, sense)) for sense in reflexes.SENSES}
        assert found.pop("active") == (15 if scene == "handover" else 0)
        assert {*found.values()} == {15}

    @pytest.mark.pybullet
    def test_an_active_one_stays_closed_when_something_stops_it(self):
        env = envs.make(scene="handover", simulator="pybullet", touch="absent")
        steps = won(Reflex("active", 0.03, 1.0, squeeze=3), env, 1)
        is_closed = [not np.array_equal(targets, env.hand.start_targets()) for targets in steps]
        came = env.task.sets_off
        cycle = [True] * 3 + [False] * 3
        assert is_closed[:came] == (cycle * 9)[:came]
        went = next(i for i in range(len(steps)) if is_closed[i : i + 4] == [True] * 4)
        assert came < went + 3 <= came + env.task.stays + 2
        assert all(is_closed[went:])

    def test_touch_goes_when_taxels_fire_and_not_before(self):
        env = envs.make(scene="handover")
        steps = won(Reflex("touch", 1, 1.0), env, 2)
        went = next(i for i, targets in enumerate(steps) if not np.array_equal(targets, steps[0]))
        assert env.task.sets_off < went < env.task.sets_off + env.task.stays


@pytest.mark.slow
@pytest.mark.usefixtures("few_reflexes")
def test_in_a_handover_touch_decides_until_its_threshold_is_more_than_the_giver_presses_with(capsys):
    told = {}
    for threshold in ("0", "0.4"):
        args = ["gate", "--scene", "handover", "--taxel-threshold", threshold, *FEW, "--json"]
        told[threshold] = json.loads(printed(capsys, args))
    soft, firm = ({row["name"]: row["rate"] for row in said["reflexes"]} for said in told.values())
    assert set(soft) == {"timed", "joints", "active", "touch", "sighted"}
    assert min(soft["touch"], soft["sighted"]) > 0.7
    assert max(soft["timed"], soft["joints"]) < 0.6
    assert soft.pop("touch") > 0.6 > firm.pop("touch")
    assert soft == firm  # in the same starts
    assert told["0"]["verdict"].startswith("Touch pays: it closes 0.")
    assert told["0.4"]["verdict"].startswith("Touch does not pay: it closes 0.")


@pytest.mark.parametrize(
    ("task", "what"),
    [
        ("handover", "Try tactilerl design --taxel-threshold 0.2 --sensor fsr, which looks for places"),
        ("lift-and-hold", "Try other layouts (--layout)."),
    ],
)
def test_what_to_try_where_touch_does_not_pay(task, what):
    scene = setup("mpl", task=task, sensor="fsr")
    said = gate.sentences(scene, found(timed=0.2, touch=0.49, sighted=0.9))
    assert said[0].startswith("Touch does not pay: ")
    assert said[1].startswith(what)
    assert len(gate.sentences(scene, found(timed=0.2, touch=0.5, sighted=0.9))) == 1  # just enough


@pytest.mark.parametrize(
    ("args", "named"),
    [
        (["--starts", "0"], "starts: found 0, allowed [1, inf)"),
        (["--seed", "-1"], "seed: found -1"),
        (["--env", "lqr"], "env: found 'lqr'"),
        (["--layout", "99"], "layout"),
        (["--scene", "handover", "--touch", "off"], "--touch: leave it out"),
    ],
)
def test_bad_input(args, named, capsys):
    fails_with(capsys, ["gate", *args], named)


def test_of_long_work_one_reads_how_far_it_is_in_a_unit_that_fits(capsys, monkeypatch):
    Progress("evaluating", 3)()
    assert capsys.readouterr().err == ""  # so soon
    monkeypatch.setattr(console, "FIRST", 0.0)
    tick = Progress("playing", 40)
    for _ in range(4):
        tick()
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("playing: 2 %, about ")
    assert second.startswith("playing: 10 %, about ")
    for _ in range(36):
        tick()
    assert len(capsys.readouterr().err.splitlines()) == 8
    Progress("playing", 100_000)()
    assert re.fullmatch(r"playing: 0.001 %, about \d+ \w+ left\n", capsys.readouterr().err)
    times = {40: "40 s", 100: "2 min", 1500: "25 min", 4 * 3600: "4 h", 10**6: "12 days"}
    assert {seconds: console.about(seconds) for seconds in times} == times


@pytest.mark.parametrize(
    ("layout", "rule", "least", "most"),
    [("1", "skin", 0.9, 1), ("5", "skin", 0.5, 1), ("3", "contact", 0, 0.5)],
)
def test_how_often_some_taxel_fires(layout, rule, least, most):
    check = taxels.check("shadow", setup("shadow", layout=layout, touch_rule=rule), n=4)
    assert check.held == check.grasps == 4
    assert least <= check.share_any <= most
    assert not {*check.fired} & {*check.never_fired}


def test_the_command_fails_where_touch_tells_too_little(capsys, monkeypatch, tmp_path, in_tmp):
    monkeypatch.setattr(taxels.check, "__defaults__", (1, 0.2))
    text = printed(capsys, ["env", "--env", "shadow", "--layout", "5", "--check"])
    assert "of 19 taxels fire" in text
    assert "ring.proximal, ring.middle, ring.distal, " in text.partition("never fired: ")[2]
    assert main(["env", "--env", "shadow", "--layout", "5", "--check", "--json"]) == 0
    fires = json.loads(capsys.readouterr().out)["check"]["fired"]
    digit, segment = fires[0].partition("[")[0].split(".")
    for name, on, code in (("fires", (digit, segment), 0), ("silent", ("thumb", "proximal"), 1)):
        (tmp_path / f"{name}.toml").write_text(
            f"[[patch]]\ndigits = ['{on[0]}']\nsegments = ['{on[1]}']\n"
            "offsets_mm = [[0, 0]]\nradius_mm = 4\n"
        )
        printed(capsys, ["env", "--env", "shadow", "--layout", f"{name}.toml", "--check"], code=code)


def test_a_handover_has_no_scripted_grasp(capsys):
    fails_with(capsys, ["env", "--scene", "handover", "--check"], "`tactilerl gate` says")
