"""Reports of studies: right numbers, the same bytes for the same records, seen in a browser."""

import dataclasses
import gzip
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from tactilerl import study as package
from tactilerl.commands.cli import main
from tactilerl.study import analysis, figures, records, report
from tactilerl.study.grid import Contrast
from tactilerl.study.records import StudyFiles

from browser import Browser, needs_chromium
from one_line import fails_with, printed
from study_records import PAPER_LIKE, fail, interrupt, make_study

ROOT = Path(__file__).parents[2]
LOADED = """new Promise((go) => {
    const isThere = () => document.readyState === "complete" && document.title;
    const wait = () => isThere() ? go() : setTimeout(wait, 50);
    wait();
})"""


@pytest.fixture(autouse=True, scope="module")
def _few_resamples():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "N_RESAMPLES", 500)
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


def parts(result, kind):
    return [p for *_, parts in report.sections(result) for p in parts if isinstance(p, kind)]


def rows(result, name):
    return next(t for t in parts(result, report.Table) if t.name == name).rows


def by_seed(group, score):
    return {seed: reached[score] for seed, reached in group.reached.items()}


class TestNumbers:
    @pytest.mark.slow
    def test_tests_at_the_end_of_runs_are_a_score(self, tmp_path, result):
        assert rows(result, "pybullet_measures")[0]["Tested success"].startswith("–")
        folder = make_study(tmp_path / "s", 'score = "test"\n' + PAPER_LIKE, n_seeds=2)
        runs = [run for run in folder.study().runs() if run.setup == "pybullet"]
        for run in runs[1:]:  # the first was made without
            table = folder.run_dir(run).table
            header, *lines = table.read_text().splitlines()
            lines = [f"{line}," for line in lines[:-1]] + [f"{lines[-1]},0.{4 + (run.group == 'on')}"]
            table.write_text("\n".join([f"{header},final_test_success_rate", *lines, ""]))
        tested = analysis.analyse(*records.load(folder.path))
        cells = [row["Tested success"] for row in rows(tested, "pybullet_measures")]
        assert cells[1:3] == ["0.40 [0.40, 0.40]", "0.50 [0.50, 0.50]"]
        assert cells[0].startswith("–")
        assert rows(tested, "pybullet_comparisons")[0]["Pairs"] == "1 of 2"
        assert rows(tested, "pybullet_comparisons")[1]["Tested success"].startswith("0.100")
        assert [row["Tested success"] for row in rows(tested, "runs")[:2]] == ["–", "0.40"]

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
        runs = folder.study().runs()
        for run in runs:
            file = StudyFiles(copy).run_dir(run).config_file
            data = json.loads(file.read_text())
            data["run"]["out"] = str(file.parent)
            file.write_text(json.dumps(data))
        fail(StudyFiles(copy), runs[0], "checkpoint.pt: damaged")
        path = tmp_path / "c.tar.gz"
        records.collect(copy, path)
        assert "secret" not in gzip.decompress(path.read_bytes()).decode()
        assert records.load(path) == records.load(copy)
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
        out = reported(capsys, folder.path)
        assert "Of 24 runs 1 failed, 2 interrupted" in out
        assert "pybullet: versions or commits differ" in out
        rows = (folder.path / "report/tables/runs.csv").read_text().splitlines()
        assert rows[1].startswith(f"{runs[0].name},failed,")
        assert rows[1].endswith("diverged: a reward is nan")
        assert "interrupted" in rows[2]
        assert f"runs/{runs[4].name}: damaged" in rows[5]

    def test_a_row_that_was_cut_off_is_left_out(self, tmp_path):
        folder = make_study(tmp_path / "s", n_seeds=1)
        file = folder.run_dir(folder.study().runs()[0]).table
        file.write_text(file.read_text() + "26,30000,0.5")
        assert [len(record.rows) for record in records.load(folder.path)[1]] == [25] * 12

    def test_what_is_no_number_costs_a_line(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=1)
        run = folder.study().runs()[0]
        table = folder.run_dir(run).table
        *rest, last = table.read_text().splitlines(keepends=True)
        table.write_text("".join([*rest, last.replace("0.", "zero.")]))
        reported(capsys, folder.path)
        row = (folder.path / "report/tables/runs.csv").read_text().splitlines()[1]
        assert f"runs/{run.name}: damaged (could not convert" in row

    def test_a_measure_that_no_run_has(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=1)
        for file in folder.path.rglob("progress.csv"):
            file.write_text(file.read_text().replace("test_success_rate", "another"))
        assert "mujoco: no finished run with a test_success_rate" in reported(capsys, folder.path)

    def test_what_is_no_study(self, folder, tmp_path, capsys):
        fails_with(capsys, ["study", "report", tmp_path], "no study.json")
        fails_with(capsys, ["study", "report", "/dev/null"], "no study.json")
        fails_with(capsys, ["study", "collect", tmp_path / ("x" * 300)], "xxx")
        (tmp_path / "mine").write_text("")
        fails_with(capsys, ["study", "status", tmp_path / "mine"], "mine: not a collected study")
        old = tmp_path / "old.tar.gz"  # of 0.3.0
        old.write_bytes(gzip.compress(b"run,state,reason,record\n"))
        fails_with(capsys, ["study", "status", old], "not a collected study")

    @pytest.mark.parametrize("content", [b"", b"{", b'{"name": 1}'])
    def test_damaged_study_or_collected_file(self, tmp_path, capsys, content):
        (tmp_path / "study.json").write_bytes(content)
        (tmp_path / "c.tar.gz").write_bytes(content)
        for path in (tmp_path, tmp_path / "c.tar.gz"):
            fails_with(capsys, ["study", "report", path], str(path))

    def test_a_missing_extra_is_named(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setitem(sys.modules, "jinja2", None)
        monkeypatch.delitem(sys.modules, "tactilerl.study.report")
        monkeypatch.delattr(package, "report")
        fails_with(capsys, ["study", "report", tmp_path], "pip install 'tactilerl[study]'")


class TestForReaders:
    def test_p_is_corrected_once(self, written):
        table = (written.parent / "tables/pybullet_comparisons.csv").read_text().splitlines()
        assert table[0] == "Setting,Pairs,Mean success,p"

    def test_a_figure_has_one_title_and_the_colour_of_touch_wherever_it_stands(self, written, result):
        text = written.read_text()
        for picture in parts(result, report.Picture):
            assert text.count(f"<figcaption>{picture.title}</figcaption>") == 1
            assert b"Learning curves" not in picture.svg
        setup = result.setups[0].setup
        swapped = dataclasses.replace(
            setup, compare=dataclasses.replace(setup.compare, treatment="off", control="on")
        )
        assert swapped.groups == ["off", "on"]
        assert figures.colours(swapped) == figures.colours(setup)
        polyak = dataclasses.replace(
            setup, compare=Contrast("polyak", "0.9", "0.95"), grid={"polyak": [0.9, 0.95]}
        )
        assert not {*figures.colours(polyak).values()} & {*figures.colours(setup).values()}

    @needs_chromium
    def test_no_word_of_a_report_is_wider_than_a_phone(self, tmp_path):
        folder = make_study(tmp_path / "s", n_seeds=1)
        page = report.write(analysis.analyse(*records.load(folder.path)), tmp_path / "r")
        browser = Browser(page.as_uri(), 320, LOADED)
        try:
            assert browser.run("document.documentElement.scrollWidth") <= 320
        finally:
            browser.close()
