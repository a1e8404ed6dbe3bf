"""The tables of studies/setups.toml, from runs that were made up: what was put in comes out."""

import numpy as np
import pytest
from study_records import make_study

from benchmarks.command import ROOT
from benchmarks.studies import setups_study
from tactilerl.study import records


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
        assert setups_study.gains(of).shape == (4, 3)


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
    best = told(setups_study.show_layouts)["Allegro Hand, PyBullet, DDPG+HER"]
    assert best[-2] == "layout 1"
    assert best[-1].startswith("+0.10 (+0.0")
    _, concordance, p, correlation = told(setups_study.show_order)["mean over the run"]
    assert (concordance, float(p), correlation) == (
        "1.00",
        pytest.approx(0, abs=0.001),
        "1.00 (1.00 to 1.00)",
    )


def test_what_foretells_the_order(told, monkeypatch):
    reached = {"layout 1": 0.4, "layout 2": 0.3, "layout 5": 0.2, "8 chosen": 0.5}
    row = {name: {"taxels": -value, "felt": value, "success": value, "best": {"success": 1 - value}}
           for name, value in reached.items()}  # fmt: skip
    monkeypatch.setattr(
        setups_study, "data", lambda name: {"hands": dict.fromkeys(("mpl", "shadow", "allegro"), row)}
    )
    of = {name: dict.fromkeys(range(3), value) for name, value in reached.items()}
    found = dict.fromkeys(setups_study.learned("area"), of | {"no touch": dict.fromkeys(range(3), 0.1)})
    monkeypatch.setattr(setups_study, "learned", lambda score: found)
    rows = told(setups_study.show_predictors)
    values = [float(estimate.split()[0].replace("−", "-")) for _, estimate in rows.values()]
    assert np.allclose(values, [-1, 1, 1, -1])


def test_figure_has_every_set_up_in_a_panel_for_each_predictor(study, monkeypatch, tmp_path):
    monkeypatch.setattr(setups_study, "load", lambda name: study)
    drawn = []
    monkeypatch.setattr(setups_study.Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    setups_study.draw(tmp_path)
    panels = drawn[0].axes
    assert [len(axes.lines) for axes in panels] == [9] * len(setups_study.PREDICTORS)
    taxels = panels[0].lines[0].get_xdata()
    assert list(taxels) == [8, 19, 79, 139]
