"""`tactilerl probe`: grasps, what is read from them, what can be told, and errors in one line."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import balanced_accuracy_score, r2_score, roc_auc_score
from tactilerl import statistics
from tactilerl.commands.cli import main
from tactilerl.envs import hands, layouts, scripted
from tactilerl.errors import BUSY, InputError
from tactilerl.files import locked
from tactilerl.pictures import places
from tactilerl.probe import analysis, estimators, figures, files, grasps, metrics, selection
from tactilerl.probe.grasps import Scenes, drawn_start, links_of, moment, stack
from tactilerl.probe.options import AnalysisFlags, GraspFlags
from tactilerl.probe.readings import Grasps
from threadpoolctl import threadpool_info, threadpool_limits

from one_line import fails_with

GRIPPER = str(Path(__file__).parents[1] / "hands" / "gripper.toml")
ASKED = ["--joint-noise", "0", "--resamples", "200", "--shuffles", "2", "--folds", "2", "--workers=1"]
TOUCHED = ("index", "distal")
DRAWN = GraspFlags(
    env="mpl", simulator="mujoco", seed=1, object_size=(0.04, 0.05), friction=(1.0,), start_offset=0.02,
    start_yaw=0.5, closing=(0.7, 1.1),
)  # fmt: skip


def synthetic(hand, touches):
    """Grasps of a hand with its links far apart, whose joints never differ; where `touches`, a cube
    lies on the tip of the index finger, elsewhere far from everything."""
    touches = np.array(touches, bool)
    n, links = len(touches), links_of(hand)
    surface = next(s for s in hand.surfaces if (s.digit, s.segment) == TOUCHED)
    apart = np.column_stack([np.arange(len(links)), np.zeros((len(links), 2))])
    on_tip = apart[links.index(surface.link)] + surface.place(0, 0)[0] + 0.02 * np.array(surface.palmar)
    return {
        "held": touches.copy(),
        "broken": np.zeros(n, bool),
        "joint_positions": np.zeros((n, len(hand.joints))),
        "joint_velocities": np.zeros((n, len(hand.joints))),
        "link_positions": np.tile(apart, (n, 1, 1)),
        "link_rotations": np.tile(np.eye(3), (n, len(links), 1, 1)),
        "object_position": np.where(touches[:, None], on_tip, on_tip + np.array([0, 5.0, 0])),
        "object_orientation": np.tile([1.0, 0, 0, 0], (n, 1)),
        "object_kind": np.zeros(n, int),
        "object_half_size": np.full((n, 3), 0.02),
    }


def played(path, n, workers=1, show=lambda done: None, **others):
    return files.play(path / "grasps.npz", replace(DRAWN, grasps=n, **others), workers, show).records


def same(a, b):
    return set(a) == set(b) and all(np.array_equal(a[name], b[name]) for name in a)


class TestGrasps:
    def test_the_same_with_one_and_with_two_workers_and_in_parts(self, tmp_path):
        for name in ("one", "two"):
            (tmp_path / name).mkdir()
        whole, shown = played(tmp_path / "one", 3), []
        for n in (2, 3):  # the second call plays one
            parts = played(tmp_path / "two", n, 2, shown.append)
        assert shown == [0, 1, 2, 2, 3]
        assert same(whole, parts)
        assert same(whole, files.read(tmp_path / "two/grasps.npz").records)
        with pytest.raises(InputError, match="seed: found 2, but its grasps have 1"):
            played(tmp_path / "two", 3, seed=2)

    def test_grasps_of_0_3_0_with_contacts_are_read(self, tmp_path):
        records = synthetic(hands.get("shadow"), [0, 1])
        about = {"format": 1, "env": "shadow", "simulator": "mujoco", "touch": "contact", "seed": 0}
        about["contact_places"] = [{"surface": 0, "row": 0.0, "column": 0.0, "radius": 1.0}]
        arrays = {**records, "contact": np.zeros((2, 1), bool), "settings": np.array(json.dumps(about))}
        np.savez(tmp_path / "old.npz", **arrays)
        assert same(files.read(tmp_path / "old.npz").records, records)

    def test_another_number_is_another_grasp_and_another_object(self, tmp_path):
        records = played(tmp_path, 6)
        assert len(np.unique(records["joint_positions"], axis=0)) == 6
        assert set(records["object_half_size"][:, 0]) == {0.02, 0.025}

    def test_interrupted_play_keeps_what_there_is(self, tmp_path):
        def stop(done):
            if done == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            played(tmp_path, 9, show=stop)
        assert len(files.read(tmp_path / "grasps.npz").records["held"]) == 2


class TestReadings:
    @pytest.mark.parametrize("hand", ["mpl", GRIPPER])
    def test_are_those_of_the_environment(self, hand, read_here):
        """Of capsules, of boxes and of hulls: many at once as one by one."""
        one = dict(object_size=(0.05,), start_offset=0.0, start_yaw=0.1, closing=(1, 1), seed=0)
        scenes, felt, records = Scenes(replace(DRAWN, env=hand, **one)), [], []
        env = scenes.scene(0)
        for number in range(2):  # the scene is left at the end of a hold
            grasps.play(scenes, number)
            felt.append(env.taxel_readings())
            records.append(moment(env))
        assert np.array(felt).any()
        assert np.array_equal(Grasps(env.hand, stack(records)).feel(env.taxels), np.array(felt))

    def test_object_in_the_hand_does_not_depend_on_where_the_hand_is(self):
        hand = hands.get("mpl")
        records = synthetic(hand, [0, 1])
        before = Grasps(hand, records).object_in_hand()
        turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        moved = dict(records)
        moved["link_positions"] = records["link_positions"] @ turn.T + 0.3
        moved["link_rotations"] = turn @ records["link_rotations"]
        moved["object_position"] = records["object_position"] @ turn.T + 0.3
        moved["object_orientation"] = np.tile([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (2, 1))
        after = Grasps(hand, moved).object_in_hand()
        assert np.allclose(before[0], after[0])
        assert np.allclose(before[1], after[1])


def test_joint_noise_has_its_size():
    hand = hands.get("shadow")
    grasps = Grasps(hand, synthetic(hand, np.zeros(2000)))  # whose joints never differ
    noise = analysis.Probe(grasps, {}, AnalysisFlags(), seed=0, jobs=1).features(0.05, "joints")
    assert noise.std() == pytest.approx(0.05, rel=0.02)


class TestPlaces:
    def test_a_layout_written_from_its_places_is_the_same_layout(self, hand, tmp_path):
        hand = hands.get(hand)
        for layout in (layouts.load("1"), layouts.load("6"), places.dense_skin(hand, 0.004)):
            placed = layout.place(hand)
            spots = places.of(placed)
            file = tmp_path / "layout.toml"
            file.write_text(layouts.of_taxels(placed, hand, 'a "name"').toml())
            again = layouts.load(str(file)).place(hand)
            assert sorted(places.of(again)) == sorted(spots)
            assert len(set(spots)) == len(placed)
            order = [places.of(again).index(spot) for spot in spots]
            assert np.allclose(again.positions[order], placed.positions, atol=2e-7)

    def test_the_skin_covers_the_phalanges_from_end_to_end(self):
        hand = hands.get("shadow")
        middle = next(s for s in hand.surfaces if s.digit == "thumb" and s.segment == "middle")
        rows = {
            (place.row, place.column)
            for place in places.of(places.dense_skin(hand, 0.002).place(hand))
            if hand.surfaces[place.surface] is middle
        }
        # Bone of 32 mm around its centre, radius 11 mm: rows -16 to 16, columns -10 to 10, every 2.
        assert len(rows) == 17 * 11

    def test_the_skin_reaches_as_far_as_the_papers_layouts(self, hand):
        """Over the round fingertips too: no taxel of layout 1 is far out beyond the skin."""
        built = hands.get(hand)
        skin = places.of(places.dense_skin(built, 0.001).place(built))
        for place in places.of(layouts.load("1").place(built)):
            beside = [other for other in skin if other.surface == place.surface]
            assert min(np.hypot(o.row - place.row, o.column - place.column) for o in beside) < 2.5


def test_grasps_start_where_nothing_overlaps(hand):
    """Of 100 widely perturbed starts none is more than 0.1 mm deep in the object."""
    drawn = GraspFlags(env=hand, simulator="mujoco", object_size=(0.04, 0.05), friction=(1.0,))
    drawn.validate()
    scenes, deepest = Scenes(drawn), []
    for number in range(100):
        env = scenes.scene(number % 2)
        scripted.place(env, drawn_start(drawn, env, np.random.default_rng(number)))
        model, data = env.simulator.model, env.simulator.data
        thing, ground = model.geom("object").id, model.geom("ground").id
        touching = [c for c in data.contact if thing in c.geom and ground not in c.geom]
        deepest.append(max((-c.dist for c in touching), default=0.0))
    assert max(deepest) < 1e-4


@pytest.mark.pybullet
def test_in_pybullet_a_grasp_at_rest_is_called_early_and_alike():
    own = dict(simulator="pybullet", object_size=(0.05,), start_offset=0.01, start_yaw=0.2)
    drawn = replace(DRAWN, **own, closing=(0.8, 1.1), joint_jitter=0.05)
    n_steps, held = {"full": 0, "settled": 0}, {}
    for verdict in n_steps:
        env = Scenes(replace(drawn, hold_verdict=verdict))
        simulator = env.scene(0).simulator

        def counted(targets, n, verdict=verdict, step=simulator.step):
            n_steps[verdict] += n
            step(targets, n)

        simulator.step = counted
        held[verdict] = [bool(grasps.play(env, k)["held"]) for k in range(3)]
    assert held["full"] == held["settled"]
    assert any(held["full"])
    assert n_steps["settled"] < 0.8 * n_steps["full"]


class TestMetrics:
    """Weights count how often a grasp is there: as if it stood there so often."""

    rng = np.random.default_rng(0)
    weights = np.concatenate([np.ones((1, 60), np.uint8), statistics.resample(rng, 60, 3).T])
    held = rng.random(60) < 0.5

    @pytest.mark.parametrize(
        ("name", "theirs", "truth", "guess"),
        [
            ("auc", roc_auc_score, held, rng.integers(5, size=(60, 1)) / 5),  # with ties
            ("r2", r2_score, *rng.random((2, 60, 2))),
            ("balanced_accuracy", balanced_accuracy_score, *rng.integers(3, size=(2, 60))),
        ],
    )
    def test_are_those_of_scikit_learn(self, name, theirs, truth, guess):
        each = [(np.repeat(truth, n, axis=0), np.repeat(guess, n, axis=0)) for n in self.weights]
        expected = [theirs(one, other.squeeze()) for one, other in each]
        assert np.allclose(metrics.measure(name, truth, guess, self.weights), expected)

    def test_distance_is_in_mm(self):
        truth, off = np.zeros((60, 2)), np.tile([0.003, 0.004], (60, 1))
        assert np.allclose(metrics.measure("error_mm", truth, off, self.weights), 5.0)

    def test_bits_of_a_sure_and_right_answer_are_the_outcomes_entropy(self):
        sure = np.column_stack([self.held.astype(float), np.full(60, 0.25)])
        p = self.held.mean()
        expected = -p * np.log2(0.25) - (1 - p) * np.log2(0.75)
        assert metrics.measure("bits", self.held, sure, self.weights)[0] == pytest.approx(expected)
        assert metrics.measure("log_loss", self.held, sure, self.weights)[0] == pytest.approx(
            0.0, abs=1e-9
        )

    def test_angles_wrap(self):
        truth = np.array([[0.01, np.pi / 2]])
        angle = 4 * (np.pi / 2 - 0.01)
        guess = np.array([[np.cos(angle), np.sin(angle)]])
        error = metrics.measure("error_deg", truth, guess, np.ones((1, 1)))
        assert error[0] == pytest.approx(np.degrees(0.02))


def write(path, records):
    settings = {"env": "shadow", "simulator": "mujoco", "touch_rule": "skin", "seed": 0}
    files.write(path, files.Played(records, settings))


@pytest.fixture
def one_taxel(tmp_path, in_tmp):
    """A file of 100 grasps, of which those that touch hold in 9 of 10 cases, and no others do in 9
    of 10; in a working directory of its own."""
    touches = np.arange(100) % 2 == 0
    records = synthetic(hands.get("shadow"), touches)
    records["held"] = touches ^ (np.arange(100) // 2 % 10 == 0)
    write(tmp_path / "grasps.npz", records)
    return tmp_path / "grasps.npz"


def result(capsys, *args):
    assert main(["probe", "--json", *ASKED, *args]) == 0
    return json.loads(capsys.readouterr().out)


def row(found, told, metric="auc", layout=None):
    keys = {"told": told, "metric": metric, "layout": layout}
    return next(r for r in found["table"] if all(r[k] == v for k, v in keys.items()))


class TestAnalysis:
    def test_one_taxel_decides_and_is_found(self, one_taxel, capsys):
        found = result(capsys, "--from", str(one_taxel), "--layout", "5")
        # Of a reading that is right in 9 of 10 cases of either outcome: (0.9 + 0.9) / 2.
        assert row(found, "joints")["value"] == pytest.approx(0.5, abs=0.05)
        told = row(found, "joints+taxels", layout="5")
        assert told["value"] == pytest.approx(0.9, abs=0.03)
        assert told["gain_interval"][0] > 0.2
        entropy = -0.9 * np.log2(0.9) - 0.1 * np.log2(0.1)
        bits = row(found, "joints+taxels", "bits", "5")["value"]
        assert bits == pytest.approx(1 - entropy, abs=0.06)
        place = found["worth"]["places"][int(np.argmax(found["worth"]["bits"]))]
        surface = hands.get("shadow").surfaces[place["surface"]]
        assert (surface.digit, surface.segment) == TOUCHED
        for name in ("gain", "worth"):
            assert (one_taxel.parent / f"{name}.png").stat().st_size > 1000
            assert (one_taxel.parent / f"{name}.svg").exists()
        assert json.loads((one_taxel.parent / "probe.json").read_text()) == found

    @pytest.mark.parametrize("name", ["probe.json", "gains.npz", "gain.png"])
    def test_the_files_of_others_stay(self, one_taxel, capsys, name):
        (there := one_taxel.parent / name).write_text("[1]")
        assert main(["probe", *ASKED, "--from", str(one_taxel), "--layout", "5"]) == 2
        assert "another file is there" in capsys.readouterr().err
        assert there.read_text() == "[1]"

    def test_no_signal_no_gain(self, one_taxel, capsys):
        records = files.read(one_taxel).records
        records["held"] = np.random.default_rng(1).permutation(records["held"])
        write(one_taxel, records)
        found = result(capsys, "--from", str(one_taxel), "--layout", "5", "1")
        for layout in ("5", "1"):
            low, high = row(found, "joints+taxels", layout=layout)["gain_interval"]
            assert low <= 0.0 <= high
        assert found["shuffled"]["is_zero"]
        assert all(d["p_holm"] > 0.05 for d in found["differences"] if d["question"] == "hold")

    def test_a_dead_taxel_tells_nothing(self, one_taxel, capsys):
        found = result(capsys, "--from", str(one_taxel), "--layout", "5", "--taxel-dead", "1")
        assert row(found, "joints+taxels", layout="5")["gain"] == pytest.approx(0.0, abs=1e-6)

    def test_the_same_figures_again_and_on_any_number_of_cores(self, one_taxel, capsys, monkeypatch):
        figures = []
        for cores in (1, 2):
            monkeypatch.setattr("tactilerl.probe.run.free_cores", lambda n=cores: n)
            figures.append(result(capsys, "--from", str(one_taxel), "--layout", "5"))
        assert figures[0] == figures[1]

    def test_selection_gains_as_much_as_the_layout_that_it_finds(self, one_taxel):
        hand, records = hands.get("shadow"), files.read(one_taxel).records
        grasps, taxels = Grasps(hand, records), layouts.load("5").place(hand)
        felt = grasps.feel(taxels)
        probe = analysis.Probe(grasps, {"5": felt}, AnalysisFlags(resamples=100))
        path, best, told = selection.select(probe, felt, [1], np.zeros((100, 0)))
        assert taxels.names[path[0]].partition("[")[0] == ".".join(TOUCHED)
        assert best[1][0] == pytest.approx(told["5"][0], abs=0.03)
        assert best[1][0] > 0.2

    def test_objects_held_out_are_on_one_side_only(self):
        groups, held = np.arange(40) % 3, np.arange(40) % 2 == 0
        kept = estimators.folds(held, 5, groups, 0)
        assert len(kept) == 3
        for train, test in kept:
            assert not set(groups[train]) & set(groups[test])

    def test_folds_with_too_few_to_learn_from_are_refused(self):
        with pytest.raises(ValueError, match="a fold with 2 of one outcome and 2 of the other"):
            estimators.folds(np.arange(8) % 2 == 0, 2, None, 0)
        apart = np.repeat([True, False], 4)
        with pytest.raises(ValueError, match="a fold with 0 of one outcome and 4 of the other"):
            estimators.folds(apart, 2, apart.astype(int), 0)

    def test_predictions_are_made_with_one_thread(self, monkeypatch):
        """However many the caller has: the last digits of a product depend on it."""

        def threads(features):
            return max(pool["num_threads"] for pool in threadpool_info())

        question = analysis.Question("threads", ("threads",), np.zeros(1), threads)
        monkeypatch.setitem(metrics.MEASURES, "threads", lambda truth, told, weights: np.array([told]))
        with threadpool_limits(2):
            assert threads(None) == 2
            assert analysis.answer(question, np.zeros((1, 1)), np.ones((1, 1))) == [1]

    def test_no_taxel_is_chosen_twice_nor_beside_its_copy(self):
        rng = np.random.default_rng(0)
        skin = rng.random((2000, 12)) < 0.3
        skin[:, 5] = skin[:, 3]
        held = 3.0 * skin[:, 3] - 1.5 * skin[:, 7] + rng.logistic(size=2000) > 0.3
        chosen = selection.forward(rng.standard_normal((2000, 4)), skin, held, 12)
        assert chosen[:2] == [3, 7]
        assert len(set(chosen)) == len(chosen)
        assert 5 not in chosen


class TestPlayed:
    def test_from_playing_to_the_answer_and_on(self, tmp_path, capfd, in_tmp):
        args = ["--env", "shadow", "--simulator", "mujoco", "--layout", "5"]
        args += ["--object-size", "0.04", "0.06", "--closing", "0.6", "1.4"]
        first = result(capfd, *args, "--grasps", "8")
        assert first["grasps"] == 8
        assert {"probe.json", "grasps.npz"} <= {p.name for p in tmp_path.glob("probes/*/*")}
        assert main(["probe", *ASKED, *args, "--grasps", "9"]) == 0
        told = capfd.readouterr()
        assert "Warning" not in told.err  # of the processes that ask, too
        for words in (": 9 grasps, ", "joints+layout 5", "outcomes shuffled"):
            assert words in told.out
        assert main(["probe", *args, "--grasps", "8", "--friction", "0.7"]) == 2
        assert "friction" in capfd.readouterr().err


def error(capsys, *args, code=2):
    return fails_with(capsys, ["probe", *args], code=code)


class TestFolder:
    def test_one_process_at_a_time(self, one_taxel, capsys):
        """Two at once both ended well, and one's grasps were gone."""
        out = one_taxel.parent
        with locked(out):
            said = error(capsys, "--out", str(out), "--seed", "1", "--grasps", "3", code=BUSY)
            assert f"process {os.getpid()} on " in said
            assert "is writing to this folder" in said
            assert "is writing" in error(capsys, "--from", str(one_taxel), code=BUSY)


class TestScene:
    def test_hand_simulator_and_objects_are_the_scenes(self):
        found = GraspFlags.of_scene("dark_mpl")
        assert (found.env, found.simulator, found.hold_verdict) == ("mpl", "mujoco", "settled")
        assert found.object_size == (0.04, 0.05)
        assert found.start_offset == 0.015
        assert found.friction == GraspFlags().friction

    def test_flags_change_what_it_says(self, capfd, in_tmp):
        args = ["--scene", "dark_mpl", "--simulator", "mujoco", "--object-size", "0.045"]
        found = result(capfd, *args, "--grasps", "8", "--layout", "5")
        assert found["env"] == "mpl"
        assert found["playing"]["perturbation"]["sizes"] == [0.045]

    def test_a_scene_that_is_handed_over_is_refused(self, capsys, in_tmp):
        assert "whose task is handover" in error(capsys, "--scene", "handover")
        Path("box.toml").write_text("[scene]\nobject_size = [0.03, 0.04, 0.05]\n")
        assert "several measures of an object" in error(capsys, "--scene", "box.toml")
        assert "scene: found 'nowhere', allowed: " in error(capsys, "--scene", "nowhere")


class TestBadInput:
    def test_damaged_grasps(self, one_taxel, capsys):
        whole = one_taxel.read_bytes()
        one_taxel.write_bytes(whole[: len(whole) // 2])
        assert "not a whole file of grasps" in error(capsys, "--from", str(one_taxel))
        one_taxel.write_bytes(b"no zip")
        assert "not a whole file of grasps" in error(capsys, "--from", str(one_taxel))
        assert one_taxel.read_bytes() == b"no zip"
        records = synthetic(hands.get("shadow"), [0, 1])
        del records["link_positions"]
        write(one_taxel, records)
        assert "link_positions is missing" in error(capsys, "--from", str(one_taxel))
        assert "does not exist" in error(capsys, "--from", "nowhere.npz")

    def test_fewer_grasps_than_folds_and_all_alike(self, one_taxel, capsys):
        records = synthetic(hands.get("shadow"), np.arange(20) < 3)
        write(one_taxel, records)
        assert "folds: found 5, allowed up to 3" in error(
            capsys, "--from", str(one_taxel), "--layout", "5"
        )
        records["held"][:] = True
        write(one_taxel, records)
        assert "same outcome" in error(capsys, "--from", str(one_taxel))

    @pytest.mark.parametrize(
        ("args", "message"),
        [
            (["--env", "hook"], "env: found 'hook'"),
            (["--layout", "2", "7"], "unknown layout '7'"),
            (["--grasps", "0"], "grasps: found 0"),
            (["--closing", "1", "0.5"], "closing: found 1.0 0.5"),
            (["--object-size", "0.2"], "--object-size: found 0.2"),
            (["--taxel-dead", "1.5"], "--taxel-dead: found 1.5"),
            (["--taxel-dead", "0.6", "--taxel-stuck", "0.6"], "--taxel-stuck: found 1.2 with"),
            (["--joint-noise", "-1"], "--joint-noise: found -1"),
            (["--folds", "1"], "folds: found 1"),
            (["--out", "/dev/null/x"], "cannot write '/dev/null/x"),
            (["--from", "x.npz", "--friction", "2"], "--friction"),
        ],
    )
    def test_flags(self, args, message, capsys, tmp_path, in_tmp):
        assert message in error(capsys, *args)
        assert not list(tmp_path.iterdir())


def test_a_map_without_taxels(tmp_path):
    """A selection may choose none."""
    drawn = figures.hand_map(hands.get("shadow"), [], np.zeros(0), "bits", "none")
    figures.save({"map": drawn}, tmp_path)
