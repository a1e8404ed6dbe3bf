"""Hands and taxels from anybody's files: a gripper of boxes and meshes, without actuators."""

import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from one_line import fails_with
from scipy.spatial.transform import Rotation

import tactilerl
from tactilerl.commands.cli import main
from tactilerl.envs import hands, layouts, objects, scripted, taxel_formats, toml_files
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.hands import loading, sandbox
from tactilerl.envs.state import State
from tactilerl.envs.touch import SKIN, SkinTouch
from tactilerl.pictures import hand_map, places
from tactilerl.probe import grasp_search
from tactilerl.runs.run_dir import RunDir

FILES = Path(__file__).parents[1] / "hands"
GRIPPER = str(FILES / "gripper.toml")


@pytest.fixture(autouse=True)
def _read_here(monkeypatch):
    """Hands are read in this process, which is faster; test_hostile_hands.py tests the usual way."""
    monkeypatch.setattr(sandbox, "load", loading.load)


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


CIRCLE = "[couplings]\nleft_tip = {follows = 'left_knuckle', ratio = 1}\n" \
         "left_knuckle = {follows = 'left_tip', ratio = 1}\n"  # fmt: skip
CLOSING = "[actions]\nkind = 'closing'\n[slides]\nlimits = [[0, 1], [0, 1], [1, 0]]\n"
WRONG = [
    ("toml", 'palm = "palm"', 'palm = "hand"', "palm: found no body 'hand' in the model, allowed:"),
    ("toml", '"left_1", "left_2"', '"left_9"', "digits.left: found no body 'left_9'"),
    ("xml", ' range="-0.7 1.2"', "", "joint 'left_knuckle': has no range"),
    ("toml", "tip = [0, 0, -0.033]", "tip = [0, 0, -0.08]", "mm off body 'left_2', allowed"),
    ("toml", 'model = "gripper.xml"', 'model = "no.xml"', "no.xml' does not exist"),
    ("xml", '<mesh name="tip" v', '<mesh name="tip" file="no.stl"/><mesh name="x" v', "no.stl"),
    ("xml", '<mesh name="tip"', '<mesh name="other" file="no.stl"/><mesh name="tip"', ""),
    ("toml", "[closed]", "[shut]", "unknown key 'shut'"),
    ("toml", '"*_tip" = 0.4', '"*_toe" = 0.4', "closed: found no joint '*_toe' in the model"),
    ("toml", "fingers = [0, -1, 0]", "fingers = [0, 0, 1]", "fingers: found the direction of palmar"),
    ("toml", "palmar = [0, 0, -1]", "palmar = [0, 0]", "palmar: found [0, 0], expected 3 numbers"),
    ("toml", "[digits]", "[pitch]\nrows = 3\n[digits]", "rows: found 3, expected a table"),
    ("toml", "object_size = 0.05", 'object_size = "5 cm"', "grasp 1: object_size: found '5 cm'"),
    ("toml", "[opened]", "[actions]\nkind = 'fly'\n[opened]", "actions.kind: found 'fly', allowed"),
    ("toml", "[opened]", "[actions]\ngroups = 5\n[opened]", "actions.groups: found 5, expected a list"),
    ("toml", "[digits]", "observation = ['bend']\n[digits]", "observation: found 'bend', allowed: "),
    ("toml", "[digits]", "[scene]\nfric = 1\n[digits]", "scene: fric: unknown; did you mean friction?"),
    ("toml", "[digits]", "[scene]\ntimestep = 0\n[digits]", "timestep: found 0"),
    ("toml", "[opened]", "[slides]\nhalf_range = [0, 0, -1]\n[opened]", "slides.half_range: found [0"),
    ("toml", "[opened]", "[environment]\nclosing = [5, -5]\n[opened]", "closing: found [5, -5]"),
    ("toml", "[opened]", "[environment]\nclosing = [1, 0.5]\n[opened]", "the lower end first"),
    ("toml", "[digits]", "[masses]\nlef_1 = 0.1\n[digits]", "masses: found 'lef_1', allowed: "),
    ("toml", "[digits]", "[start_closing]\nlfet = 0.2\n[digits]", "start_closing: unknown key 'lfet'"),
    ("toml", "[digits]", "[pitch.rows]\nmidle = 0.01\n[digits]", "rows: unknown key 'midle'"),
    ("toml", "[digits]", "[couplings.left_tip]\nfollows = [1]\n[digits]", "found no joint '[1]'"),
    ("toml", "palm = ", 'drop = ["*"]\npalm = ', "model: found 0 bodies at its root"),
    ("toml", "palm = ", 'drop = ["no*"]\npalm = ', "drop: found 'no*', which nothing in the model is"),
    ("toml", "[opened]", f"{CIRCLE}[opened]", "couplings: found a circle: left_tip follows left_"),
    ("toml", "[opened]", "[place]\nat = [0, 0, 1e8]\n[opened]", "place.at: found [0, 0, 1000000"),
    ("toml", '"left_1", "left_2"', '"left_1", "left_1"', "expected each name once"),
    ("toml", '"left_1", "left_2"', '"left_1", "back_1"', "found 'back_1', which is a link of left"),
    ("toml", "[opened]", f"{CLOSING}[opened]", "slides.limits: found [1, 0], expected the lower end"),
    ("toml", "[opened]", "[actions]\ngroups = [['left'], ['left']]\n[opened]", "expected each name"),
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

    @pytest.mark.parametrize("simulator", ["mujoco", pytest.param("pybullet")])
    def test_grasps_and_feels(self, simulator):
        env = GraspEnv(GRIPPER, setup(GRIPPER, simulator=simulator, layout="1"))
        start = scripted.perturbed_start(np.random.default_rng(3), len(env.hand.joints))
        held, bits = [], []
        for is_up in scripted.hold_steps(env, scripted.grasp_for(env), start, 0.5):
            held.append(is_up)
            bits.append(env.taxel_readings().sum())
        env.close()
        assert held[-1]
        assert np.mean(bits) >= 2.0

    def test_starts_free_of_ground_and_object(self):
        env = GraspEnv(GRIPPER)
        for seed in range(10):
            env.reset(seed=seed)
            model, data = env.simulator.model, env.simulator.data
            ground, thing = model.geom("ground").id, model.geom("object").id
            own = [set(c.geom.tolist()) - {ground, thing} for c in data.contact]
            assert not any(own)
        env.close()

    @pytest.mark.parametrize("task", ["lift-and-hold", "reach-goal", "handover"])
    def test_can_be_trained_in_every_task(self, task):
        env = tactilerl.make(GRIPPER, task=task, hold_seconds=0.1, layout=5)
        obs, _ = env.reset(seed=0)
        assert env.observation_space.contains(obs)
        for _ in range(3):
            obs, *_ = env.step(np.zeros(env.action_space.shape))
        assert env.observation_space.contains(obs)
        env.close()

    def test_the_library_finds_none_of_its_own_under_another_name(self):
        with pytest.raises(
            ValueError, match=r"unknown hand 'gripper'; allowed: shadow, mpl, allegro, or"
        ):
            hands.get("gripper")
        with pytest.raises(FileNotFoundError, match="does not exist"):
            hands.get("nowhere.toml")

    @pytest.mark.parametrize("simulator", ["mujoco", "pybullet"])
    def test_parts_of_links_need_no_names(self, own, simulator):
        part = "<body><geom type='sphere' size='0.003' mass='0.001'/></body>"
        own('<body name="left_1"', f'{2 * part}<body name="left_1"', "gripper.xml")
        env = GraspEnv(own(), setup(own(), simulator=simulator))
        env.reset(seed=0)
        assert not env.step(np.zeros(env.action_space.shape))[-1]["diverged"]
        env.close()

    @pytest.mark.parametrize(("file", "old", "new", "complaint"), WRONG)
    def test_what_is_wrong_is_one_line(self, own, file, old, new, complaint, capsys):
        path = own(old, new, f"gripper.{file}")
        if not complaint:  # a mesh that nothing uses may be missing
            hands.get(path)
            return
        fails_with(capsys, ["env", "--env", path], complaint)

    def test_the_digest_is_of_what_the_model_includes_too(self, own, tmp_path):
        (tmp_path / "more.xml").write_text("<mujoco><size nuserdata='1'/></mujoco>")
        path = own("  <worldbody>", "  <include file='more.xml'/><worldbody>", "gripper.xml")
        path = own()
        before = hands.digest(path)
        (tmp_path / "more.xml").write_text("<mujoco><size nuserdata='2'/></mujoco>")
        assert hands.digest(path) != before

    def test_a_file_that_is_too_large_is_refused(self, own, tmp_path):
        path = Path(own())
        path.write_text(path.read_text() + "#" * toml_files.LARGEST)
        with pytest.raises(ValueError, match="found more than 10,000,000 bytes"):
            hands.get(str(path))

    def test_a_model_that_breaks_by_itself_is_refused(self, own):
        """A stiff servo on a light link, taken in steps that are too large for it."""
        stiff = "[servos.hinge]\ngain = 1e5\ndamping = 0.0\narmature = 0.0\nlimit = 1e6\n"
        with pytest.raises(ValueError, match="does not hang still: joint"):
            hands.get(own("[digits]", f"{stiff}[digits]"))

    def test_closing_actions(self, own):
        text = "[actions]\nkind = 'closing'\ngroups = [['left', 'right'], ['back']]\n[opened]"
        hand = hands.get(own("[opened]", text))
        assert hand.action_names[3:] == ("closing of left and right", "closing of back")
        targets = hand.action_map(np.array([0, 0, 0, 1.0, 0]), hand.start_targets())
        moved = targets != hand.start_targets()
        assert moved.tolist() == [False] * 3 + [True] * 4 + [False] * 2


class TestTouch:
    def test_agrees_with_distances_within_the_skin(self):
        """Of boxes and hulls: on while a cube is nearer than SKIN, off beyond, by points of a hull."""
        hand = hands.get(GRIPPER)
        taxels = layouts.load("5").place(hand)
        rule, shape = SkinTouch(taxels, hand), objects.make("box", (0.04,))
        rng = np.random.default_rng(0)
        for index in range(len(taxels)):
            link = taxels.link_index[index]
            turn, place = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
            k = len(taxels.links)
            poses = np.tile(place, (k, 1)), np.tile(turn, (k, 1, 1))
            poses[0][np.arange(k) != link] += 1.0  # the others are far away
            for gap, on in ((-1e-4, True), (SKIN - 1e-4, True), (SKIN + 1e-4, False)):
                centre = taxels.positions[index] + (0.02 + gap) * taxels.normals[index]
                axes = np.linalg.svd(taxels.normals[index][None])[2].T[:, [1, 2, 0]]
                state = State(shape, place + turn @ centre, turn @ axes, taxels.links, *poses)
                assert rule.read(state)[index] == on, (taxels.names[index], gap)

    def test_many_readings_at_once_are_those_one_by_one(self):
        hand = hands.get(GRIPPER)
        taxels = layouts.load("1").place(hand)
        rule, shape = SkinTouch(taxels, hand), objects.make("box", (0.05,))
        rng, k = np.random.default_rng(1), len(taxels.links)
        positions = 0.02 * rng.normal(size=(20, k, 3))
        rotations = Rotation.random(20 * k, rng=rng).as_matrix().reshape(20, k, 3, 3)
        turns = Rotation.random(20, rng=rng).as_matrix()
        arrays = 0.03 * rng.normal(size=(20, 3)), turns, positions, rotations

        def state(centres, turns, *poses):
            return State(shape, centres, turns, taxels.links, *poses)

        together = rule.read(state(*arrays))
        assert together.any()
        assert not together.all()
        for i in range(20):
            assert (rule.read(state(*(array[i] for array in arrays))) == together[i]).all()


MALFORMED = [
    ("a.json", b'[{"link_name": "x"}]', "not of this format (KeyError: 'probes')"),
    ("a.json", b"[]", "found 0 taxels"),
    ("a.csv", b"x,y\n1,2\n", "found the columns x, y, expected link, x"),
    ("a.csv", b"link,x,y,z,nx,ny,nz,radius\na,1,2\n", "line 2: found"),
    ("a.csv", b"link,x,y,z,nx,ny,nz,radius\na,0,0,0,0,0,0,.002\n", "normal: found [0.0, 0.0, 0.0]"),
    ("a.csv", b"link,x,y,z,nx,ny,nz,radius\na,0,0,0,0,0,1,9\n", "taxel 1: radius: found 9"),
    ("a.csv", b"link,x,y,z,nx,ny,nz,radius\na,nan,0,0,0,0,1,.002\n", "position: found"),
    ("a.csv", b"link,x,y,z,nx,ny,nz,radius\n" + 2 * b"a,0,0,0,0,0,1,.002\n", "found the same place"),
    ("a.toml", b"[[taxel]]\nlink = 3\n", "taxel 1: link: found 3"),
    ("a.toml", b"[[taxel]]\nlink = 'x'\nfoo = 1\n", "taxel 1: unknown key 'foo'"),
    ("a.toml", b"[[sensor]]\nfile = 'x.stl'\n", "sensor 1: file: found 'x.stl'"),
]


class TestTaxelFiles:
    taxels = layouts.load("1").place(hands.get(GRIPPER))

    @pytest.mark.parametrize("suffix", [".json", ".csv", ".toml"])
    def test_what_is_written_is_read_again(self, tmp_path, suffix):
        path = tmp_path / f"points{suffix}"
        path.write_bytes(taxel_formats.WRITERS[suffix](self.taxels.points))
        again = layouts.load(str(path)).place(hands.get(GRIPPER))
        found, wanted = (
            sorted(
                (p.link, *np.round([*p.position, *p.normal, p.radius], 9) + 0.0) for p in taxels.points
            )
            for taxels in (again, self.taxels)
        )
        assert found == wanted

    def test_points_keep_their_place_through_a_layout_of_their_own(self):
        hand = hands.get(GRIPPER)
        points = layouts.Layout("points", "", (), tuple(self.taxels.points))
        placed = points.place(hand)
        assert placed.names == self.taxels.names
        assert len(set(places.of(placed))) == len(placed)
        again = layouts.of_taxels(placed, hand, "again").place(hand)
        key = [sorted(map(tuple, taxels.positions.tolist())) for taxels in (again, placed)]
        assert key[0] == key[1]
        chosen = placed.take([3, 1])
        assert chosen.names == (placed.names[3], placed.names[1])
        assert places.of(chosen) == [places.of(placed)[3], places.of(placed)[1]]

    def test_a_genesis_file_as_it_is_published(self, tmp_path):
        """Entries a link, probes in rows of a grid, which those of radius 0 fill up."""
        probe = {"radius": 0.004, "pos": [-0.006, 0.001, -0.02], "normal": [-0.8, 0.1, 0.6]}
        other = {**probe, "pos": [-0.006, -0.001, -0.02]}
        padding = {"radius": 0, "pos": [0, 0, 0], "normal": [0, 0, 1]}
        rows = [[probe, padding], [other, padding]]
        grid = {"link_name": "left_2", "kind": "grid", "probes": rows}
        path = tmp_path / "probes.json"
        path.write_text(json.dumps([grid]))
        taxels = layouts.load(str(path)).place(hands.get(GRIPPER))
        assert taxels.links == ("left_2",)
        assert taxels.radii.tolist() == [0.004] * 2
        np.testing.assert_allclose(np.linalg.norm(taxels.normals, axis=1), 1.0)

    def test_a_pattern_is_put_on_links(self, tmp_path):
        """DEX-01: poses whose z axes are the normals, here turned so that they look along x."""
        poses = np.zeros((3, 3, 4))
        poses[:, :, :3], poses[:, 0, 3] = np.eye(3), [0.0, 1e-3, 2e-3]
        np.savez(tmp_path / "pad.npz", poses=poses, taxel2pixel=np.array([[0, 0], [0, 1], [1, 0]]))
        turn = Rotation.from_euler("y", 90, degrees=True).as_quat(scalar_first=True).tolist()
        mount = 'file = "pad.npz"\nlinks = ["left_2", "right_2"]\nposition = [0, 0, -0.01]\n'
        layout = tmp_path / "layout.toml"
        layout.write_text(f"[[sensor]]\n{mount}quaternion = {turn}\nradius = 0.001\n")
        taxels = layouts.load(str(layout)).place(hands.get(GRIPPER))
        assert len(taxels) == 6
        np.testing.assert_allclose(taxels.normals, np.tile([1.0, 0, 0], (6, 1)), atol=1e-12)
        np.testing.assert_allclose(taxels.positions[2], [0, 0, -0.012], atol=1e-12)
        with pytest.raises(ValueError, match="names no link"):
            layouts.load(str(tmp_path / "pad.npz"))

    @pytest.mark.parametrize(("name", "content", "complaint"), MALFORMED)
    def test_malformed_files_are_one_line(self, tmp_path, name, content, complaint):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match="file") as error:
            layouts.load(str(path))
        assert complaint in str(error.value)
        assert "\n" not in str(error.value)

    def test_a_link_that_the_hand_has_not(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("link,x,y,z,nx,ny,nz,radius\ntoe,0,0,0,0,0,1,.002\n")
        with pytest.raises(ValueError, match="found link 'toe', allowed: left_1, left_2"):
            layouts.load(str(path)).place(hands.get(GRIPPER))

    def test_points_off_the_skin_are_named(self):
        hand = hands.get(GRIPPER)
        points = [point._replace(name=f"{i}") for i, point in enumerate(self.taxels.points)]
        far = points[0]._replace(position=(0.02, 0.0, -0.02))
        layout = layouts.Layout("far", "", (), (far, *points[1:]))
        assert hand_map.off_skin(hand, layout.place(hand)) == ["0"]
        shadow = hands.get("shadow")
        taxels = layouts.load("6").place(shadow).points
        inside = taxels[0]._replace(position=(0.0, 0.0, 0.01), radius=0.001)
        layout = layouts.Layout("inside", "", (), (inside, *taxels[1:]))
        assert hand_map.off_skin(shadow, layout.place(shadow)) == [inside.name]

    def test_a_patch_without_digits_and_segments_is_on_all(self, tmp_path):
        path = tmp_path / "all.toml"
        path.write_text("[[patch]]\noffsets_mm = [[0, 0]]\nradius_mm = 2\n")
        layout = layouts.load(str(path))
        hand = hands.get(GRIPPER)
        assert len(layout.place(hand)) == 6
        path.write_text(layout.toml())
        assert layouts.load(str(path)) == layout

    def test_export(self, tmp_path, capsys):
        for suffix in (".json", ".csv", ".toml"):
            path = tmp_path / f"layout{suffix}"
            assert main(["env", "--env", "shadow", "--layout", "4", "--export", str(path)]) == 0
            assert len(layouts.load(str(path)).place(hands.get("shadow"))) == 79
        stl = ["env", "--env", "shadow", "--export", tmp_path / "a.stl"]
        fails_with(capsys, stl, "allowed names that end in")


class TestCommands:
    def test_a_run_knows_its_hand_again(self, own, tmp_path, capsys):
        path, run = own(), str(tmp_path / "run")
        points = tmp_path / "points.csv"
        points.write_bytes(
            taxel_formats.WRITERS[".csv"](layouts.load("5").place(hands.get(path)).points)
        )
        flags = ["--env", path, "--layout", str(points), "--total-timesteps", "40"]
        flags += ["--steps-per-epoch", "20", "--max-episode-steps", "10", "--hold-seconds", "0.1"]
        assert main(["train", "--algo", "ppo", *flags, "--out", run]) == 0
        points.unlink()  # the run has its own copy
        assert main(["evaluate", run, "--episodes", "1"]) == 0
        assert main(["train", "--resume", run, "--total-timesteps", "60"]) == 0
        own("-0.7 1.2", "-0.7 1.1", "gripper.xml")
        evaluate = ["evaluate", run, "--episodes", "1"]
        fails_with(capsys, evaluate, "have changed since it was made")
        Path(path).unlink()
        fails_with(capsys, evaluate, "hand of this run cannot be read: hand file")
        assert RunDir(Path(run)).read_config()[0].run.env == path  # it can still be read

    def test_doctor_finds_a_grasp(self, own, capsys, monkeypatch):
        monkeypatch.setattr(grasp_search, "ROUNDS", (24, 6))
        monkeypatch.setattr(grasp_search, "STARTS", 2)
        text = Path(own()).read_text()
        path = own(text[text.index("[[grasp]]") :], "")
        assert main(["doctor", "--env", path, "--grasps", "3", "--layout", "1", "--json"]) in (0, 1)
        said = capsys.readouterr()
        (figures,) = json.loads(said.out)
        assert figures["held"] >= 2
        kept = Path(path).with_suffix(".grasp.toml")
        assert f"kept in {kept}" in said.err
        assert len(hands.get(path).grasps) == 1
        assert main(["doctor", "--env", path, "--grasps", "1", "--layout", "5", "--json"]) in (0, 1)
        assert "looking for one" not in capsys.readouterr().err
        Path(path).write_text(Path(path).read_text() + "# changed\n")
        assert not hands.get(path).grasps  # it was found for another file

    def test_a_hand_that_cannot_grasp_is_told(self, own, capsys, monkeypatch, in_tmp):
        monkeypatch.setattr(grasp_search, "ROUNDS", (2,))
        monkeypatch.setattr(grasp_search, "STARTS", 1)
        text = Path(own()).read_text()
        path = own(text[text.index("[[grasp]]") :], "")
        path = own('"*_knuckle" = 0.4\n"*_tip" = 0.4', '"*_knuckle" = -0.38\n"*_tip" = 0.02')
        assert main(["doctor", "--env", path, "--grasps", "1", "--layout", "1"]) == 2
        assert "found no grasp that holds a 50 mm object" in capsys.readouterr().err

    def test_a_probes_folder_is_made_here_not_beside_the_hands_file(self, own, tmp_path, monkeypatch):
        hand, here = own(), tmp_path / "here"
        here.mkdir()
        monkeypatch.chdir(here)
        few = ["--simulator", "mujoco", "--grasps", "1", "--workers", "1", "--layout", "5"]
        assert main(["probe", "--env", str(Path(hand).resolve()), *few]) == 2  # of one, nothing follows
        assert [path.parent.name for path in here.rglob("grasps.npz")] == ["gripper_mujoco"]

    def test_the_probe_reads_any_points(self, tmp_path, capsys):
        points = tmp_path / "points.json"
        hand = hands.get(GRIPPER)
        points.write_bytes(taxel_formats.WRITERS[".json"](layouts.load("1").place(hand).points))
        asked = ["--joint-noise", "0.05", "--resamples", "100", "--shuffles", "2", "--folds", "2"]
        flags = ["--env", GRIPPER, "--grasps", "60", "--layout", "5", str(points)]
        flags += ["--start-offset", "0.005"]
        assert main(["probe", *flags, *asked, "--out", str(tmp_path), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert 0.1 < found["held"] < 0.95
        assert (tmp_path / "gain.png").stat().st_size > 1000
