"""The tables of the study of layouts find what made-up runs were given, and nothing else."""

import itertools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from benchmarks.studies import layouts_study as study

LAYOUTS = [*(f"layout {i}" for i in range(1, 7)), "4 chosen", "8 chosen"]


@pytest.fixture
def made_up(monkeypatch, rng):
    """Return a function that makes runs with given means of the layouts, (hands, layouts)."""

    def make(levels, n_seeds=48):
        cells = [
            {"setup": (learner, hand), "layout": name, study.TEST: score, study.RUN: score / 2}
            | dict.fromkeys(study.WINDOWS, score)
            for learner in study.LEARNERS
            for hand, of_hand in zip(study.HANDS, levels, strict=False)
            for name, level in zip((*LAYOUTS, study.NONE), [*of_hand, 0.2], strict=True)
            for score in level + 0.08 * rng.standard_normal(n_seeds)
        ]
        monkeypatch.setattr(study, "runs", lambda name: pd.DataFrame(cells))

    return make


def test_pairs_differ_where_they_do(made_up):
    levels = np.full((3, 8), 0.7)
    levels[:, 4] = 0.6  # layout 5
    made_up(levels)
    of = study.cells("")
    pairs = itertools.combinations(LAYOUTS, 2)
    assert study.differ(study.differences(of)) == [pair for pair in pairs if "layout 5" in pair]
    gain, p = study.contrast(of, study.gain(of))
    assert gain.low < 0.7 - 0.1 / 8 - 0.2 < gain.high
    assert p < 1e-6


def test_cells_of_a_set_up_share_their_spread():
    group = {"layout 1": np.array([0.5, 0.7]), study.NONE: np.array([0.2, 0.2])}
    one, none = study.with_intervals(group).values()
    margin = 4.303 * np.sqrt(0.02 / 2 / 2)  # t of two degrees of freedom; variance; seeds
    assert (one.value, none.value) == (0.6, 0.2)
    assert np.allclose([one.high - 0.6, 0.6 - one.low, none.high - 0.2], margin, rtol=1e-3)


def test_a_seed_with_a_run_that_was_cut_off_is_left_out(monkeypatch):
    whole, records = study.load("layouts_pybullet")
    one = next(record for record in records if record.run.seed == 1)
    cut = [replace(each, state="interrupted") if each is one else each for each in records]
    monkeypatch.setattr(study, "load", lambda name: (whole, cut))
    uncached = study.runs.__wrapped__
    n_left = len(uncached("layouts_pybullet"))
    monkeypatch.undo()
    assert n_left == len(uncached("layouts_pybullet")) - 10


def test_few_are_as_good_only_within_the_margin(made_up, capsys):
    levels = np.full((3, 8), 0.7)
    levels[:, 6] = 0.55  # four chosen
    made_up(levels)
    study.show_equivalence("")
    rows = [line for line in capsys.readouterr().out.splitlines() if "all set-ups" in line]
    assert [row.split("|")[-2].strip() for row in rows] == ["worse", "equivalent"]


def test_a_predictor_is_found_and_noise_is_not(rng):
    x = rng.standard_normal((3, 8, 1))
    y = 0.3 * x[..., 0] + np.array([[0.0], [1.0], [2.0]])  # each hand has its own level
    assert study.predicted(x, y, by_hand=True) == pytest.approx(1.0)
    assert study.predicted(x, y, by_hand=False) == pytest.approx(1.0)
    noise = [study.predicted(rng.standard_normal((3, 8, 1)), y, by_hand=True) for _ in range(50)]
    assert np.mean(noise) < 0


@pytest.mark.parametrize("n_hands", [1, 3])
def test_all_tables_and_the_figure_come_out(n_hands, made_up, monkeypatch, rng, tmp_path, capsys):
    made_up(0.5 + 0.3 * rng.random((n_hands, 8)), n_seeds=5)
    known = {"taxels": 20, "area_mm2": 100.0, "success": 0.8}
    table = {
        hand: {name: {k: v * (1 + rng.random()) for k, v in known.items()} for name in LAYOUTS}
        for hand in study.HANDS
    }
    monkeypatch.setattr(study, "data", lambda name: table)
    monkeypatch.setattr(study, "N_RESAMPLES", 20)
    for show in study.QUESTIONS.values():
        show("")
    printed = capsys.readouterr().out
    assert "nan" not in printed
    study.picture("").savefig(tmp_path / "layouts_study.png")
    assert (tmp_path / "layouts_study.png").stat().st_size > 10_000
