"""Hands and taxels from anybody's files: a gripper of boxes and meshes, without actuators."""

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import tactilerl
from tactilerl.commands.cli import main
from tactilerl.envs import hands, layouts
from tactilerl.runs.store import RunDir

from one_line import fails_with

FILES = Path(__file__).parents[1] / "hands"
GRIPPER = str(FILES / "gripper.toml")


@pytest.fixture
def own(tmp_path):
    """The gripper's files, with lines changed: own(old, new) is the path of its TOML."""
    for path in FILES.iterdir():
        shutil.copy(path, tmp_path)

    def change(old="", new="", file="gripper.toml"):
        path = tmp_path / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        return str(tmp_path / "gripper.toml")

    return change


CLOSING = "[actions]\nkind = 'closing'\n[slides]\nlimits = [[0, 1], [0, 1], [1, 0]]\n"
WRONG = [
    ("toml", 'palm = "palm"', 'palm = "hand"', "palm: found 'hand', allowed: palm, left_1"),
    ("toml", "tip = [0, 0, -0.033]", "tip = [0, 0, -0.08]", "mm off body 'left_2', allowed"),
    ("toml", 'model = "gripper.xml"', 'model = "no.xml"', "no.xml' does not exist"),
    ("toml", 'model = "gripper.xml"', 'model = ".."', "..' is a folder"),
    ("xml", '<mesh name="tip" v', '<mesh name="tip" file="no.stl"/><mesh name="x" v', "no.stl"),
    ("xml", '<mesh name="tip"', '<mesh name="other" file="no.stl"/><mesh name="tip"', ""),
    ("toml", "[closed]", "[shut]", "shut: unknown"),
    ("toml", '"*_tip" = 0.4', '"*_toe" = 0.4', "found '*_toe', allowed: left_knuckle"),
    ("toml", "fingers = [0, -1, 0]", "fingers = [0, 0, 1]", "fingers: found the direction of palmar"),
    ("toml", "object_size = 0.05", 'object_size = "5 cm"', "grasp 1.object_size: found '5 cm'"),
    ("toml", "[opened]", "[actions]\nkind = 'fly'\n[opened]", "actions.kind: found 'fly', allowed"),
    ("toml", "[digits]", "observation = ['bend']\n[digits]", "observation: found 'bend', allowed: "),
    ("toml", "[digits]", "observation = []\n[digits]", "observation: found none, allowed: "),
    ("toml", "[digits]", "[pitch.rows]\nmidle = 0.01\n[digits]", "midle: unknown"),
    ("toml", "[digits]", "[scene]\nfric = 1\n[digits]", "scene: fric: unknown; did you mean friction?"),
    ("toml", "[digits]", "[masses]\nlef_1 = 0.1\n[digits]", "masses: found 'lef_1', allowed:"),
    ("toml", "[digits]", "[start_closing]\nlfet = 0.2\n[digits]", "start_closing: found 'lfet'"),
    ("toml", "palm = ", 'drop = ["*"]\npalm = ', "model: found 0 bodies at its root"),
    ("toml", "palm = ", 'drop = ["no*"]\npalm = ', "drop: found 'no*', which nothing in the model is"),
    ("toml", '"left_1", "left_2"', '"left_1", "left_1"', "expected each name once"),
    ("toml", '"left_1", "left_2"', '"left_1", "back_1"', "digits: found ['left_1', 'back_1', "),
    ("toml", "[opened]", f"{CLOSING}[opened]", "slides.limits: found [1.0, 0.0], expected the lower"),
]


class TestHand:
    def test_has_the_digits_and_segments_of_its_file(self):
        hand = hands.get(GRIPPER)
        assert hand.digits == ("left", "right", "back")
        assert [s.segment for s in hand.surfaces] == ["proximal", "distal"] * 3 + ["palm"]
        assert [*hand.groups] == ["closing of left", "closing of right", "closing of back"]
        assert hand.actuated[:3] == hands.SLIDES
        assert len(hand.joints) == len(hand.actuated) == 9  # all joints got servos

    def test_palmar_sides_face_each_other(self):
        """Closing turns a segment towards its palmar side: here towards the gripper's axis."""
        hand = hands.get(GRIPPER)
        model = hand.build().compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        for surface in hand.surfaces[:-1]:
            body = model.body(surface.link).id
            palmar = data.xmat[body].reshape(3, 3) @ surface.palmar
            inward = -data.xpos[body] + data.xpos[model.body("palm").id]
            assert palmar @ (inward * [1, 1, 0]) > 0.9 * np.linalg.norm(inward[:2])

    @pytest.mark.parametrize("task", ["lift-and-hold", "reach-goal", "handover"])
    def test_can_be_trained_in_every_task(self, task):
        env = tactilerl.make(GRIPPER, task=task, hold_seconds=0.1, layout=5)
        env.reset(seed=0)
        assert env.observation_space.contains(env.step(np.zeros(env.action_space.shape))[0])

    @pytest.mark.parametrize(("file", "old", "new", "complaint"), WRONG)
    def test_what_is_wrong_is_one_line(self, own, file, old, new, complaint, capsys):
        path = own(old, new, f"gripper.{file}")
        if not complaint:  # a mesh that nothing uses may be missing
            hands.get(path)
            return
        fails_with(capsys, ["env", "--env", path], complaint)

    def test_it_is_read_once_and_again_when_a_file_changes(self, own):
        path = own()
        first = hands.get(path)
        assert hands.get(path) is first
        own("-0.7 1.2", "-0.7 1.1", "gripper.xml")  # and not the TOML
        assert hands.get(path) is not first

    def test_the_digest_is_of_what_the_model_includes_too(self, own, tmp_path):
        (tmp_path / "more.xml").write_text("<mujoco><size nuserdata='1'/></mujoco>")
        path = own("  <worldbody>", "  <include file='more.xml'/><worldbody>", "gripper.xml")
        path = own()
        before = hands.digest(path)
        (tmp_path / "more.xml").write_text("<mujoco><size nuserdata='2'/></mujoco>")
        assert hands.digest(path) != before

    @pytest.mark.parametrize("damping", [0.0, 1e-3])
    def test_a_model_that_breaks_by_itself_is_refused(self, own, damping):
        """A stiff servo on a light link, taken in steps that are too large for it."""
        stiff = f"[servos.hinge]\ngain = 1e5\ndamping = {damping}\narmature = 0.0\nlimit = 1e6\n"
        with pytest.raises(ValueError, match="does not hang still: joint"):
            hands.get(own("[digits]", f"{stiff}[digits]"))

    def test_closing_actions(self, own):
        text = "[actions]\nkind = 'closing'\ngroups = [['left', 'right'], ['back']]\n[opened]"
        hand = hands.get(own("[opened]", text))
        assert hand.action_names[3:] == ("closing of left and right", "closing of back")
        targets = hand.action_map(np.array([0, 0, 0, 1.0, 0]), hand.start_targets())
        moved = targets != hand.start_targets()
        assert moved.tolist() == [False] * 3 + [True] * 4 + [False] * 2


class TestTaxelFiles:
    @pytest.fixture
    def taxels(self):
        return layouts.load("1").place(hands.get(GRIPPER))

    def test_a_link_that_the_hand_has_not(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("link,x,y,z,nx,ny,nz,radius\ntoe,0,0,0,0,0,1,.002\n")
        with pytest.raises(ValueError, match="link: found 'toe', allowed: left_1, left_2"):
            layouts.load(str(path)).place(hands.get(GRIPPER))

    def test_points_off_the_skin_are_named(self, taxels):
        hand = hands.get(GRIPPER)
        points = [point._replace(name=f"{i}") for i, point in enumerate(taxels.points)]
        far = points[0]._replace(position=(0.02, 0.0, -0.02))
        layout = layouts.Layout("far", "", (), (far, *points[1:]))
        assert layouts.off_skin(layout.place(hand), hand) == ["0"]
        shadow = hands.get("shadow")
        first, *others = layouts.load("6").place(shadow).points
        inside = first._replace(position=(0.0, 0.0, 0.01), radius=0.001)
        layout = layouts.Layout("inside", "", (), (inside, *others))
        assert layouts.off_skin(layout.place(shadow), shadow) == [inside.name]


class TestCommands:
    @pytest.mark.slow
    def test_a_run_knows_its_hand_again(self, own, tmp_path, capsys, monkeypatch):
        path, run = own("model =", '"model" ='), str(tmp_path / "run")
        points = tmp_path / "points.toml"
        placed = layouts.load("5").place(hands.get(path)).points
        points.write_text(layouts.Layout("points", "", (), placed).toml())
        flags = ["--env", path, "--layout", str(points), "--total-timesteps", "40"]
        flags += ["--steps-per-epoch", "20", "--max-episode-steps", "10", "--hold-seconds", "0.1"]
        assert main(["train", "--algo", "ppo", *flags, "--out", run]) == 0
        points.unlink()  # the run has its own copy
        assert main(["evaluate", run, "--episodes", "1"]) == 0
        assert main(["train", "--resume", run, "--total-timesteps", "60"]) == 0
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        monkeypatch.chdir(elsewhere)
        Path(path).unlink()  # of its hand too
        evaluate = ["evaluate", run, "--episodes", "1"]
        assert main(evaluate) == 0
        own("-0.7 1.2", "-0.7 1.1", "gripper.xml")
        fails_with(capsys, evaluate, "have changed since it was made")
        (tmp_path / "gripper.xml").unlink()
        fails_with(capsys, evaluate, "hand of this run cannot be read")
        assert RunDir(Path(run)).read_config().run.env == path  # it can still be read
