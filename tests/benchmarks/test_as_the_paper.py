"""The paper's comparison, and its own numbers: `python -m benchmarks as_the_paper`."""

import math
import sys

import numpy as np
import pytest
from benchmarks.studies import as_the_paper
from numpy.testing import assert_allclose
from tactilerl import statistics
from tactilerl.study import analysis, records
from tactilerl.study.tables import Table

from study_records import make_study


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_study(tmp_path_factory.mktemp("study") / "made-up")


@pytest.fixture(scope="module")
def result(folder):
    return analysis.analyse(*records.load(folder.path), 500)


@pytest.fixture(scope="module")
def tables(result):
    parts = as_the_paper.parts(result.setups)
    return {part.name: part for part in parts if isinstance(part, Table)}


def test_the_papers_comparison(tables):
    row = next(r for r in tables["pybullet_paper"].rows if r["Config."] == "layout 2")
    assert float(row["Difference of IQMs"].split()[0]) > 0.1
    assert row["P(improvement)"].startswith("1.00 ")


def test_the_papers_numbers_stand_beside_ours(result, tables):
    assert [as_the_paper.published(one.config).table for one in result.setups] == [1, 2]
    made = tables["pybullet_converged"]
    row = next(r for r in made.frame.to_numpy().tolist() if r[:2] == ["layout 2", "touch"])
    assert row[-1] == "0.66 [0.63, 0.69]"
    assert "Table 1 of the paper" in made.title
    assert "30,0" in made.note
    assert "500,000 in the paper" in made.note
    row = tables["pybullet_paper"].frame.to_numpy().tolist()[1]
    assert row[-3:] == ["0.04", "39 %", "0.50"]


def test_they_are_printed_and_drawn(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["as_the_paper", str(folder.path), "--figures", str(tmp_path / "f")]
    )
    as_the_paper.main()
    drawn = {path.name for path in (tmp_path / "f").iterdir()}
    assert {"pybullet_converged.svg", "mujoco_converged.png"} <= drawn
    assert "touch against no touch as the paper compares them" in capsys.readouterr().out


def test_the_papers_best_comparison_had_one_chance_in_two():
    for main_, control, power in (
        ((0.66, 0.62, 0.68), (0.61, 0.57, 0.65), 0.50),
        ((0.88, 0.82, 0.94), (0.81, 0.75, 0.86), 0.39),
    ):
        both = statistics.Estimate(*main_), statistics.Estimate(*control)
        assert as_the_paper.power(*both) == pytest.approx(power, abs=0.005)


def test_published_overlaps_follow_from_the_published_intervals():
    """To the digits that the tables are rounded to."""
    for algo, env, simulator in (("ppo", "mpl", "pybullet"), ("ddpg_her", "shadow", "mujoco")):
        config = {"run": {"algo": algo, "env": env}, "scene": {"simulator": simulator}}
        paper = as_the_paper.published(config)
        for cell, said in paper.overlaps.items():
            main_, control = (paper.estimates[cell, arm]["iqm"] for arm in ("main", "control"))
            overlap = as_the_paper.interval_overlap(main_[1:], control[1:])
            assert overlap == pytest.approx(said, abs=0.16)


def test_other_set_ups_are_not_the_papers():
    config = {"run": {"algo": "ppo", "env": "mpl"}, "scene": {"simulator": "mujoco"}}
    assert as_the_paper.published(config) is None
    assert as_the_paper.published({"run": {"algo": "ppo", "env": "lqr"}, "scene": None}) is None


def test_overlap_is_relative_to_the_control():
    overlap = as_the_paper.interval_overlap
    assert overlap((0.61, 0.68), (0.54, 0.66)) == pytest.approx(5 / 12)  # the paper: 38 %
    assert overlap((0.5, 0.68), (0.6, 0.65)) == 1
    assert overlap((0.1, 0.2), (0.3, 0.4)) == 0
    assert math.isnan(overlap((0.1, 0.2), (0.3, 0.3)))


def test_probability_of_improvement_is_rliables():
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    rng = np.random.default_rng(1)
    a, b = np.round(rng.random(8), 1), np.round(rng.random(6), 1)
    expected = metrics.probability_of_improvement(a[:, None], b[:, None])
    drawn = statistics.resample(rng, 8, 20_000), statistics.resample(rng, 6, 20_000)
    value, low, high = as_the_paper.probability_of_improvement(a, b, drawn)
    assert value == pytest.approx(expected)
    scores = {"x": [a[:, None], b[:, None]]}
    interval = library.get_interval_estimates(
        scores,
        lambda x, y: np.array([metrics.probability_of_improvement(x, y)]),
        reps=3_000,  # each takes a millisecond
        random_state=np.random.RandomState(1),  # few draws are now and then 0.03 off
    )[1]["x"][:, 0]
    assert_allclose([low, high], interval, atol=0.03)
