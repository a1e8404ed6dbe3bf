"""The tables of studies/setups.toml, from runs that were made up: what was put in comes out."""

import numpy as np
import pytest
from benchmarks.command import ROOT
from benchmarks.studies import setups_study
from tactilerl.study import records

from study_records import make_study


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    text = (ROOT / "studies" / "setups.toml").read_text().replace("0-4", "0-2")
    return records.load(make_study(tmp_path_factory.mktemp("made") / "setups", text, epochs=8).path)


@pytest.fixture
def told(study, monkeypatch, capsys):
    """What a table prints, by row."""
    monkeypatch.setattr(setups_study, "load", lambda name: study)

    def rows(show):
        show()
        cells = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()]
        return {row[0]: row[1:] for row in cells[2:]}

    return rows


def test_every_set_up_has_its_layouts_and_no_touch(study, monkeypatch):
    monkeypatch.setattr(setups_study, "load", lambda name: study)
    found = setups_study.learned("area")
    assert [str(setup) for setup in found][:2] == ["MPL hand, MuJoCo, PPO", "MPL hand, PyBullet, PPO"]
    assert len(found) == 9
    for setup, of in found.items():
        assert set(of) == {*setups_study.LAYOUTS, "no touch"}, setup
    assert [each.shape for each in setups_study.gains().values()] == [(4, 3)] * 9


def test_tables_say_what_was_put_in(told, study, monkeypatch):
    order = {"8 chosen": 0.3, "layout 1": 0.2, "layout 2": 0.15, "layout 5": 0.1, "no touch": 0.0}
    found = {
        setup: {layout: {seed: 0.2 + gain * (0.9 + seed / 10) for seed in range(3)}
                for layout, gain in order.items()}
        for setup in setups_study.learned("area")
    }  # fmt: skip
    monkeypatch.setattr(setups_study, "learned", lambda score: found)
    worth = told(setups_study.show_worth)
    assert worth["MPL hand, MuJoCo, PPO"][2].startswith("+0.19")
    row = told(setups_study.show_layouts)["Allegro Hand, PyBullet, DDPG+HER"]
    assert row[-3] == "+0.10"
    assert row[-1] == "yes"
    assert told(setups_study.show_chosen)["layout 2"][1].startswith("+0.15 (+0.1")
    concordance, by_setup, by_hand = told(setups_study.show_order)["mean over the run"]
    assert (concordance, by_setup) == ("1.00", "< 0.001")
    assert float(by_hand) == pytest.approx(1 / 576, abs=0.001)


@pytest.mark.parametrize(
    ("ahead", "said"),
    [
        ([0.1, 0.12, 0.11], "yes"),
        ([-0.045, -0.046, -0.045], "yes"),
        ([-0.055, -0.054, -0.055], "no"),
        ([-0.2, 0.2, 0.1], "cannot tell"),
    ],
)
@pytest.mark.parametrize("other", [-0.3, 0.0])
def test_are_chosen_taxels_within_the_margin(ahead, said, other):
    """Of the best of two layouts, be they alike or not."""
    level = np.array([0.5, 0.6, 0.4])
    at_least, is_within = setups_study.compared(level + ahead, [level + other, level])
    assert is_within == said
    assert at_least < np.mean(ahead)
