"""Reports of studies: right numbers, the same bytes for the same records, seen in a browser."""

import dataclasses
import gzip
import json
import re
import shutil
import sys

import numpy as np
import pytest
from tactilerl import study as package
from tactilerl.commands.cli import main
from tactilerl.study import analysis, figures, records, report
from tactilerl.study.grid import Contrast, Run, Setup
from tactilerl.study.records import StudyFiles

from browser import Browser, needs_chromium
from one_line import fails_with, printed
from study_records import PAPER_LIKE, fail, interrupt, make_study

LOADED = "document.readyState === 'complete' && document.title"


@pytest.fixture(autouse=True, scope="module")
def _few_resamples():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "N_RESAMPLES", 100)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_study(tmp_path_factory.mktemp("study") / "made-up")


@pytest.fixture(scope="module")
def result(folder):
    return analysis.analyse(*records.load(folder.path))


@pytest.fixture(scope="module")
def written(folder, result):
    return report.write(result, folder.path / "report")


def contents(path):
    return {p.relative_to(path): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def reported(capsys, path):
    return printed(capsys, ["study", "report", path, "--overwrite"])


def by_seed(group, score):
    return {seed: reached[score] for seed, reached in group.reached.items()}


class TestNumbers:
    def test_tests_at_the_end_of_runs_are_a_score(self, tmp_path):
        folder = make_study(tmp_path / "s", 'score = "test"\n' + PAPER_LIKE, n_seeds=2)
        study, runs = records.load(folder.path)
        one = analysis.analyse(study, runs).setups[0]
        on, off = (by_seed(one.groups["layout 1", touch], "test") for touch in ("on", "off"))
        assert on[0] == float(runs[0].rows[-1]["final_test_success_rate"])
        gap = np.mean([on[seed] - off[seed] for seed in (0, 1)])
        assert one.pairs["layout 1"].difference.value == pytest.approx(gap)

    def test_runs_of_the_same_seed_are_compared_by_their_areas(self, result):
        one = result.setups[0]
        arms = [by_seed(one.groups["layout 2", arm], "area") for arm in ("on", "off")]
        gaps = np.array([arms[0][seed] - arms[1][seed] for seed in (0, 1, 2, 3)])
        found = one.pairs["layout 2"]
        assert found.seeds == [0, 1, 2, 3]
        assert found.difference.value == pytest.approx(gaps.mean())
        assert found.difference.low < gaps.mean() < found.difference.high
        assert found.p_value == pytest.approx(0.125)  # four signs alike: 2 of 16 ways
        assert found.p_holm >= found.p_value

    def test_a_pair_counts_only_where_both_runs_are_done(self, tmp_path):
        folder = make_study(tmp_path / "s", n_seeds=3)
        lost = next(r for r in folder.study().runs() if (r.group, r.seed) == ("off", 1))
        fail(folder, lost)
        result = analysis.analyse(*records.load(folder.path))
        assert result.setups[0].pairs[lost.setting].seeds == [0, 2]
        assert any("2 of 3 pairs" in said for said in report.answers(result))

    def test_one_pair_has_no_interval(self, tmp_path):
        result = analysis.analyse(*records.load(make_study(tmp_path / "s", n_seeds=1).path))
        said = report.answers(result)[0]
        assert said.endswith("too few runs to find a difference, which takes 7 pairs (1 of 1 pairs).")


class TestFiles:
    def test_the_collected_file_is_as_good_as_the_folders(self, folder, written, tmp_path, capsys):
        path = tmp_path / "one.tar.gz"
        assert main(["study", "collect", str(folder.path), "--out", str(path)]) == 0
        first = path.read_bytes()
        records.collect(folder.path, path)
        assert path.read_bytes() == first
        said = printed(capsys, ["study", "report", path, "--out", tmp_path / "from_file"])
        assert "smallest group has 4 runs" in said
        assert "pybullet, layout 1: too few runs to find a difference" in said
        assert contents(tmp_path / "from_file") == contents(written.parent)

    def test_no_network_and_no_double_ids(self, written):
        text = written.read_text()
        assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", text.replace("xmlns", ""))
        ids = re.findall(r'\bid="([^"]+)"', text)
        assert len(ids) == len(set(ids))

    def test_nobody_learns_from_a_collected_study_where_it_was_made(self, folder, tmp_path):
        copy = tmp_path / "secret"
        shutil.copytree(folder.path, copy)
        run = folder.study().runs()[0]
        file = StudyFiles(copy).run_dir(run).config_file
        data = json.loads(file.read_text())
        data["run"]["out"] = str(file.parent)
        file.write_text(json.dumps(data))
        fail(StudyFiles(copy), run, "checkpoint.pt: damaged")
        path = tmp_path / "c.tar.gz"
        records.collect(copy, path)
        assert "secret" not in gzip.decompress(path.read_bytes()).decode()
        assert repr(records.load(path)) == repr(records.load(copy))  # rows have nan
        assert records.load(path)[1][0].reason == "checkpoint.pt: damaged"


class TestWarnings:
    def test_failed_unfinished_and_mixed_versions_are_said(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=2)
        runs = folder.study().runs()
        fail(folder, runs[0], "diverged: a reward is nan")
        interrupt(folder, runs[1])
        config = folder.run_dir(runs[2]).config_file
        config.write_text(config.read_text().replace('"torch": "', '"torch": "0.'))
        folder.run_dir(runs[4]).config_file.write_text("{")
        table = folder.run_dir(runs[5]).table
        table.write_text(table.read_text().replace("0.", "zero."))
        out = reported(capsys, folder.path)
        assert "Of 24 runs, 1 failed, 3 interrupted" in out
        assert "pybullet: versions or commits differ" in out
        rows = (folder.path / "report/tables/runs.csv").read_text().splitlines()
        assert rows[1].startswith(f"{runs[0].name},failed,")
        assert rows[1].endswith("diverged: a reward is nan")
        assert "interrupted" in rows[2]
        assert f"runs/{runs[4].name}: damaged" in rows[5]
        assert f"runs/{runs[5].name}: damaged (could not convert" in rows[6]

    def test_a_measure_that_no_run_has(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=1)
        for file in folder.path.rglob("progress.csv"):
            file.write_text(file.read_text().replace("test_success_rate", "another"))
        assert "mujoco: no finished run with a test_success_rate" in reported(capsys, folder.path)

    def test_what_is_no_study(self, folder, tmp_path, capsys):
        fails_with(capsys, ["study", "report", tmp_path], "no study.json")
        (tmp_path / "mine").write_text("")
        fails_with(capsys, ["study", "status", tmp_path / "mine"], "mine: not a collected study")
        (tmp_path / "study.json").write_text("{")
        fails_with(capsys, ["study", "report", tmp_path], str(tmp_path))

    def test_a_missing_extra_is_named(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setitem(sys.modules, "jinja2", None)
        monkeypatch.delitem(sys.modules, "tactilerl.study.report")
        monkeypatch.delattr(package, "report")
        fails_with(capsys, ["study", "report", tmp_path], "pip install 'tactilerl[study]'")


class TestForReaders:
    def test_a_group_has_the_colour_of_its_touch_wherever_it_stands(self, result):
        setup = result.setups[0].setup
        swapped = dataclasses.replace(setup, compare=Contrast("touch", "off", "on"))
        assert swapped.groups == ["off", "on"]
        assert figures.colours(swapped) == figures.colours(setup)

    @needs_chromium
    def test_no_word_of_a_report_is_wider_than_a_phone(self, tmp_path):
        folder = make_study(tmp_path / "s", n_seeds=1)
        page = report.write(analysis.analyse(*records.load(folder.path)), tmp_path / "r")
        browser = Browser(page.as_uri(), 320, LOADED)
        try:
            assert browser.run("document.documentElement.scrollWidth") <= 320
        finally:
            browser.close()


class TestAnswers:
    grid, contrast = {"layout": [1, 2], "touch": ["on", "off"]}, Contrast("touch", "on", "off")
    setup = Setup("one", {}, grid, [*range(12)], contrast, "success_rate")

    def said(self, gap, p_holm, n=9, score="area"):
        difference = analysis.Estimate(*gap)
        pairs = analysis.Pairs([*range(n)], np.ones(n), np.zeros(n), difference, p_holm, p_holm)
        return report.answer(self.setup, "layout 2", pairs, score)

    @pytest.mark.parametrize(
        ("gap", "p", "n", "words"),
        [
            ((0.1, 0.02, 0.2), 0.02, 9, "touch raised mean success (touch − no touch: +0.10, 95 %"),
            ((-0.1, -0.2, 0.01), 0.04, 9, "touch lowered mean success (touch − no touch: −0.10, 95 %"),
            ((0.1, -0.02, 0.2), 0.2, 9, "no significant difference in mean success"),
            ((0.1, -0.02, 0.2), 0.2, 6, "too few runs to find a difference, which takes 7 pairs"),
        ],
    )
    def test_each_kind_of_answer(self, gap, p, n, words):
        said = self.said(gap, p, n)
        assert said.startswith(f"one, layout 2: {words}")
        assert said.endswith(f"p = {p:.3f}, {n} of 12 pairs).")

    def test_a_bound_below_zero_keeps_its_sign(self):
        assert "−0.02 to +0.20, p < 0.001" in self.said((0.1, -0.02, 0.2), 1e-4, score="last")


class TestCommonRange:
    """Runs that are compared are scored over the steps that all of them have."""

    def record(self, steps, rates, seed=0):
        run = Run(f"r{seed}", "one", "all", "on", seed, "success_rate", {})
        points = zip(steps, rates, strict=True)
        rows = [dict(zip(("env_steps", "success_rate"), point, strict=True)) for point in points]
        return records.Record(run, "done", "", {}, rows)

    def test_it_begins_and_ends_where_all_have_a_rate(self):
        long = self.record([0, 10, 20, 30, 40], [0, 0, 0.5, 1, 1])
        short = self.record([5, 15, 25], [0.2, 0.4, 0.6])
        assert analysis.span([long, short]) == (5, 25)
        ((area,), (other,)) = (list(x.values()) for x in analysis.scored("area", [long], [short]))
        # From 5 to 25: 0 up to 10, then up to 0.5 at 20, and 0.75 at 25.
        assert area == pytest.approx((0 + 0.25 * 10 + 0.625 * 5) / 20)
        assert other == pytest.approx(0.4)

    def test_what_comes_after_does_not_count(self):
        steps = np.arange(0, 50, 10)
        same = [self.record(steps, [0.1, 0.2, 0.4, 0.6, last], 1) for last in (0.0, 1.0)]
        short = self.record(steps[:4], [0.1, 0.2, 0.4, 0.6], 2)
        for score in ("area", "last", "converged"):
            a, b = (analysis.scored(score, [one], [short]) for one in same)
            assert a[0][1] == b[0][1] == a[1][2]

    def test_runs_without_a_common_step_are_taken_at_their_ends(self):
        one, other = self.record([10], [0.3]), self.record([20], [0.6], 1)
        assert analysis.scored("area", [one], [other]) == [{0: 0.3}, {1: 0.6}]
