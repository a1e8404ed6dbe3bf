"""What a study says of its primary comparisons: looks, what sight leaves to touch, other parts."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from tactilerl.study import looks, records, summary, verdicts
from tactilerl.study.grid import Contrast, Looks, Run, Setup
from tactilerl.study.runner import RunJob
from tactilerl.terminal.console import console

from one_line import fails_with, printed
from study_records import PAPER_LIKE, fail, make_study

LOOKS = PAPER_LIKE[: PAPER_LIKE.index("[setups.mujoco]")].replace(
    'name = "made-up"', 'name = "made-up"\nlooks.pairs = [6, 9, 12]\nlooks.effect = 0.03'
)
SIGHT = """
name = "sight"
measure = "success_rate"
[setups.blind]
algo = "ppo"
env = "shadow"
object_seen = "hidden"
total_timesteps = 30_000
compare = {touch = ["on", "off"]}
grid = {touch = ["on", "off"], seed = "0-7"}
[setups.sighted]
algo = "ppo"
env = "shadow"
touch = "off"
total_timesteps = 30_000
grid = {seed = "0-8"}
"""


def judged(folder):
    study, found = records.load(folder.path)
    return {
        cell: one for setup in study.setups for cell, one in verdicts.judge(study, setup, found).items()
    }


def leave_out(folder, is_out):
    """Runs that nobody has trained yet."""
    for run in folder.study().runs():
        if is_out(run):
            shutil.rmtree(folder.run_dir(run).path)


class TestTake:
    plan = Looks([6, 9, 12])

    @pytest.mark.parametrize(
        ("gaps", "endings"),
        [
            # With six pairs 1 of 32 ways is more than may be spent by then.
            (0.2 + 0.01 * np.arange(12), ["", "difference"]),
            (0.01 * np.tile([1.0, -1.0], 6), ["no difference"]),
            (0.4 * np.tile([1.0, -1.0], 6), ["", "", "last look"]),
        ],
    )
    def test_it_ends_at_the_first_look_that_can_tell(self, gaps, endings):
        taken = verdicts.take(self.plan, gaps, [6, 9, 12])
        assert [one.ending for one in taken] == endings
        assert taken[-1].n == [6, 9, 12][len(endings) - 1]

    def test_a_corrected_interval_is_wider(self):
        gaps = 0.4 * np.random.default_rng(0).standard_normal(12)
        wide, narrow = (verdicts.take(self.plan, gaps, [6, 9, 12], n)[-1].difference for n in (6, 1))
        assert wide.high - wide.low > narrow.high - narrow.low


class TestStudyWithLooks:
    def test_it_stops_where_the_answer_is_and_leaves_the_rest(self, tmp_path, capsys):
        """Layout 2 is far ahead, layout 5 is not."""
        folder = make_study(tmp_path / "s", LOOKS, n_seeds=12)
        done = tmp_path / "done"
        (folder.path / "runs").rename(done)
        study = folder.study()
        jobs = {run.name: RunJob(folder.path, run) for run in study.runs()}
        batches, said = [], []

        def run_all(batch):
            batches.append(sorted(job.run.name for job in batch))
            for name in batches[-1]:
                shutil.copytree(done / name, folder.path / "runs" / name)
            return {job.run.name: "done" for job in batch}

        endings = looks.run(study, folder.path, jobs, run_all, said.append)
        assert [len(batch) for batch in batches[:2]] == [36, 18]
        assert not [name for name in batches[2] if "layout-2" in name]
        found = judged(folder)
        assert found["layout 2"].stage.ending == "difference"
        assert found["layout 2"].stage.look == 2
        assert len(found["layout 2"].pairs) == 9
        assert found["layout 2"].p_holm == pytest.approx(3 * found["layout 2"].pairs.p_value)
        assert len(endings) == sum(map(len, batches)) < len(jobs)
        told = [one for one in said if "layout 2: Touch raised mean success by 0." in one]
        assert any("Look 2 of 3" in one for one in told)

        assert "nothing left to do" in printed(capsys, ["study", "status", folder.path])
        out = printed(capsys, ["study", "report", folder.path, "--resamples", "100"])
        assert "stopped for a difference" in out
        assert "they are in no figure" not in out  # what was left out is not missing

    def test_a_look_waits_for_its_runs(self, tmp_path):
        folder = make_study(tmp_path / "s", LOOKS, n_seeds=12)
        leave_out(folder, lambda run: run.seed == 7)
        assert all(one.stage.look == 1 for one in judged(folder).values())
        leave_out(folder, lambda run: run.seed == 2)
        found = judged(folder)["layout 2"]
        assert found.stage.look == 0
        assert np.isnan(found.pairs.p_value)
        setup = folder.study().setups[0]
        assert "the first look is still to come" in summary.answer(setup, found, "area")

    def test_a_pair_that_failed_is_missing_and_no_look_is(self, tmp_path):
        folder = make_study(tmp_path / "s", LOOKS, n_seeds=12)
        lost = next(r for r in folder.study().runs() if (r.cell, r.seed) == ("layout 2", 1))
        fail(folder, lost)
        found = judged(folder)["layout 2"]
        assert (found.stage.look, len(found.pairs)) == (2, 8)


class TestHeadroom:
    def test_touch_as_a_share_of_what_sight_gives(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", SIGHT, n_seeds=8)
        study, found = records.load(folder.path)
        room = verdicts.headroom(study, study.setups[0], "all", found, 500)
        blind, sighted = study.setups
        arms = [(sighted, ""), (blind, "on"), (blind, "off")]
        runs = [verdicts.runs_of(found, setup, "all", arm) for setup, arm in arms]
        seen, main_arm, control = verdicts.scored("area", *runs)
        sight = [seen[seed] - control[seed] for seed in range(8)]
        touch = [main_arm[seed] - control[seed] for seed in range(8)]
        assert room.n == 8
        assert room.room.value == pytest.approx(np.mean(sight))
        assert room.share.value == pytest.approx(np.mean(touch) / np.mean(sight))
        assert room.share.low < room.share.value < room.share.high
        words = "touch gives" if room.is_enough else "this scene cannot tell"
        assert words in printed(capsys, ["study", "report", folder.path, "--resamples", "100"])

    def test_a_scene_that_sight_does_not_open_cannot_tell(self):
        little = verdicts.Headroom(8, verdicts.Estimate(0.29, 0.2, 0.4), verdicts.Estimate(0.5, 0, 1))
        much = verdicts.Headroom(8, verdicts.Estimate(0.31, 0.2, 0.4), verdicts.Estimate(0.5, 0, 1))
        assert (little.is_enough, much.is_enough) == (False, True)

    def test_another_difference_than_sight_is_no_sighted_control(self, tmp_path):
        text = SIGHT.replace('touch = "off"\n', 'touch = "off"\ngamma = 0.9\n')
        study, found = records.load(make_study(tmp_path / "s", text, n_seeds=8).path)
        assert verdicts.headroom(study, study.setups[0], "all", found, 500) is None


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_study(tmp_path_factory.mktemp("compare") / "s", n_seeds=4)


class TestCompare:
    def compare(self, capsys, *parts):
        return json.loads(printed(capsys, ["study", "compare", *parts, "--json"]))

    def test_two_cells_of_one_study_in_pairs(self, folder, capsys):
        found = self.compare(capsys, f"{folder.path}:layout 2", f"{folder.path}:layout 5")
        places = ["pybullet touch", "pybullet no touch", "mujoco touch", "mujoco no touch"]
        assert [row["place"] for row in found["rows"]] == places
        assert found["differing"] == ["layout 2 − 5"]
        assert found["rows"][0]["pairs"] == 4
        assert found["rows"][0]["value"] > 0.1
        assert found["rows"][0]["p"] == pytest.approx(0.125)
        assert found["rows"][0]["p_holm"] == pytest.approx(0.5)

    def test_two_studies_with_some_common_seeds(self, folder, tmp_path, capsys):
        other = make_study(tmp_path / "other", PAPER_LIKE.replace('"0-{last}"', '"2-7"'))
        names = "pybullet,layout 2,touch"
        row = self.compare(capsys, f"{folder.path}:{names}", f"{other.path}:{names}")["rows"][0]
        assert (row["runs"], row["pairs"]) == ([4, 6], 2)

    def test_other_rates_of_success_are_a_difference(self, folder, tmp_path, capsys):
        text = PAPER_LIKE.replace('"test_success_rate"', '"success_rate"')
        other = make_study(tmp_path / "other", text, n_seeds=4)
        found = self.compare(capsys, f"{folder.path}:mujoco", f"{other.path}:mujoco")
        assert found["differing"] == ["measure test_success_rate − success_rate"]

    def test_numbers_are_whole_in_a_narrow_terminal(self, folder, capsys, monkeypatch):
        monkeypatch.setattr(console, "width", 80)
        parts = (f"{folder.path}:layout {layout}" for layout in (2, 5))
        shown = printed(capsys, ["study", "compare", *parts])
        assert len(re.findall(r"[+-]0\.\d{3} \([+-]\d\.\d{3} to [+-]\d\.\d{3}\)", shown)) == 4

    def test_without_common_seeds_they_are_no_pairs(self, folder, tmp_path, capsys):
        other = make_study(tmp_path / "other", PAPER_LIKE.replace('"0-{last}"', '"10-14"'))
        fails_with(capsys, ["study", "compare", folder.path, other.path], "no seed that both have")

    def test_one_pair_has_no_p(self, folder, tmp_path, capsys):
        other = make_study(tmp_path / "other", PAPER_LIKE.replace('"0-{last}"', "[3]"))
        names = "pybullet,layout 2,touch"
        row = self.compare(capsys, f"{folder.path}:{names}", f"{other.path}:{names}")["rows"][0]
        assert (row["pairs"], row["p"], row["low"], row["high"]) == (1, None, None, None)

    def test_no_steps_that_all_have(self, folder, tmp_path, capsys):
        other = make_study(tmp_path / "other", n_seeds=4, epochs=1, total=60_000)
        args = ["study", "compare", folder.path, other.path]
        fails_with(capsys, args, "found no steps that all have")

    @pytest.mark.parametrize(
        ("one", "other", "words"),
        [
            ("layout 7", "", ["'layout 7'", "layout 2"]),
            ("pybullet,mujoco", "", ["no finished"]),
            ("pybullet", "layout 2", ["nothing in both"]),
        ],
    )
    def test_no_such_parts(self, folder, capsys, one, other, words):
        args = ["study", "compare", f"{folder.path}:{one}", f"{folder.path}:{other}"]
        fails_with(capsys, args, *words)


class TestErrorsOfLooks:
    arms = Contrast("touch", "on", "off")
    setup = Setup("one", {}, {"touch": ["on", "off"]}, [0], arms, "success_rate")

    def verdict(self, ending, p, p_holm=1.0):
        pairs = verdicts.Pairs(list(range(9)), np.ones(9), np.zeros(9), verdicts.Estimate(0.1, 0, 1), p)
        return verdicts.Verdict("all", pairs, 12, verdicts.Stage(2, 3, ending), p_holm)

    def test_a_small_p_counts_only_where_the_test_stopped(self):
        """Neither while it goes on nor where it stopped for want of a difference."""
        for ending, p in (("", 1.0), ("no difference", 1.0), ("last look", 0.02)):
            assert self.verdict(ending, 0.02).valid_p == p
        assert not self.verdict("", 0.02).is_difference

    def test_at_the_last_look_holm_may_find_what_bonferroni_did_not(self):
        assert self.verdict("last look", 0.02, 0.04).is_difference

    @pytest.mark.parametrize(
        ("gap", "words"),
        [
            ((0.1, 0.02, 0.2), "Touch raised mean success by 0.10 (0.02 to 0.20;"),
            ((0.1, -0.02, 0.2), "Touch raised mean success by 0.10 (−0.02 to 0.20;"),
            ((-0.1, -0.2, 0.01), "Touch lowered mean success by 0.10 (−0.01 to 0.20;"),
        ],
    )
    def test_a_difference_is_told_with_the_signs_of_its_bounds(self, gap, words):
        verdict = self.verdict("last look", 0.02, 0.04)
        pairs = dataclasses.replace(verdict.pairs, difference=verdicts.Estimate(*gap))
        verdict = dataclasses.replace(verdict, pairs=pairs)
        assert words in summary.answer(self.setup, verdict, "area")

    def test_as_many_pairs_are_needed_as_the_corrected_test_takes(self):
        six = verdicts.Pairs([0] * 6, np.ones(6), np.zeros(6), verdicts.Estimate(0.1, 0, 1), 0.03)
        verdict = verdicts.Verdict("a", six, 6, None, 0.06)
        two = dataclasses.replace(self.setup, grid={"layout": [1, 2], **self.setup.grid})
        assert len(two.cells) == 2
        assert "which takes 7 pairs" in summary.answer(two, verdict, "area")
        ruled_out = dataclasses.replace(verdict, stage=verdicts.Stage(1, 3, "no difference"))
        assert "no significant difference" in summary.answer(two, ruled_out, "area")

    @pytest.mark.parametrize(
        ("ending", "words"), [("", "not decided yet"), ("no difference", "no significant difference")]
    )
    def test_a_look_that_decides_nothing_says_so(self, ending, words):
        assert words in summary.answer(self.setup, self.verdict(ending, 0.02), "area")


class TestCommonRange:
    """Runs that are compared are scored over the steps that all of them have."""

    def record(self, steps, rates, seed=0):
        run = Run(f"r{seed}", "one", "all", "on", seed, "success_rate", {})
        points = zip(map(str, steps), map(str, rates), strict=True)
        rows = [dict(zip(("env_steps", "success_rate"), point, strict=True)) for point in points]
        return records.Record(run, "done", "", {}, rows)

    def test_it_begins_and_ends_where_all_have_a_rate(self):
        long = self.record([0, 10, 20, 30, 40], [0, 0, 0.5, 1, 1])
        short = self.record([5, 15, 25], [0.2, 0.4, 0.6])
        assert verdicts.span([long, short]) == (5, 25)
        ((area,), (other,)) = (list(x.values()) for x in verdicts.scored("area", [long], [short]))
        # From 5 to 25: 0 up to 10, then up to 0.5 at 20, and 0.75 at 25.
        assert area == pytest.approx((0 + 0.25 * 10 + 0.625 * 5) / 20)
        assert other == pytest.approx(0.4)

    def test_what_comes_after_does_not_count(self):
        steps = np.arange(0, 50, 10)
        same = [self.record(steps, [0.1, 0.2, 0.4, 0.6, last], 1) for last in (0.0, 1.0)]
        short = self.record(steps[:4], [0.1, 0.2, 0.4, 0.6], 2)
        for score in ("area", "final", "converged", "steps to 0.5"):
            a, b = (verdicts.scored(score, [one], [short]) for one in same)
            assert a[0][1] == b[0][1] == a[1][2]

    def test_runs_without_a_common_step_are_taken_at_their_ends(self):
        one, other = self.record([10], [0.3]), self.record([20], [0.6], 1)
        assert verdicts.scored("area", [one], [other]) == [{0: 0.3}, {1: 0.6}]

    def test_report_and_compare_have_one_rule(self, tmp_path, capsys):
        """Also where one arm's runs are longer."""
        folder = make_study(tmp_path / "s", n_seeds=4)
        for run in folder.study().runs():
            if (run.setup, run.arm, run.seed) == ("pybullet", "on", 2):
                path = folder.run_dir(run).table
                path.write_text(path.read_text() + "26,36000,0.0,0.0,0.0,100.0\n")
        study, found = records.load(folder.path)
        found = verdicts.judge(study, study.setups[0], found)["layout 2"].pairs.difference
        parts = [f"{folder.path}:pybullet,layout 2,{arm}" for arm in ("touch", "no touch")]
        (row,) = json.loads(printed(capsys, ["study", "compare", *parts, "--json"]))["rows"]
        assert [row[name] for name in ("value", "low", "high")] == pytest.approx(list(found))
