"""Reports of studies: right numbers, the same bytes for the same records, seen in a browser."""

import gzip
import html
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pandas
import pytest
from rliable import library, metrics
from tactilerl import study as package
from tactilerl.commands.cli import main
from tactilerl.study import analysis, figures, planning, records, report, summary, tables, verdicts
from tactilerl.study.grid import Looks
from tactilerl.study.records import StudyFiles
from tactilerl.terminal.console import console

from one_line import fails_with, printed
from study_records import fail, interrupt, make_study

ROOT = Path(__file__).parents[2]
RESAMPLES = 500
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
MEASURE = """<script>
addEventListener("load", () => {
  const found = {overflow: document.documentElement.scrollWidth - innerWidth, width: innerWidth};
  found.figures = [...document.querySelectorAll("figure")].map(figure => {
    const drawn = [...figure.querySelectorAll("img, table")].map(one => one.getBoundingClientRect());
    const rows = figure.querySelectorAll("tbody tr").length;
    return [figure.id, Math.min(...drawn.map(box => box.width)), rows];
  });
  console.log("FOUND" + JSON.stringify(found) + "END");
});
</script></body>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_study(tmp_path_factory.mktemp("study") / "made-up")


@pytest.fixture(scope="module")
def result(folder):
    return analysis.analyse(*records.load(folder.path), RESAMPLES)


@pytest.fixture(scope="module")
def written(folder, result):
    return report.write(result, folder.path / "report")


def contents(path):
    return {p.relative_to(path): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def rewrite(path, name, change):
    """Change one file in a collected study."""
    with tarfile.open(path) as archive:
        found = {one.name: archive.extractfile(one).read() for one in archive}
    found[name] = change(found[name].decode()).encode()
    with tarfile.open(path, "w:gz") as archive:
        for each, data in found.items():
            entry = tarfile.TarInfo(each)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))


def reported(capsys, path):
    return printed(capsys, ["study", "report", path, "--resamples", "100"])


def parts(result, kind):
    return [p for section in report.sections(result) for p in section.parts if isinstance(p, kind)]


def rows(result, name):
    return next(t for t in parts(result, tables.Table) if t.name == name).frame.to_numpy().tolist()


def by_seed(group, score):
    return dict(zip(group.seeds, group.scores[score], strict=True))


class TestNumbers:
    def test_runs_of_the_same_seed_are_compared_by_their_areas(self, result):
        one = result.setups[0]
        arms = [by_seed(one.groups["layout 2", arm], "area") for arm in ("on", "off")]
        gaps = np.array([arms[0][seed] - arms[1][seed] for seed in (0, 1, 2, 3)])
        found = one.comparisons["layout 2"].verdict
        assert found.pairs.seeds == [0, 1, 2, 3]
        assert found.pairs.difference.value == pytest.approx(gaps.mean())
        assert found.pairs.difference.low < gaps.mean() < found.pairs.difference.high
        assert found.pairs.p_value == pytest.approx(0.125)  # four signs alike: 2 of 16 ways
        assert found.p_holm >= found.pairs.p_value

    def test_a_pair_counts_only_where_both_runs_are_done(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=3)
        lost = next(r for r in folder.study().runs() if (r.arm, r.seed) == ("off", 1))
        fail(folder, lost)
        found = analysis.analyse(*records.load(folder.path), 100).setups[0].comparisons[lost.cell]
        assert found.verdict.pairs.seeds == [0, 2]
        assert all(len(pairs) == 2 for pairs in found.secondary.values())
        assert "2 of 3 pairs" in reported(capsys, folder.path)

    def test_a_group_is_its_runs(self, folder, result):
        group = result.setups[1].groups["layout 2", "on"]
        _, own = records.load(folder.path)
        place = own, result.setups[1].setup, "layout 2"
        arms = [verdicts.runs_of(*place, arm) for arm in ("on", "off")]
        expected = list(verdicts.scored("converged", *arms)[0].values())
        assert group.seeds == [0, 1, 2, 3]
        np.testing.assert_allclose(group.scores["converged"], expected)
        row = next(r for r in rows(result, "mujoco_measures") if r[:2] == ["layout 2", "touch"])
        assert row[2] == "4"
        assert row[5].startswith(f"{np.mean(expected):.2f} [")

    def test_curves_are_compared_at_steps_that_all_runs_have(self, result):
        one = result.setups[0]
        for record in one.records:
            steps, _ = record.curve
            assert steps[0] <= one.steps[0]
            assert one.steps[-1] <= steps[-1]
        assert all(group.curves.shape == (4, 25) for group in one.groups.values())


class TestFiles:
    def test_same_records_same_bytes(self, folder, written, tmp_path):
        again = analysis.analyse(*records.load(folder.path), RESAMPLES)
        report.write(again, tmp_path / "again")
        assert contents(tmp_path / "again") == contents(written.parent)

    def test_the_collected_file_is_as_good_as_the_folders(self, folder, written, tmp_path, capsys):
        path = tmp_path / "one.tar.gz"
        assert main(["study", "collect", str(folder.path), "--out", str(path)]) == 0
        first = path.read_bytes()
        records.collect(folder.path, out=path)
        assert path.read_bytes() == first
        args = ["--out", tmp_path / "from_file", "--resamples", RESAMPLES]
        assert "smallest group has 4 runs" in printed(capsys, ["study", "report", path, *args])
        assert contents(tmp_path / "from_file") == contents(written.parent)

    def test_every_table_and_figure_in_every_format(self, result, written):
        names = {p.relative_to(written.parent).as_posix() for p in written.parent.rglob("*.*")}
        for one in parts(result, tables.Table):
            assert {f"tables/{one.name}.{ending}" for ending in ("md", "csv", "tex")} <= names
        for one in parts(result, figures.Picture):
            assert {f"figures/{one.name}.{ending}" for ending in ("png", "svg")} <= names

    def test_no_network_and_no_double_ids(self, written):
        text = written.read_text()
        assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", text.replace("xmlns", ""))
        ids = re.findall(r'\bid="([^"]+)"', text)
        assert len(ids) == len(set(ids))

    def test_names_are_text_wherever_they_stand(self, tmp_path):
        name = '"><img src=x onerror=alert(1)>'
        picture = figures.Picture(name, name, name, [(f"{name} $x^$", lambda axes: None)], (2, 2))
        drawn = picture.formats()["svg"].decode()
        assert "<img" not in drawn
        assert "$x^$" in drawn

    def test_nobody_learns_from_a_collected_study_where_it_was_made(self, folder, tmp_path):
        copy = tmp_path / "secret"
        shutil.copytree(folder.path, copy)
        runs = folder.study().runs()
        for run in runs:
            file = StudyFiles(copy).run_dir(run).config_file
            data = json.loads(file.read_text())
            data["run"]["out"] = str(file.parent)
            file.write_text(json.dumps(data))
        place = StudyFiles(copy).run_dir(runs[0]).path
        fail(StudyFiles(copy), runs[0], f"{place}/checkpoint.pt: damaged")
        path = records.collect(copy, out=tmp_path / "c.tar.gz")
        assert "secret" not in gzip.decompress(path.read_bytes()).decode()
        assert records.load(path) == records.load(copy)
        assert f"{runs[0].name}/checkpoint.pt: damaged" == records.load(path)[1][0].reason

    def test_tables_escape_what_latex_reads(self):
        made = tables.Table("x", "x", [{"a_b": "50 %"}]).formats()["tex"].decode()
        assert r"a\_b" in made
        assert r"50 \%" in made


class TestWarnings:
    def test_failed_unfinished_diverged_and_mixed_versions_are_said(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=2)
        runs = folder.study().runs()
        fail(folder, runs[0], "diverged: a reward is nan")
        interrupt(folder, runs[1])
        config = folder.run_dir(runs[2]).config_file
        config.write_text(config.read_text().replace('"torch": "', '"torch": "0.'))
        progress = folder.run_dir(runs[3]).table
        progress.write_text(progress.read_text().replace(",0.0,100.0", ",1.0,100.0"))
        folder.run_dir(runs[4]).config_file.write_text("{")
        out = reported(capsys, folder.path)
        assert "Of 24 runs 1 failed, 2 interrupted" in out
        assert "pybullet: versions or commits differ" in out
        assert "diverged in 1 run" in out
        rows = (folder.path / "report/tables/runs.csv").read_text().splitlines()
        assert rows[1].startswith("pybullet,layout 1,touch,0,failed")
        assert rows[1].endswith("diverged: a reward is nan")
        assert "interrupted" in rows[2]
        assert "config.json: damaged" in rows[5]

    @pytest.mark.parametrize("tail", ["26,30000,0.5", "26,30000,0.5,0.5,0,100,7\n", '"', "\0\n"])
    def test_a_damaged_end_of_a_progress_table_is_left_out(self, tmp_path, tail):
        folder = make_study(tmp_path / "s", n_seeds=1)
        file = folder.run_dir(folder.study().runs()[0]).table
        file.write_text(file.read_text() + tail)
        _, all_records = records.load(folder.path)
        assert [len(record.rows) for record in all_records] == [25] * 12
        assert records.load(records.collect(folder.path))[1] == all_records

    def test_a_measure_that_no_run_has(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=1)
        for file in folder.path.rglob("progress.csv"):
            file.write_text(file.read_text().replace("test_success_rate", "another"))
        assert "mujoco: no finished run with a test_success_rate" in reported(capsys, folder.path)

    def test_runs_that_still_rise_are_said(self, tmp_path, result):
        assert "end well above" not in " ".join(summary.warnings(result))
        folder = make_study(tmp_path / "s", n_seeds=2)
        for file in folder.path.rglob("progress.csv"):
            header, *rows = file.read_text().splitlines()
            flat = [",".join([*row.split(",")[:2], "0.0", "0.0", "0.0", "100"]) for row in rows[:-6]]
            file.write_text("\n".join([header, *flat, *rows[-6:]]) + "\n")
        late = analysis.analyse(*records.load(folder.path), 100)
        assert "In 12 of 12 groups" in " ".join(summary.warnings(late))

    def test_what_is_no_study(self, folder, tmp_path, capsys):
        fails_with(capsys, ["study", "plan", tmp_path], "no study.json")
        fails_with(capsys, ["study", "collect", tmp_path / ("x" * 300)], "xxx")
        file = folder.path.with_suffix(".toml")
        fails_with(capsys, ["study", "report", file], "found a study file", "studies/made-up")
        (tmp_path / "mine").write_text("")
        fails_with(capsys, ["study", "status", tmp_path / "mine"], "mine: not a collected study")
        (tmp_path / "old.tar.gz").write_bytes(gzip.compress(b"run,state,reason,record\n"))
        fails_with(capsys, ["study", "status", tmp_path / "old.tar.gz"], "convert_collected.py")

    @pytest.mark.parametrize("row", ["1,inf", "1,-1", "1,1000,7", "1,1000,0.5\n1,40000,0.5"])
    def test_rows_that_no_run_writes(self, tmp_path, row):
        """In a folder and in a collected file, the run is not done."""
        folder = make_study(tmp_path / "s", n_seeds=1)
        run = folder.study().runs()[0]
        text = f"epoch,env_steps,success_rate\n{row}\n"
        folder.run_dir(run).table.write_text(text)
        assert folder.record(run).state == "interrupted"
        assert folder.record(run).reason
        assert main(["study", "status", str(folder.path)]) == 0
        for name in ("s", "whole"):
            path = records.collect(make_study(tmp_path / name, n_seeds=1).path)
        rewrite(path, f"runs/{run.name}/progress.csv", lambda _: text)
        assert StudyFiles(path).record(run).state == "interrupted"

    def test_a_damaged_configuration_costs_a_run_and_no_more(self, tmp_path, capsys):
        folder = make_study(tmp_path / "s", n_seeds=1)
        path = folder.run_dir(folder.study().runs()[0]).config_file
        text, old = path.read_text(), '"total_timesteps": 30000'
        assert old in text
        for value in ('"abc"', "1e999", "[1]", "null", "[" * 100_000):
            path.write_text(text.replace(old, f'"total_timesteps": {value}'))
            assert main(["study", "status", str(folder.path), "--json"]) == 0
        assert "Of 12 runs 1 interrupted" in reported(capsys, folder.path)

    @pytest.mark.parametrize("content", [b"", b"{", b'{"name": 1}', b"\xff\xfe", b"[" * 100_000])
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


class TestPlan:
    def test_pairs_from_the_spread_of_differences_within_cells(self, folder, result, capsys):
        needs = json.loads(printed(capsys, ["study", "plan", folder.path, "--effect", "0.1", "--json"]))
        first = [(need["setup"], need["score"]) for need in needs[:2]]
        assert first == [("pybullet", "area"), ("pybullet", "final")]
        found = [one.verdict.pairs for one in result.setups[0].comparisons.values()]
        gaps = [pairs.treatment - pairs.control for pairs in found]
        sd = np.sqrt(np.mean([gap.var(ddof=1) for gap in gaps]))
        assert needs[0]["pairs"] == 12
        assert needs[0]["sd"] == pytest.approx(sd)
        assert needs[0]["needed"] == planning.runs_needed(0.1, sd, 0.8, 0.05)
        assert needs[0]["interval"][0] <= needs[0]["needed"] <= needs[0]["interval"][1]
        assert needs[0]["needed"] <= needs[0]["needed_holm"]

    def test_the_score_that_needs_fewest_is_recommended(self, folder, capsys):
        needs = planning.plan(*records.load(folder.path), 0.05, 0.8, 0.05)
        best = planning.best(needs)["mujoco"]
        assert best.needed == min(need.needed for need in needs if need.setup == "mujoco")
        out = printed(capsys, ["study", "plan", folder.path, "--effect", "0.05"])
        assert f"mujoco: {best.score} needs the fewest pairs" in out

    @pytest.mark.parametrize(
        ("case", "n"),
        [
            ((0.05, 0.06, 0.8, 0.05), 14),
            ((0.05, 0.06, 0.8, 0.05, False), 24),  # Cohen's tables for d = 0.83: 24 to 26
            ((0.1, 0.15, 0.99, 0.001), 77),  # where scipy's noncentral t is NaN in one tail
            ((1e-6, 1.0, 0.8, 0.05), None),
            ((0.05, 0.0, 0.8, 0.05, False), 2),
            ((0.05, 0.0, 0.8, 0.05), 6),  # five signs alike: 0.0625
        ],
    )
    def test_runs_that_a_t_test_needs(self, case, n):
        assert planning.runs_needed(*case) == n

    def test_looks_are_at_growing_numbers_of_pairs_up_to_all(self):
        assert planning.looks(16, 0.05) == [7, 9, 12, 16]
        assert planning.looks(6, 0.05) == [6]
        assert planning.looks(10, 0.05 / 8) == [9, 10]

    @pytest.mark.parametrize(("n", "settings"), [(6, 1), (10, 3), (11, 8), (40, 6)])
    def test_every_look_can_find_a_difference(self, n, settings):
        plan = Looks(planning.looks(n, 0.05 / settings))
        at, spent = plan.pairs, plan.spent(settings)
        found = [verdicts.take(plan, np.ones(n), at[: i + 1], settings)[-1] for i in range(len(at))]
        assert found[0].ending == "difference"
        assert all(2.0 ** (1 - k) <= error for k, error in zip(at, spent, strict=True))

    def test_table_and_bad_flags(self, folder, capsys, monkeypatch):
        monkeypatch.setattr(console, "width", 80)
        assert "…" not in (shown := printed(capsys, ["study", "plan", folder.path]))
        assert max(map(len, shown.splitlines())) <= 80
        assert "converged" in shown
        fails_with(capsys, ["study", "plan", folder.path, "--power", "1"], "--power")
        report = ["study", "report", folder.path, "--resamples", "999999999999"]
        fails_with(capsys, report, "--resamples", "999999999999")  # which no memory holds


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.parametrize("width", [400, 1600])
def test_a_browser_shows_every_table_and_figure(result, written, tmp_path, width):
    content = html.escape(written.read_text().replace("</body>", MEASURE))
    page = tmp_path / "page.html"  # a window cannot be as narrow as a frame in it
    page.write_text(f'<!doctype html><iframe width="{width}" height="900" srcdoc="{content}"></iframe>')
    switches = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
    switches += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    switches += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1800,1000"]
    switches += ["--enable-logging=stderr", f"--screenshot={tmp_path / 'page.png'}"]
    shown = subprocess.run(
        [CHROMIUM, *switches, page.as_uri()], env=os.environ | {"HOME": str(tmp_path)},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    console = [line for line in shown.stderr.splitlines() if "CONSOLE" in line]
    assert len(console) == 1, console
    found = json.loads(re.search(r"FOUND(.*)END", console[0])[1])
    assert found["overflow"] <= 0
    assert found["width"] == width
    expected = {f"table-{t.name}" for t in parts(result, tables.Table)}
    expected |= {f"figure-{p.name}" for p in parts(result, figures.Picture)}
    assert {name for name, _, _ in found["figures"]} == expected
    for name, drawn_width, rows in found["figures"]:
        assert drawn_width > 100, name
        assert rows > 0 or name.startswith("figure-"), name


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "docs/reports").glob("*.html")))
def test_committed_reports_come_out_of_their_data(tmp_path, name):
    found = analysis.analyse(*records.load(ROOT / f"docs/data/{name}.tar.gz"))
    page = report.write(found, tmp_path).read_bytes()
    assert page == (ROOT / f"docs/reports/{name}.html").read_bytes()


class TestForReadersAndPrograms:
    def test_answers_are_sentences_and_p_is_corrected_once(self, folder, capsys, written):
        assert "layout 1: " in (out := printed(capsys, ["study", "status", folder.path]))
        assert "too few runs to find a difference at 0.05" in out
        table = (written.parent / "tables/pybullet_comparisons.csv").read_text().splitlines()
        assert table[0].startswith("Setting,Pairs,Mean success,p,")
        assert table[0].count(",p") == 1
        brief = (written.parent / "tables/pybullet_comparisons.brief.tex").read_text()
        assert brief.splitlines()[0] == r"\begin{tabular}{llll}"

    def test_a_single_setting_has_no_column(self):
        table = tables.Table("x", "x", [{"Setting": "all", "Group": "all", "n": "1"}])
        assert list(table.frame) == ["n"]

    def test_versions_that_cannot_change_a_result_are_no_difference(self):
        made = {"commit": "a", "versions": {"torch": "2", "mpi4py": "4", "pybullet": "3"}}
        config = {"ranks": 1, "scene": {"simulator": "mujoco"}, "provenance": [made]}
        assert summary.made_with(config) == {("commit", "a"), ("torch", "2")}
        assert ("mpi4py", "4") in summary.made_with({**config, "ranks": 2})
        assert ("pybullet", "3") in summary.made_with({**config, "scene": None})

    def test_scores_are_exact_and_in_columns(self, result, written):
        found = pandas.read_csv(written.parent / "scores.csv", float_precision="round_trip")
        one = result.setups[0]
        group = one.groups["layout 2", "on"]
        row = found.query("setup == 'pybullet' and setting == 'layout 2' and score == 'area'")
        arm, gap = (row[row.arm == name].iloc[0] for name in ("touch", "touch − no touch"))
        assert arm.estimate == group.scores["area"].mean()
        expected = one.comparisons["layout 2"].verdict
        assert (gap.estimate, gap.low, gap.high) == tuple(expected.pairs.difference)
        assert (gap.n, gap.p_holm) == (4, expected.p_holm)

    def test_rliable_takes_the_arrays(self, written):
        found = dict(np.load(written.parent / "scores.npz"))
        assert {name: table.shape for name, table in found.items()} == {
            f"{setup}, {arm}": (4, 3)
            for setup in ("pybullet", "mujoco")
            for arm in ("touch", "no touch")
        }
        scores, intervals = library.get_interval_estimates(
            found, lambda table: np.array([metrics.aggregate_iqm(table)]), reps=50
        )
        assert scores.keys() == intervals.keys() == found.keys()
