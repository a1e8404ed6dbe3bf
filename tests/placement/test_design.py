"""Design: the best taxels of recorded starts, judged on others; what it writes, and what it refuses."""

import dataclasses
import itertools
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tactilerl
from tactilerl.commands.cli import main
from tactilerl.envs import hands, layouts, scenes
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.sensors import Cost
from tactilerl.pictures import hand_map
from tactilerl.placement import choice, cover
from tactilerl.placement.candidates import (
    DesignFlags,
    Groups,
    Pool,
    Prices,
    candidates,
    fitted,
    groups_of,
    overlap,
    skin,
)
from tactilerl.placement.cover import NEVER, Starts
from tactilerl.placement.recording import record
from tactilerl.scripted.reflexes import Reflex

from one_line import fails_with, printed

FEW = ["--starts", "3", "--test-starts", "3", "--workers", "1", "--seed", "7", "--beside", "2"]
FEW += ["--skin", "8mm"]


def some(rng, n=12, m=8):
    """Starts in which closing succeeds at some moments and not at others, without any order."""
    fires = np.where(rng.random((n, m)) < 0.4, rng.integers(10, 16, (n, m)), NEVER).astype(np.uint8)
    succeeds = np.zeros((n, NEVER + 1), bool)
    succeeds[:, 5:16] = rng.random((n, 11)) < 0.7
    return starts_of(fires, succeeds)


def starts_of(fires, succeeds=None):
    n = len(fires)
    if succeeds is None:
        succeeds = np.zeros((n, NEVER + 1), bool)
        succeeds[:, 5] = True
    return Starts(np.array(fires, np.uint8), succeeds, np.zeros(n), np.zeros(n))


NO_LOSS, NO_OVERLAP = np.zeros((0, 8), bool), np.zeros((8, 8), bool)


def choose(starts, k, existing=(), overlap=NO_OVERLAP, losses=NO_LOSS):
    """The best set, where there is room for taxels of which no two overlap."""
    m = starts.fires.shape[1]
    overlap = (overlap[:m, :m]) | np.eye(m, dtype=bool)
    return cover.choose(
        starts, k, existing, lambda taxels: ~overlap[list(taxels)].any(axis=0), losses[:, :m]
    )


def best_of(starts, k, existing=(), overlap=NO_OVERLAP, losses=NO_LOSS):
    """The best score of any set."""
    free = [i for i in range(starts.fires.shape[1]) if i not in existing]
    sets = [[*existing, *x] for x in itertools.combinations(free, k - len(existing))]
    return max(cover.score(starts, x, losses) for x in sets if not overlap[np.ix_(x, x)].any())


class TestCover:
    def test_no_other_set_is_better(self):
        """Whatever fires early, taxels that the hand has already included, after losses of any one
        taxel or of any of three groups, which may share taxels, and where some overlap."""
        for seed in range(60):
            rng = np.random.default_rng(seed)
            starts, existing = some(rng), [5] if seed % 2 else []
            starts.fires[:, 5] = np.where(rng.random(12) < 0.3, 3, starts.fires[:, 5])
            losses = [NO_LOSS, np.eye(8, dtype=bool), rng.random((3, 8)) < 0.4][seed % 3]
            pairs = np.triu(rng.random((8, 8)) < 0.1 * (seed % 4 == 0), 1)
            given = existing, pairs | pairs.T, losses
            taxels = choose(starts, 3, *given)
            assert cover.score(starts, taxels, losses) == best_of(starts, 3, *given)
            assert {*existing} <= {*taxels}
            assert not given[1][np.ix_(taxels, taxels)].any()

    def test_the_worst_loss_and_what_fires_too_early(self):
        starts = starts_of([[5, 5], [NEVER, 5], [5, NEVER], [NEVER, 5]])
        assert cover.worst_loss(starts, [0, 1], np.eye(2, dtype=bool)) == (2, 1)
        assert cover.worst_loss(starts, [0, 1], np.ones((1, 2), bool)) == (0, 0)
        assert cover.worst_loss(starts, [0, 1], np.zeros((1, 2), bool)) == (4, None)
        starts = starts_of([[5, 4]])
        assert cover.value(starts, [0]) == 1.0
        assert cover.value(starts, [0, 1]) == cover.value(starts, choose(starts, 2)) == 0.0

    def test_room(self):
        """For two at the ends of a row of three, whose middle one is the best; and for one only."""
        starts = starts_of([[5, 5, NEVER]] * 2 + [[NEVER, 5, 5]] * 2 + [[5, NEVER, 5]])
        row = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], bool)
        assert choose(starts, 2, overlap=row) == [0, 2]
        assert len(choose(starts, 3, overlap=np.ones((8, 8), bool))) == 1


class TestPrices:
    """Two groups of four taxels that share no board; two taxels a board."""

    PRICES = Prices(Cost(1.0, 10.0, 2), np.repeat([0, 1], 4))

    def test_boards_of_a_group_what_fits_on_them_and_what_money_buys(self):
        assert [self.PRICES.of(taxels) for taxels in ([], [0], [0, 1], [0, 4], [0, 1, 2])] == [
            0, 11, 12, 22, 23,
        ]  # fmt: skip
        assert np.flatnonzero(self.PRICES.fits([0], 1)).tolist() == [0, 1, 2, 3]
        assert self.PRICES.fits([0, 1], 2).all()
        assert not self.PRICES.fits([0, 1], 1).any()
        assert Prices(Cost(1.0, 10.0), np.zeros(8, int)).of(range(8)) == 18
        assert self.PRICES.sizes(range(8), range(1, 4), 23) == [(1, 1), (2, 1), (2, 2), (3, 2)]
        assert Prices(Cost(2.0), np.zeros(8, int)).sizes([0, 1], range(1, 9), 5) == [(1, 1), (2, 1)]
        with pytest.raises(ValueError, match="budget: found 10, allowed 11 or more, the price of 1 of"):
            self.PRICES.sizes(range(8), range(1, 4), 10)

    @pytest.mark.parametrize("budget", [11, 12, 22, 24, 36])
    def test_no_other_set_within_the_budget_is_better(self, budget):
        for seed in range(5):
            starts = some(np.random.default_rng(seed))
            flags = DesignFlags(budget=budget, taxels="1..4")
            pool = dataclasses.replace(a_pool(), prices=self.PRICES, flags=flags)
            picks = choice._picks({None: starts}, pool)
            sets = [x for n in range(1, 5) for x in itertools.combinations(range(8), n)]
            for pick in picks:
                assert pick.key == pick.price == self.PRICES.of(pick.taxels) <= budget
                best = max(cover.value(starts, x) for x in sets if self.PRICES.of(x) <= pick.price)
                assert pick.success == pytest.approx(best)
            bought = [(pick.price, pick.success) for pick in picks]
            assert bought == sorted(set(bought))

    def test_of_two_ways_to_wait_that_with_room_for_all(self):
        """In the other, a search stops at a place that fires more often, where no second one fits."""
        share = np.array([[0.9] * 4 + [0.1, 0.2, 0, 0], [0] * 4 + [0.3, 0.5, 0, 0]])
        first = np.arange(20)[:, None] < 20 * share[:, None]
        waits = {wait: starts_of(np.where(fires, 5, NEVER)) for wait, fires in enumerate(first)}
        overlap = np.zeros((8, 8), bool)
        overlap[:4] = overlap[:, :4] = True
        flags = DesignFlags(taxels="2")
        pool = dataclasses.replace(a_pool(), overlap=overlap, flags=flags)
        (pick,) = choice._picks(waits, pool)
        assert pick.taxels == [4, 5]
        with pytest.raises(ValueError, match="taxels: found 2, allowed up to 1; no room was found"):
            choice._picks({0: waits[0]}, pool)

    def test_the_knee(self):
        assert choice.knee([0, 10, 20, 30, 40], [0.1, 0.3, 0.8, 0.85, 0.9]) == 2
        assert choice.knee([0, 10, 20], [0.5, 0.4, 0.3]) == 0


@cache
def a_pool():
    """A pool of eight candidates that nothing else is known of."""
    pool = Pool.of(DesignFlags(scene=("handover",), taxels="1", skin="20mm", beside=()))
    return dataclasses.replace(pool, free=np.ones(8, bool))


class TestSizes:
    """Sensors of a radius of their own."""

    def test_random_sets_do_not_overlap(self):
        pool = Pool.of(DesignFlags(scene=("handover",), radius=10.0, skin="6mm"))
        for seed in range(5):
            drawn = choice.drawn(8, pool, 0, np.random.default_rng(seed))
            assert len(set(drawn)) == 8
            assert pool.overlap[np.ix_(drawn, drawn)].sum() == 8  # each with itself

    @pytest.mark.parametrize("name", ["mpl", "shadow"])
    def test_sensors_keep_their_distance(self, name):
        """From one segment to the next, too."""
        hand = hands.get(name)
        taxels = fitted(candidates(DesignFlags(), hand), radius=3e-3)
        overlapping = overlap(hand, taxels)
        a, b = np.argwhere(~overlapping & (taxels.surfaces[:, None] == taxels.surfaces)).T
        apart = np.linalg.norm(taxels.positions[a] - taxels.positions[b], axis=1)
        assert 5.99e-3 <= apart.min() < 8e-3
        is_next = taxels.link_index[:, None] != taxels.link_index
        assert (overlapping & is_next).any()

    def test_a_margin_to_the_edge(self):
        hand = hands.get("mpl")
        taxels = candidates(DesignFlags(margin=4.0), hand)
        for index, (row, column, _) in zip(taxels.surfaces, taxels.offsets, strict=True):
            low, high, half_width = hand.surfaces[index].span
            assert abs(column) <= half_width - 4e-3
            assert row >= low + 4e-3
            assert row <= high + half_width - 4e-3

    def test_nothing_is_chosen_in_the_place_of_a_taxel_that_is_there(self, tmp_path):
        file = tmp_path / "there.toml"
        file.write_text('[[patch]]\ndigits = ["index"]\nsegments = ["distal"]\noffsets_mm = [[0, 0]]\n'
                        "radius_mm = 3\n")  # fmt: skip
        pool = Pool.of(DesignFlags(scene=("handover",), keep=str(file)))
        there, *free = pool.skin.take(pool.whole).points
        assert pool.existing == [0]
        assert there.radius == pytest.approx(3e-3)
        assert there[:2] not in [point[:2] for point in free]
        layout = layouts.of_taxels(pool.skin.take(pool.whole), pool.hand, "all")
        assert len(layouts.load(layout.toml()).place(pool.hand)) == len(pool.whole)

    def test_taxels_of_one_name_in_two_places_are_two(self, tmp_path):
        """As the taxels of two CSV files are that say no names."""
        link, files = hands.get("mpl").surfaces[0].link, (tmp_path / "a.csv", tmp_path / "b.csv")
        for file, x in zip(files, (0.001, 0.009), strict=True):
            file.write_text(f"link,x,y,z\n{link},{x},0,0\n{link},{x + 0.004},0,0\n")
        keep, skin = map(str, files)
        pool = Pool.of(DesignFlags(scene=("handover",), keep=keep, skin=skin, taxels="1"))
        assert len({*pool.skin.take(pool.whole).names}) == len(pool.whole) == 4
        assert (pool.losses.members[:, :4].sum(axis=1) <= 1).all()
        layout = layouts.of_taxels(pool.skin.take(pool.whole), pool.hand, "all")
        assert len(layouts.load(layout.toml()).place(pool.hand)) == 4


class TestLosses:
    def test_digits_segments_and_groups(self, tmp_path):
        hand = hands.get("mpl")
        taxels = candidates(DesignFlags(skin="8mm"), hand)
        on = [(s.digit, s.segment) for s in (hand.surfaces[i] for i in taxels.surfaces)]
        digits, segments = (groups_of(kind, hand, taxels, "") for kind in ("digit", "segment"))
        assert {*digits.names} == {*hand.digits, "palm"}
        assert (digits.members.sum(axis=0) == 1).all()
        index = digits.members[digits.names.index("index")]
        assert [at[0] == "index" and at[1] != "palm" for at in on] == index.tolist()
        assert {"index.distal", "palm"} < {*segments.names}
        file = tmp_path / "boards.toml"
        file.write_text('[[group]]\nname = "a"\ndigits = ["index"]\n[[group]]\nname = "b"\n'
                        f'segments = ["palm"]\ntaxels = ["{taxels.names[0]}"]\n')  # fmt: skip
        names, members = groups_of(str(file), hand, taxels, "survives")
        assert names == ("a", "b")
        assert members[0].tolist() == index.tolist()
        assert members[1].sum() == sum(at[1] == "palm" for at in on) + 1
        file.write_text('[[group]]\nname = "a"\ndigits = ["toe"]\n')
        with pytest.raises(ValueError, match="toe: unknown"):
            groups_of(str(file), hand, taxels, "survives")
        file.write_text('[[group]]\nname = "a"\n')
        with pytest.raises(ValueError, match="group 'a': found no taxel, digit or segment"):
            groups_of(str(file), hand, taxels, "survives")


class TestPrediction:
    """What is predicted from a recording is what a hand plays."""

    @pytest.mark.parametrize("choices", [{"taxel_delay": 2}, {"taxel_threshold": 0.1}])
    def test_success_of_a_set(self, choices, tmp_path):
        scene = scenes.load("handover")
        config = setup("mpl", **{**scene.on("mpl"), **choices})
        taxels = layouts.load("5").place(hands.get("mpl"))
        taxels = fitted(taxels, threshold_N=config.taxel_threshold)
        starts = record("mpl", [config], taxels, range(6), 1)
        expected = cover.successes(starts, range(len(taxels)))
        env = GraspEnv("mpl", dataclasses.replace(config, layout="5"))
        played = [Reflex("touch", 1, 1.0).play(env, number) for number in range(6)]
        assert played == expected.tolist()
        assert sum(played) > 0


class TestCandidates:
    def test_only_some_digits_and_segments(self):
        hand = hands.get("mpl")

        def where(**choices):
            taxels = candidates(DesignFlags(**choices), hand)
            return {(hand.surfaces[i].digit, hand.surfaces[i].segment) for i in taxels.surfaces}

        assert where(only=("index.distal",)) == {("index", "distal")}
        segments = {("index", name) for name in ("proximal", "middle", "distal")}
        assert where(only=("index",)) == segments
        assert where(only=("index", "index.palm")) == segments | {("index", "palm")}
        assert {segment for _, segment in where(only=("palm", "middle"))} == {"palm", "middle"}

    def test_what_a_flag_says_counts_then_the_sensors_file_then_the_scene(self, tmp_path):
        file = tmp_path / "pad.toml"
        file.write_text("[sensor]\nradius_mm = 3\nthreshold_N = 0.2\ndelay_ms = 200\n")
        scene = tmp_path / "late.toml"
        scene.write_text('base = "handover"\n[scene]\ntaxel_threshold = 0.5\ntaxel_delay = 3\n')

        def numbers(**choices):
            pool = Pool.of(DesignFlags(scene=(str(scene),), skin="20mm", beside=(), **choices))
            return pool.first.taxel_radius, pool.first.taxel_threshold, pool.first.taxel_delay

        assert numbers(radius=4.0) == (0.004, 0.5, 3)
        assert numbers(sensor=str(file)) == (0.003, 0.2, 2)
        assert numbers(sensor=str(file), taxel_threshold=0.0, radius=2.0) == (0.002, 0.0, 2)
        pool = Pool.of(DesignFlags(scene=("handover",), sensor=str(file), skin="6"))
        own = pool.skin.take(pool.whole)
        assert (len(own), {*own.radii}, {*own.thresholds}) == (19, {3e-3}, {0.2})

    def test_taxels_that_fire_before_anything_comes_are_left_out(self):
        pool = a_pool()
        early = np.zeros(len(pool.skin), bool)
        early[2] = True
        left = pool.without(early)
        assert left.whole == [0, 1, 3, 4, 5, 6, 7]
        assert left.early == (pool.skin.names[2],)
        assert not left.fits(0, [])[2]


HANDS = ["mpl", *(pytest.param(hand, marks=pytest.mark.slow) for hand in ("shadow", "allegro"))]


@pytest.mark.parametrize("hand", HANDS)
class TestSkin:
    def test_a_layout_written_from_its_places_is_the_same_layout(self, hand, tmp_path):
        hand = hands.get(hand)
        for name in ("1", "6", "4mm"):
            placed = skin(name, hand)
            spots = hand_map.places(placed)
            file = tmp_path / "layout.toml"
            file.write_text(layouts.of_taxels(placed, hand, 'a "name"').toml())
            again = layouts.load(str(file)).place(hand)
            assert sorted(hand_map.places(again)) == sorted(spots)
            assert len(set(spots)) == len(placed)
            order = [hand_map.places(again).index(spot) for spot in spots]
            assert np.allclose(again.positions[order], placed.positions, atol=2e-7)

    def test_the_skin_reaches_as_far_as_the_papers_layouts(self, hand):
        """Over the round fingertips too: no taxel of layout 1 is far out beyond the skin."""
        built = hands.get(hand)
        places = hand_map.places(skin("2mm", built))
        for place in hand_map.places(layouts.load("1").place(built)):
            beside = [other for other in places if other.surface == place.surface]
            assert min(np.hypot(o.row - place.row, o.column - place.column) for o in beside) < 2.5


def judge_of(choice_starts, test_starts, losses, **changes):
    """A judge of starts with these losses, bool (g, m), in a pool with some fields of its own."""
    names = tuple(map(str, range(len(losses))))
    pool = dataclasses.replace(a_pool(), losses=Groups(names, losses), **changes)
    return choice.Judge(pool, {0.2: choice_starts}, {0.2: test_starts})


def test_every_set_waits_as_suits_it_best():
    """In the starts that it is chosen from; in others it may be better off with another wait."""
    felt, unfelt = starts_of([[5]] * 4), starts_of([[NEVER]] * 4)
    judge = choice.Judge(a_pool(), {0.2: unfelt, 0.35: felt}, {0.2: felt, 0.35: unfelt})
    row = judge.row("chosen", [0])
    assert (row.start_closing, row.success) == (0.35, 0.0)


@pytest.mark.slow
def test_success_after_the_worst_loss_has_no_bias_and_its_interval_holds():
    """Losses that cost alike: each start is felt by one of six taxels at most, so a loss costs 1/6."""
    rng, n, losses = np.random.default_rng(0), 100, np.eye(6, dtype=bool)

    def drawn():
        return starts_of(np.where(losses[rng.integers(6, size=n)], 5, NEVER))

    rows = [judge_of(drawn(), drawn(), losses).row("", range(6)) for _ in range(300)]
    assert np.mean([row.worst for row in rows]) == pytest.approx(5 / 6, abs=0.006)
    covered = [row.worst_interval[0] <= 5 / 6 <= row.worst_interval[1] for row in rows]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize(("n", "few"), [(4, "Few starts were judged (4): they cannot tell"), (40, "")])
def test_a_set_that_was_chosen_by_chance_loses_in_other_starts(n, few):
    first, second = starts_of([[5, NEVER]] * 4), starts_of([[NEVER, 5]] * 4)
    flags = DesignFlags(scene=("handover",), taxels="1", survives="digit", test_starts=n)
    changes = {"flags": flags, "free": np.ones(2, bool), "references": {"2": [1]}}
    judge = judge_of(first, second, np.zeros((1, 2), bool), **changes)
    design = choice.judged(judge, 0.5, "timed", 0.2)
    assert design.chosen == {1: [0]}
    rows = {row.layout: row for row in design.rows}
    assert [rows[name].success for name in ("no touch", "2", "chosen")] == [0.5, 1.0, 0.0]
    said = " ".join(design.sentences())
    assert said.startswith(
        "Touch does not pay: with 1 taxel chosen the hand succeeds in 0.00 of the starts, the best one "
        "without touch (timed, as the gate finds it) in 0.50."
    )
    assert few in said
    assert ("Few" in said) == bool(few)


@pytest.mark.usefixtures("in_tmp", "few_reflexes")
class TestCommand:
    @pytest.mark.slow
    def test_writes_layouts_figures_and_the_same_bytes_again(self, capsys):
        args = ["design", "--scene", "handover", "--taxels", "1..2", *FEW]
        for out in ("a", "b"):
            assert main([*args, "--out", out]) == 0
        said = capsys.readouterr().out
        assert "taxels for a hand that closes at the first touch" in said
        names = {path.name for path in Path("a").iterdir()}
        assert names == {"design.json", "design.html", "design_1.toml", "design_2.toml"}
        for name in names:
            assert Path("a", name).read_bytes() == Path("b", name).read_bytes(), name
        result = json.loads(Path("a/design.json").read_text())
        rows = {(row["layout"], row["taxels"]): row for row in result["rows"]}
        assert rows["whole skin", result["candidates"]]["success"] == 1.0
        assert rows["chosen", 2]["success"] >= 0.5 > rows["random", 2]["success"]
        assert result["verdict"] in " ".join(said.split())
        assert "Few starts were judged (3)" in result["verdict"]
        assert max(map(len, said.partition("Touch")[0].splitlines())) <= 80
        assert "worst loss" not in said

    def test_from_python(self):
        few = dict(starts=1, test_starts=2, skin="20mm", beside=(), workers=1)
        layout = tactilerl.design(scene="handover", taxels=2, **few)
        assert len(tactilerl.make(scene="handover", layout=layout).unwrapped.taxels) == 2

    @pytest.mark.parametrize(
        ("args", "named"),
        [
            (["--scene"], "scene: found none"),
            (["--scene", "all.toml", "--start-closing", "0.3"], "start_closing: found 0.3, allowed"),
            (["--taxels", "3..2"], "taxels: found '3..2'"),
            (["--taxels", "99", "--skin", "5"], "taxels: found 99, allowed up to the 19 that may be"),
            (["--only", "toe"], "toe: unknown"),
            (["--only", "index", "--margin", "50"], "skin: found no place of 4mm"),
            (["--skin", "xmm"], "skin: found 'xmm'"),
            (["--keep", "gone.toml"], "gone.toml"),
            (["--scene", "faulty.toml"], "found faulty.toml, where touch is off or taxels"),
            (["--survives", "toe"], "survives: found 'toe', allowed taxel, digit, segment"),
            (["--scene", "handover", "dark_mpl"], "`tactilerl gate --scene dark_mpl` says what touch"),
            (["--env", "foot"], "unknown hand 'foot'; allowed: shadow"),
            (["--out", "x.png"], "found 'x.png' as a new file, allowed *.toml"),
            (["--out", "mine.toml"], "it is there already"),
            (["--out", "gone/x.toml"], "found no folder 'gone'"),
            (["--sensor", "gone"], "sensor: found 'gone'"),
            (["--budget", "100"], "budget: found 100.0, allowed with a --sensor that has a [cost]"),
            (["--budget", "0", "--sensor", "fsr"], "budget: found 0.0, allowed (0, inf)"),
            (["--budget", "13", "--sensor", "fsr"], "budget: found 13, allowed 13.9 or more, the"),
            (["--boards", "digit"], "boards: found digit, allowed with a --sensor that has a [cost]"),
            (["--boards", "two.toml", "--sensor", "fsr"], "in 0 of the groups of two.toml"),
            (["--skin", "zhang", "--taxels", "99..100", "--budget", "9999", "--sensor", "fsr"],
             "taxels: found 99, allowed up to the"),
            (["--skin", "5", "--keep", "5"], "skin: found no place that may still be chosen"),
        ],
    )  # fmt: skip
    def test_what_cannot_be_is_one_line(self, args, named, capsys):
        mine = 'description = "My own."\n[[patch]]\noffsets_mm = [[0, 0]]\nradius_mm = 2\n'
        Path("mine.toml").write_text(mine)
        Path("two.toml").write_text('[[group]]\nname = "a"\ndigits = ["index"]\n')
        Path("all.toml").write_text('base = "handover"\n[scene]\nactions = "all"\n')
        Path("faulty.toml").write_text('base = "handover"\n[scene]\ntaxel_dead = 0.1\n')
        fails_with(capsys, ["design", "--test-starts", "2", "--workers", "1", *args], named)
        assert Path("mine.toml").read_text() == mine
        names = {"mine.toml", "all.toml", "faulty.toml", "two.toml"}
        assert {path.name for path in Path().iterdir()} == names

    @pytest.mark.slow
    def test_a_budget(self, capsys):
        """The best set that money buys, and where touch does not pay."""
        pad = "[sensor]\nradius_mm = 4\n[cost]\neach = 6.0\nboard = 10.0\nchannels = 2\n"
        Path("pad.toml").write_text(pad)
        Path("hard.toml").write_text("[sensor]\nthreshold_N = 99.0\n[cost]\neach = 20.0\n")
        args = ["design", "--scene", "handover", *FEW, "--boards", "segment", "--budget", "40"]
        said = " ".join(printed(capsys, [*args, "--sensor", "hard.toml"]).split())
        assert "Touch does not pay with hard at 99 N: with 1 taxel for 20 chosen" in said
        assert main([*args, "--sensor", "pad.toml", "--out", "best"]) == 0
        found = json.loads(Path("best/design.json").read_text())
        assert found["asking"]["sensor"] == "pad.toml"
        chosen = [row for row in found["rows"] if row["layout"] == "chosen"]
        assert chosen[0]["price"] == 16
        best = layouts.load(f"best/design_{chosen[-1]['price']:g}.toml").place(hands.get("mpl"))
        assert {*best.radii} == {4e-3}
