"""The check of taxels: which can fire in scripted grasps, and which never do."""

import json

import pytest
from tactilerl.commands.cli import main
from tactilerl.envs.grasp import setup
from tactilerl.scripted import taxels

from one_line import fails_with, printed


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
    fails_with(capsys, ["env", "--scene", "handover", "--check"], "says tactilerl gate")
