"""What set-ups say together, beside the studies: `python -m benchmarks over_setups`, and BCa."""

import itertools
import json
import sys

import numpy as np
import pandas
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from study_records import PAPER_LIKE, make_study

from benchmarks.studies import over_setups
from benchmarks.studies.coverage import bca_interval
from tactilerl import statistics
from tactilerl.study import analysis, records


@pytest.fixture
def rng():
    return np.random.default_rng(1)


class TestOverSetups:
    def test_mixed_model_finds_what_was_put_in(self, rng):
        rows = []
        for at in itertools.product("ab", "cd", range(6)):
            offset = rng.normal(0, 0.05)
            for treatment in [0, 1] * 10:
                gain = treatment * (0.1 + 0.2 * (at[0] == "b"))
                score = 0.5 + gain + offset + rng.normal(0, 0.02)
                rows.append((score, treatment, *at[:2], "x", str(at)))
        table = pandas.DataFrame(rows, columns=over_setups.COLUMNS)
        terms = {term.name: term for term in over_setups.mixed_model(table)}
        assert terms["treatment"].effect.value == pytest.approx(0.1, abs=0.01)
        assert terms["treatment:C(hand)[T.b]"].effect.value == pytest.approx(0.2, abs=0.01)
        assert terms["treatment:C(hand)[T.b]"].p_value < 0.001
        _, low, high = terms["treatment:C(simulator)[T.d]"].effect
        assert low < 0 < high
        assert not [name for name in terms if "algorithm" in name]


class TestStudies:
    def test_set_ups_agree_on_the_order_that_was_put_in(self, tmp_path, monkeypatch, capsys):
        folder = make_study(tmp_path / "study")
        args = ["over_setups", str(folder.path), "--out", str(tmp_path / "out.json")]
        monkeypatch.setattr(sys, "argv", args)
        over_setups.main()
        assert "do not cross" in capsys.readouterr().out
        found = json.loads((tmp_path / "out.json").read_text())["agreement"]
        assert list(found) == ["treatment", "difference to the control"]
        assert found["treatment"][0] == pytest.approx(1)

    def test_a_mixed_model_only_where_set_ups_cross(self, tmp_path):
        text = PAPER_LIKE[: PAPER_LIKE.index("[setups.pybullet]")].replace("[1, 2, 5]", "[2]")
        for hand in ("mpl", "shadow"):
            for simulator in ("mujoco", "pybullet"):
                text += f'[setups.{hand}_{simulator}]\nenv = "{hand}"\nsimulator = "{simulator}"\n'
        crossed = analysis.analyse(*records.load(make_study(tmp_path / "crossed", text).path), 500)
        terms = [term.name for term in over_setups.mixed(crossed.setups, "area")]
        assert "treatment:C(hand)[T.shadow]" in terms
        assert "treatment:C(simulator)[T.pybullet]" in terms
        assert not [term for term in terms if "algorithm" in term]


class TestBCa:
    def test_bca_is_scipys(self, rng):
        scores = rng.beta(0.5, 0.2, 12)
        ours = bca_interval(scores, "mean", statistics.resample(rng, 12, 20_000))
        theirs = stats.bootstrap((scores,), np.mean, method="BCa", n_resamples=20_000, rng=rng)
        assert_allclose(ours, theirs.confidence_interval, atol=0.01)

    @pytest.mark.parametrize("scores", [[0.4], [0.4, 0.4, 0.4]])
    def test_runs_alike_have_no_bca(self, rng, scores):
        counts = statistics.resample(rng, len(scores), 100)
        assert np.isnan(bca_interval(np.array(scores), "iqm", counts)).all()
