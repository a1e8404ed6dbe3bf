"""Design: the best taxels of recorded starts, judged on others; what it writes, and what it refuses."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import tactilerl
from tactilerl.commands.cli import main
from tactilerl.envs import hands
from tactilerl.placement import choice, cover
from tactilerl.placement.candidates import DesignFlags, Pool, candidates
from tactilerl.placement.cover import NEVER, Starts

from one_line import fails_with

FEW = ["--starts", "4", "--test-starts", "4", "--workers", "1", "--seed", "7", "--beside", "2"]
FEW += ["--skin", "8mm"]


def some(rng, n=12, m=8):
    """Starts in which closing succeeds at some moments and not at others, without any order."""
    fires = np.where(rng.random((n, m)) < 0.4, rng.integers(10, 16, (n, m)), NEVER).astype(np.uint8)
    succeeds = np.zeros((n, NEVER + 1), bool)
    succeeds[:, 5:16] = rng.random((n, 11)) < 0.7
    return starts_of(fires, succeeds)


def starts_of(fires, succeeds):
    n = len(fires)
    return Starts(np.array(fires, np.uint8), succeeds, np.zeros(n), np.zeros(n), np.full(n, 1 / n))


class TestCover:
    def test_no_other_set_is_better(self):
        rng = np.random.default_rng(0)
        for _ in range(15):
            starts = some(rng)
            best = max(cover.value(starts, x) for x in itertools.combinations(range(8), 3))
            found = cover.choose(starts, 3)
            assert found.value == pytest.approx(best)
            assert found.bound == pytest.approx(best)
            assert found.value == pytest.approx(cover.value(starts, found.taxels))

    def test_one_more_taxel(self):
        starts = some(np.random.default_rng(1))
        each = cover.values_with_each(starts, [0, 3])
        assert each == pytest.approx([cover.value(starts, [0, 3, j]) for j in range(8)])
        assert cover.value(starts, []) == 0.0

    def test_what_fires_too_early_spoils_a_start(self):
        succeeds = np.zeros((1, NEVER + 1), bool)
        succeeds[0, 20] = True
        starts = starts_of([[20, 8]], succeeds)
        assert cover.value(starts, [0]) == 1.0
        assert cover.value(starts, [0, 1]) == 0.0
        assert cover.choose(starts, 2).value == 0.0

    def test_what_the_hand_has_stays(self):
        starts = some(np.random.default_rng(3))
        found = cover.choose(starts, 3, kept=[5])
        others = itertools.combinations([0, 1, 2, 3, 4, 6, 7], 2)
        best = max(cover.value(starts, [5, *x]) for x in others)
        assert 5 in found.taxels
        assert found.value == pytest.approx(best)

    def test_no_two_overlap(self):
        starts, overlap = some(np.random.default_rng(4)), np.zeros((8, 8), bool)
        free = cover.choose(starts, 3)
        overlap[np.ix_(free.taxels, free.taxels)] = ~np.eye(3, dtype=bool)
        found = cover.choose(starts, 3, overlap=overlap)
        fitting = [x for x in itertools.combinations(range(8), 3) if not overlap[np.ix_(x, x)].any()]
        assert tuple(found.taxels) in fitting
        assert found.value <= free.value
        assert found.value == pytest.approx(max(cover.value(starts, x) for x in fitting))

    def test_room_that_greedy_does_not_leave(self):
        succeeds = np.zeros((3, NEVER + 1), bool)
        succeeds[:, 5] = True
        starts = starts_of([[5, 5, NEVER], [NEVER, 5, 5], [5, NEVER, 5]], succeeds)
        starts.weights[:] = 0.4, 0.4, 0.2
        overlap = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], bool)  # a row of three
        assert cover.choose(starts, 2, overlap=overlap).taxels == [0, 2]

    def test_no_room(self):
        starts, overlap = some(np.random.default_rng(5)), ~np.eye(8, dtype=bool)
        with pytest.raises(ValueError, match="taxels: found 3, allowed up to 1"):
            cover.choose(starts, 3, overlap=overlap)


class TestSizes:
    """Sensors of a radius of their own."""

    def test_random_sets_do_not_overlap(self):
        pool = Pool.of(DesignFlags(scene=("handover",), radius=10.0))
        assert pool.overlap.any()
        for seed in range(5):
            drawn = choice.drawn(8, pool, np.random.default_rng(seed))
            at = [pool.columns.index(column) for column in drawn]
            assert len(set(drawn)) == 8
            assert not pool.overlap[np.ix_(at, at)].any()


class TestCandidates:
    def test_only_some_digits_and_segments(self):
        hand = hands.get("mpl")

        def where(**choices):
            taxels = candidates(DesignFlags(**choices), hand)
            return {(hand.surfaces[i].digit, hand.surfaces[i].segment) for i in taxels.surfaces}

        assert where(only=("index.distal",)) == {("index", "distal")}
        assert {digit for digit, _ in where(only=("index",))} == {"index"}
        assert {segment for _, segment in where(only=("palm", "middle"))} == {"palm", "middle"}
        left = where(leave_out=("thumb", "palm"))
        assert not {"thumb", "palm"} & {name for at in left for name in at}

    def test_a_radius_of_ones_own(self):
        taxels = candidates(DesignFlags(radius=4.0, skin="6"), hands.get("mpl"))
        assert len(taxels) == 19
        assert set(taxels.radii) == {4e-3}


def test_starts_are_resampled_within_their_scenes():
    """Where every start of one scene succeeds and none of the other, nothing is uncertain."""
    succeeds = np.zeros((8, NEVER + 1), bool)
    succeeds[:4, 5] = True
    starts = starts_of([[5, 5]] * 8, succeeds)
    starts.weights[:] = np.repeat([0.75, 0.25], 4) / 4
    judge = choice.Judge({None: starts}, {None: starts}, 2)
    assert judge.row("x", [0]).success_interval == pytest.approx([0.75, 0.75])
    assert judge.hopeless == 0.25


@pytest.mark.usefixtures("in_tmp")
class TestCommand:
    def test_writes_layouts_figures_and_the_same_bytes_again(self, capsys):
        args = ["design", "--scene", "handover", "--taxels", "1..2", *FEW]
        for out in ("a", "b"):
            assert main([*args, "--out", out]) == 0
        said = capsys.readouterr().out
        assert "taxels for a hand that closes at the first touch" in said
        assert "tactilerl train --scene handover --layout a/design_1.toml" in said
        names = {path.name for path in Path("a").iterdir() if path.name != ".lock"}
        assert names == {"design.json", "design_1.toml", "design_2.toml", "hand.png", "curve.png"}
        for name in names:
            assert Path("a", name).read_bytes() == Path("b", name).read_bytes(), name
        result = json.loads(Path("a/design.json").read_text())
        rows = {(row["layout"], row["taxels"]): row for row in result["rows"]}
        assert rows["whole skin", result["candidates"]]["success"] == 1.0
        assert rows["chosen", 2]["success"] >= 0.5 > rows["random", 2]["success"]
        assert main(["design", "--scene", "handover", "--taxels", "2", *FEW, "--json"]) == 0
        alone = json.loads(capsys.readouterr().out)["rows"]
        assert rows["random", 2] == next(row for row in alone if row["layout"] == "random")
        assert main(["gate", "--scene", "handover", "--layout", "a/design_1.toml", "--starts", "4",
                     "--search", "1", "--workers", "1"]) == 0  # fmt: skip

    def test_from_python(self):
        few = dict(starts=4, test_starts=4, skin="8mm", beside=(), workers=1)
        layout = tactilerl.design(scene="handover", taxels=2, **few)
        assert len(tactilerl.make(scene="handover", layout=layout).unwrapped.taxels) == 2

    def test_every_set_waits_as_suits_it_best(self, capsys):
        args = ["design", "--scene", "handover_anywhere", *FEW, "--starts", "8"]
        rows = {}
        for waits in ("0.2", "0.35", "0.2 0.35"):
            assert main([*args, "--taxels", "2", "--start-closing", *waits.split(), "--json"]) == 0
            found = json.loads(capsys.readouterr().out)["rows"]
            rows[waits] = {row["layout"]: row for row in found}
        alone = [rows[wait]["chosen"]["chosen_from"] for wait in ("0.2", "0.35")]
        assert alone[0] != alone[1]
        best = str(rows["0.2 0.35"]["chosen"]["start_closing"])
        assert (
            rows["0.2 0.35"]["chosen"]["chosen_from"]
            == rows[best]["chosen"]["chosen_from"]
            == max(alone)
        )
        assert rows["0.2 0.35"]["chosen"]["success"] == rows[best]["chosen"]["success"]
        args += ["--start-closing", "0.35", "--env", "mpl", "--simulator", "mujoco", "--out", "c.toml"]
        assert main(args) == 0
        said = capsys.readouterr().out
        assert "waits at" in said
        assert (
            "train --scene handover_anywhere --env mpl --simulator mujoco --layout c.toml "
            "--start-closing 0.35"
        ) in said

    @pytest.mark.parametrize(
        ("args", "named"),
        [
            (["--start-closing", "1"], "start_closing: found 1.0, allowed from 0 to below 1"),
            (["--scene"], "scene: found none"),
            (["--scene", "all.toml", "--start-closing", "0.3"], "start_closing: found [0.3]"),
            (["--taxels", "0"], "taxels: found '0'"),
            (["--taxels", "3..2"], "taxels: found '3..2'"),
            (["--taxels", "1e9"], "taxels: found '1e9'"),
            (["--taxels", "99", "--skin", "5"], "taxels: found 99, allowed up to the 19 that may be"),
            (["--only", "toe"], "toe: unknown"),
            (["--only", "index", "--not", "index"], "--only index --not index: no taxel is left"),
            (["--not", "palm", "distal", "middle", "proximal"], "--not palm distal middle"),
            (["--skin", "xmm"], "skin: found 'xmm'"),
            (["--beside", "9"], "unknown layout '9'"),
            (["--keep", "gone.toml"], "gone.toml"),
            (["--scene", "foot"], "scene: found 'foot'"),
            (["--scene", "handover", "dark_mpl"], "says tactilerl gate --scene dark_mpl"),
            (["--weights", "1", "2"], "weights: found 2"),
            (["--env", "foot"], "env: found 'foot'"),
            (["--taxels", "1..2", "--out", "x.toml"], "--out: found 'x.toml'"),
            (["--out", "x.png"], "--out: found 'x.png'"),
            (["--out", "mine.toml"], "it is there already"),
            (["--out", "gone/x.toml"], "found no folder 'gone'"),
            (["--scene", "handover_fingers", "--only", "palm", "--skin=8mm", "--starts=3", "--json"],
             "no taxel feels any start in time"),
        ],
    )  # fmt: skip
    def test_what_cannot_be_is_one_line(self, args, named, capsys):
        mine = 'description = "My own."\n[[patch]]\noffsets_mm = [[0, 0]]\nradius_mm = 2\n'
        Path("mine.toml").write_text(mine)
        Path("all.toml").write_text('base = "handover"\n[scene]\nactions = "all"\n')
        fails_with(capsys, ["design", "--test-starts", "2", "--workers", "1", *args], named)
        assert Path("mine.toml").read_text() == mine
        assert {*Path().iterdir()} == {Path("mine.toml"), Path("all.toml")}

    def test_a_scene_that_touch_cannot_help(self, capsys):
        Path("seen.toml").write_text(
            'base = "handover"\n[scene]\nobject_seen = "noisy"\nsight_noise = [0.001, 0.001]\n'
        )
        scene = ["--scene", "seen.toml", "--json"]  # else a line says first that it plays
        fails_with(capsys, ["design", *scene, *FEW], "scene: touch cannot help here")
