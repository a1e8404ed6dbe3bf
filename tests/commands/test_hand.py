"""`tactilerl hand`: the file of a hand from its model."""

import math
import sys
import tomllib
from pathlib import Path

import pytest
from tactilerl import import_hand
from tactilerl.commands.cli import main
from tactilerl.envs import hands
from tactilerl.scripted import grasp_search

from one_line import PPO, fails_with, printed

sys.path.append(str(Path(__file__).parents[1] / "envs"))
from test_published_hands import FINGERS, MODEL, TIP, urdf

FINGER = """<body name="{n}_1" pos="0.045 {y} 0"><joint name="{n}_a" axis="0 1 0" range="0 1.6"/>
<geom type="capsule" size="0.008" fromto="0 0 0 0.045 0 0"/><body name="{n}_2" pos="0.045 0 0">
<joint name="{n}_b" axis="0 1 0" range="0 1.6"/>{tip}</body></body>"""
THUMB = """<body name="th_1" pos="-0.03 0 -0.02" euler="0 1.5708 0">
<joint name="th_turn" axis="1 0 0" range="-1 1"/><geom size="0.006"/>
<body name="th_2"><joint name="th_a" axis="0 -1 0" range="-0.3 1.2"/>
<geom type="capsule" size="0.008" fromto="0 0 0 0.07 0 0"/></body></body>"""
PERSON = "".join(FINGER.format(n=n, y=y, tip=TIP) for n, y in (("ff", -0.03), ("mf", 0), ("rf", 0.03)))
PERSON = f"""<mujoco><compiler angle="radian"/><worldbody><body name="hand"><geom type="box"
size="0.045 0.04 0.012"/>{PERSON}{THUMB}</body></worldbody></mujoco>"""


pytestmark = pytest.mark.usefixtures("in_tmp")


def guessed(model, name="hand.xml", **said):
    Path(name).write_text(model)
    text = import_hand.Guess(name, Path(), said).toml()
    Path("hand.toml").write_text(text)
    hands.get("hand.toml")
    return tomllib.loads(text)


def test_a_hand_like_ours():
    about = guessed(PERSON)
    assert about["palm"] == "hand"
    assert about["palmar"] == [0, 0, -1]
    assert about["fingers"] == [1, 0, 0]
    assert list(about["digits"]) == ["index", "middle", "ring", "thumb"]
    assert about["digits"]["index"]["links"] == ["ff_1", "ff_2"]
    assert about["digits"]["index"]["tip"] == pytest.approx([0.038, 0, 0], abs=2e-3)
    assert about["closed"]["ff_a"] > about["start"]["ff_a"] > about["opened"]["ff_a"] == 0
    assert about["closed"]["th_turn"] == about["opened"]["th_turn"]  # it stays where the thumb opposes


def turned_about(model, old, new, more=""):
    assert old in model
    return model.replace(old, new, 1).replace("</mujoco>", f"{more}</mujoco>")


WRIST = '<body name="w{k}"><joint name="w{k}" range="-1 1"/><geom size="0.01"/>'
WRISTS = "".join(WRIST.format(k=k) for k in range(3))
BOX = '<geom type="box"\nsize="0.045 0.04 0.012"/>'
HALVES = f'<body name="half">{BOX}{FINGER.format(n="lf", y=0.05, tip=TIP)}<body name="hand">{BOX}'
TWO_PARTS = turned_about(PERSON, f'<body name="hand">{BOX}', WRISTS + HALVES).replace(
    "</worldbody>", "</body>" * 4 + "</worldbody>"
)
EXCLUDED = '<contact><exclude body1="hand" body2="ff_1"/></contact>'
BASE = f'<body name="base">{BOX}<body name="hand">'
FIXED = turned_about(PERSON, '<body name="hand">', BASE, EXCLUDED)
FIXED = FIXED.replace("</worldbody>", "</body></worldbody>")
OTHERS = PERSON.replace("mf_", "medium_"), PERSON.replace("rf_", "\U0001f590_")


@pytest.mark.parametrize("model", [TWO_PARTS, FIXED, *OTHERS])
def test_digits_keep_their_names(model):
    """Whatever the palm is made of, and however one of them is called."""
    about = guessed(model)
    assert about["palm"] == "hand"
    assert {"index", "middle", "ring", "thumb"} <= about["digits"].keys()
    assert about["digits"]["ring"]["links"][0] == ("\U0001f590_1" if model is OTHERS[1] else "rf_1")
    assert about["palmar"] == [0, 0, -1]
    assert about["fingers"] == [1, 0, 0]
    assert ("little" in about["digits"]) == (model is TWO_PARTS)


def test_digits_without_names_are_counted_from_the_thumb():
    model = PERSON
    for number, name in enumerate(("rf", "ff", "mf", "th")):
        model = model.replace(f"{name}_", f"f{number}_")
    model = model.replace('pos="-0.03 0 -0.02"', 'pos="-0.03 -0.03 -0.02"')
    links = {name: digit["links"][0] for name, digit in guessed(model)["digits"].items()}
    assert links == {"index": "f1_1", "middle": "f2_1", "ring": "f0_1", "thumb": "f3_1"}


def test_a_palm_that_folds_keeps_its_thumb():
    """Where that is named as the palm; its front carries fingers, and is part of none."""
    front = '<body name="front"><joint name="fold" axis="0 1 0" range="0 0.6"/><geom size="0.01"/>'
    fingers = PERSON[PERSON.index('<body name="ff_1"') : PERSON.index('<body name="th_1"')]
    model = PERSON.replace(fingers, f"{front}{fingers}</body>")
    about = guessed(model, palm="hand")
    assert list(about["digits"]) == ["index", "middle", "ring", "thumb"]
    assert about["digits"]["index"]["links"] == ["ff_1", "ff_2"]
    assert "fold" not in about["closed"]


def test_of_two_hands_the_first_is_taken():
    *_, other = turned_about(PERSON, "hand", "other").partition("<worldbody>")
    other = other.replace('name="', 'name="b').replace("</worldbody></mujoco>", "")
    both = PERSON.replace("</worldbody>", f"{other}</worldbody>")
    about = guessed(both)
    assert about["palm"] == about["root"] == "hand"
    assert len(about["digits"]) == 4
    for name in ("hand", "bother"):
        body = f'<body name="{name}">'
        both = both.replace(body, f'{body}<joint name="{name}"/>')
    about = guessed(both)
    assert about["palm"] == about["root"] == "hand"


def test_what_is_left_out_by_itself_stays_out_beside_what_is_asked_for():
    knob = '<body name="knob"><geom size="0.004" pos="0 0 0.03"/></body>'
    servo = '<actuator><motor name="m" joint="l_a"/></actuator></mujoco>'
    model = MODEL.replace("</body></worldbody>", f"{knob}</body></worldbody>")
    about = guessed(model.replace("</mujoco>", servo), drop=["knob"], servos="library")
    assert about["drop"] == ["knob", "m"]


def test_a_gripper():
    about = guessed(MODEL)
    assert about["palmar"] == [0, 0, -1]
    assert abs(about["fingers"][1]) == 1
    assert all(angle > 0 for angle in about["closed"].values())


SLIDES = MODEL
for s in (-1, 1):
    turns, slides = f'axis="0 {s} 0" range="0 1.5"', f'type="slide" axis="0 0 {s}" range="0 0.03"'
    SLIDES = SLIDES.replace(turns, slides, 1)
HINGES = MODEL.replace('range="0 1.5"', 'range="-1.5 0.1"')


@pytest.mark.parametrize(("model", "opened", "closed"), [(SLIDES, 0.03, 0), (HINGES, -1.5, 0.1)])
def test_a_gripper_closes_where_its_digits_meet(model, opened, closed):
    """Whatever the range says."""
    about = guessed(model)
    assert about["opened"]["l_a"] == about["opened"]["r_a"] == opened
    assert about["closed"]["l_a"] == about["closed"]["r_a"] == pytest.approx(closed)


def test_digits_around_a_palm_close_on_each_other():
    """What turns them about the palm spreads them, whatever its range; none of three is a thumb, but
    one that is alone against two."""
    finger = """<body name="f{k}_0" pos="{x} {y} -0.015" euler="0 0 {turn}"><joint name="f{k}_spread"
    range="0 3"/><geom size="0.008"/><body name="f{k}_1" euler="0 1.5708 0"><joint name="f{k}_a"
    axis="0 1 0" range="-1.5 1.5"/><geom type="capsule" size="0.008" fromto="0 0 0 0.07 0 0"/>
    </body></body>"""
    for turns, names in (
        ((0.0, 2.094, -2.094), ["index", "middle", "ring"]),
        ((0.3, -0.3, 3.1416), ["index", "middle", "thumb"]),
    ):
        around = "".join(
            finger.format(k=k, turn=turn, x=0.05 * math.cos(turn), y=0.05 * math.sin(turn))
            for k, turn in enumerate(turns)
        )
        about = guessed(MODEL.replace(FINGERS, around))
        assert list(about["digits"]) == names
        assert about["palmar"] == [0, 0, -1]
        assert all(about["closed"][f"f{k}_a"] > 0.1 for k in range(3))
        assert about["closed"].keys() - {"f2_spread"} == {"f0_a", "f1_a", "f2_a"}


def test_an_arm_is_cut_off():
    arm = "".join(f'<body name="a{i}" pos="0 0 .1"><joint name="a{i}" range="-1 1"/><geom size=".03"/>'
                  for i in range(4))  # fmt: skip
    model = MODEL.replace('<body name="palm"', f'{arm}<body name="palm"')
    model = model.replace("</worldbody>", "</body>" * 4 + "</worldbody>")
    about = guessed(model)
    assert about["root"] == about["palm"] == "palm"
    assert "a0" not in hands.get("hand.toml").joints


def test_a_urdf_whose_palm_hangs_on_a_frame():
    about = guessed(urdf(), "hand.urdf")
    assert about["palm"] == "palm"
    assert set(about["digits"]) == {"thumb", "index"}


def test_from_model_to_training(monkeypatch, capsys):
    for name, fewer in {"ROUNDS": (12, 6), "STARTS": 2, "OTHERS": 2, "GROUNDS": (0.004,)}.items():
        monkeypatch.setattr(grasp_search, name, fewer)
    Path("hand.xml").write_text(MODEL)
    fails_with(capsys, ["hand", "hand.xml", "--out", "new/mine.toml"], "found no folder 'new'")
    Path("new").mkdir()
    said = printed(capsys, ["hand", "hand.xml", "--out", "new/mine.toml"])
    assert "thumb = { links = [" in said
    assert "next: tactilerl design --env new/mine.toml --sensor fsr" in said
    assert len(hands.get("new/mine.toml").grasps) == 1
    flags = ["--total-timesteps", "20", "--max-episode-steps", "5", "--hold-seconds", "0.1"]
    assert main(["train", *PPO, "--env", "new/mine.toml", "--layout", "5", *flags, "--out", "run"]) == 0


def test_a_guess_that_is_refused_is_printed(monkeypatch, capsys):
    def refuse(name):
        raise ValueError("palmar: found a guess that is wrong")

    monkeypatch.setattr(hands, "get", refuse)
    Path("hand.xml").write_text(PERSON)
    fails_with(capsys, ["hand", "hand.xml", "--out", "mine.toml"], "palmar: found a guess")
    assert tomllib.loads(Path("mine.toml").read_text())["palmar"] == [0, 0, -1]
    Path("mine.toml").write_text("somebody's")
    again = ["hand", "hand.xml", "--out", "mine.toml", "--overwrite"]
    fails_with(capsys, again, "palmar: found a guess")
    assert Path("mine.toml").read_text() == "somebody's"


def test_what_a_model_does_not_say_is_asked_for(capsys):
    Path("hand.xml").write_text(MODEL.replace(FINGERS, ""))
    flags = ["hand", "hand.xml", "--out", "mine.toml"]
    fails_with(capsys, flags, "palm: found no body from which two digits branch; name it with --palm")
    fails_with(capsys, ["hand", "no.xml"], "no.xml' does not exist")
    Path("hand.xml").write_text(MODEL)
    Path("mine.toml").write_text("somebody's")
    fails_with(capsys, flags, "it is there already")
    assert Path("mine.toml").read_text() == "somebody's"
