"""Files of hands that crash, hang or fill the memory of whatever reads them: one line each, soon, and
nothing is written where the command runs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tactilerl.envs import hands
from tactilerl.envs.hands import sandbox

from one_line import fails_with

FILES = Path(__file__).parents[1] / "hands"
TOML, MODEL = ((FILES / name).read_text() for name in ("gripper.toml", "gripper.xml"))
WORLD, PALM = "<worldbody>", '<geom type="cylinder" size="0.045 0.012"/>'
ENTITIES = "".join(f'<!ENTITY a{i + 1} "{10 * f"&a{i};"}">' for i in range(11))
BOMB = f'<!DOCTYPE m [<!ENTITY a0 "x">{ENTITIES}]>'
GRID = '<flexcomp name="f" type="grid" count="200 200 1" spacing=".01 .01 .01" mass="1"/>'
DEEP = 2000 * '<body><geom size=".01"/>' + 2000 * "</body>"


@pytest.fixture
def hand(tmp_path, monkeypatch):
    """hand(toml, model) writes the gripper's files, changed, and is the name of its TOML, seen from an
    empty folder beside it."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(sandbox, "CPU_SECONDS", 3)

    def write(toml=TOML, model=MODEL):
        (tmp_path / "gripper.toml").write_text(toml)
        (tmp_path / "gripper.xml").write_text(model)
        return "../gripper.toml"

    yield write
    assert not list((tmp_path / "here").iterdir())


TIP = 'name="tip" '
HOSTILE = [
    (MODEL.replace(WORLD, f'{WORLD}<replicate count="100000000"><body/></replicate>', 1), "to read"),
    (MODEL.replace(PALM, PALM + GRID), "longer than 3 s to read"),
    (MODEL.replace(PALM, PALM + DEEP), "nesting is too deep"),
    (BOMB + MODEL[MODEL.index("<mujoco") :].replace("left_1", "&a11;"), "not valid XML"),
    (MODEL.replace(WORLD, f'<include file="pipe"/>{WORLD}', 1), "/../pipe' does not exist"),
    (MODEL.replace(TIP, f'{TIP}file="pipe.stl"/><mesh name="x" '), "no file"),
]


@pytest.mark.parametrize(("model", "complaint"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_model_is_one_line(hand, model, complaint, capfd):
    for pipe in ("../pipe", "../pipe.stl"):
        os.mkfifo(pipe)
    fails_with(capfd, ["env", "--env", hand(model=model)], complaint)


def test_a_hand_is_read_once_and_again_when_a_file_changes(hand, monkeypatch):
    path, read = hand(), []
    call = sandbox.call
    monkeypatch.setattr(sandbox, "call", lambda *args: read.append(args) or call(*args))
    first = hands.get(path)
    assert hands.get(path) is first
    assert len(read) == 1
    path = hand(model=MODEL.replace("-0.7 1.2", "-0.7 1.1"))
    assert hands.get(path) is not first
    assert hands.get("shadow") is hands.get("shadow")  # which no process of its own reads
    assert len(read) == 2
    Path("../gripper.xml").write_text(MODEL.replace("-0.7 1.2", "-0.7 1.0"))  # and not the TOML
    hands.get(path)
    assert len(read) == 3


def test_a_script_without_a_guard_reads_a_hand(hand):
    Path("../script.py").write_text(f"from tactilerl.envs import hands\nhands.get({hand()!r})\n")
    subprocess.run([sys.executable, "../script.py"], check=True)
