"""Do set-ups agree? Statistics of several set-ups, on gains whose parts are known."""

import numpy as np
import pandas
import pytest
from benchmarks.studies import agreement
from numpy.testing import assert_allclose
from statsmodels.formula.api import ols
from statsmodels.stats.anova import anova_lm


class TestOrder:
    def test_same_and_opposite_order(self, rng):
        order = np.arange(5.0)
        sure = np.repeat(np.stack([order, order * 2])[..., None], 100, axis=2)
        assert_allclose(agreement.rank_agreement(sure[..., 0], sure), [1, 1, 1])
        assert agreement.rank_agreement(np.stack([order, -order])).value == pytest.approx(-1)
        unsure = sure + rng.normal(0, 3, sure.shape)
        _, low, high = agreement.rank_agreement(sure[..., 0], unsure)
        assert low < 0.5 < high

    def test_one_order_everywhere_is_a_concordance_of_1(self):
        w, p = agreement.concordance(np.tile([0.1, 0.4, 0.2, 0.3], (6, 1)), n_permutations=5000)
        assert w == pytest.approx(1)
        assert p < 0.001
        # Two set-ups in opposite order, twice.
        w, p = agreement.concordance(np.tile([[1.0, 2, 3], [3, 2, 1]], (2, 1)), n_permutations=5000)
        assert w == pytest.approx(0)
        assert p == pytest.approx(1)
        # One of the six orders of three is that of the other set-up.
        _, p = agreement.concordance(np.tile([1.0, 2, 3], (2, 1)), n_permutations=20_000)
        assert p == pytest.approx(1 / 6, abs=0.01)

    def test_p_values_of_noise_are_uniform(self, rng):
        found = [
            agreement.concordance(rng.normal(size=(5, 4)), n_permutations=500)[1] for _ in range(200)
        ]
        assert 0.01 <= np.mean(np.array(found) <= 0.05) <= 0.1

    def test_w_is_as_the_mean_rank_correlation_says(self, rng):
        """r = (m W - 1) / (m - 1) of m set-ups (Kendall 1948)."""
        gains = rng.normal(size=(7, 4, 3)) + np.arange(4.0)[:, None]
        w, _ = agreement.concordance(gains.mean(axis=2), n_permutations=10)
        assert agreement.agreement_of(gains).value == pytest.approx((7 * w - 1) / 6)

    def test_set_ups_of_a_block_are_shuffled_together(self):
        values = np.tile([1.0, 2, 3], (4, 1))
        _, by_setup = agreement.concordance(values, n_permutations=20_000)
        _, by_block = agreement.concordance(values, [*"aabb"], 20_000)
        assert by_setup == pytest.approx(1 / 216, abs=0.003)
        assert by_block == pytest.approx(1 / 6, abs=0.01)

    def test_what_predicts_the_order(self, rng):
        predictor = np.array([3.0, 1, 2, 0])
        gains = predictor[:, None] + rng.normal(0, 0.01, (4, 5))
        assert_allclose(agreement.predicts_order(predictor, gains), [1, 1, 1])

    def test_a_predictor_has_one_order_in_a_block(self):
        order = np.array([3.0, 1, 2, 0])
        values = np.array([order, order * 2, order, -order])
        found, p = agreement.predicted_by_block([order] * 3, values[:3], [*"aab"])
        assert found == pytest.approx(1)
        assert p == pytest.approx(2 / 24**2)  # it, and the reverse
        found, p = agreement.predicted_by_block([order] * 4, values, [*"aabb"])
        assert found == pytest.approx(0.5)
        assert p == pytest.approx(2 / 24, abs=0.01)  # block b says nothing


SDS = {"set-up": 0.1, "layout": 0.1, "set-up × layout": 0.2, "seed within set-up": 0.05, "rest": 0.02}


@pytest.fixture
def gains(rng):
    """500 studies of 9 set-ups, 4 layouts and 5 seeds."""
    shapes = (9, 1, 1), (1, 4, 1), (9, 4, 1), (9, 1, 5), (9, 4, 5)
    return 0.4 + sum(
        sd * rng.normal(size=(500, *shape)) for sd, shape in zip(SDS.values(), shapes, strict=True)
    )


class TestVariance:
    def test_mean_squares_are_those_of_statsmodels(self, gains):
        rows = [(value, *at) for at, value in np.ndenumerate(gains[0])]
        table = pandas.DataFrame(rows, columns=["gain", "setup", "layout", "seed"])
        fit = ols("gain ~ C(setup) * C(layout) + C(setup):C(seed)", table).fit()
        theirs = anova_lm(fit)
        ours = agreement.mean_squares(gains[0])
        for name, row in zip(ours, ("C(setup)", "C(layout)", "C(setup):C(layout)",
                                    "C(setup):C(seed)", "Residual"), strict=True):  # fmt: skip
            square, df = ours[name]
            assert (square, df) == pytest.approx((theirs.mean_sq[row], theirs.df[row])), name

    def test_the_variance_is_shared_as_it_was_put_in(self, gains):
        squares = agreement.mean_squares(gains)
        on_average = {name: square.mean(keepdims=True) for name, (square, _) in squares.items()}
        whole = sum(sd**2 for sd in SDS.values())
        for name, share in agreement.shares(on_average, 9, 4, 5).items():
            assert share[0] == pytest.approx(SDS[name] ** 2 / whole, abs=0.02), name

    def test_intervals_of_shares_hold_what_was_put_in(self, gains):
        whole = sum(sd**2 for sd in SDS.values())
        found = [agreement.variance_shares(one) for one in gains[:60]]
        for name, sd in SDS.items():
            holds = [each[name].low <= sd**2 / whole <= each[name].high for each in found]
            assert np.mean(holds) >= 0.88, name
        widths = [each["layout"].high - each["layout"].low for each in found]
        assert np.mean(widths) < 0.75

    def test_do_layouts_differ_alike_everywhere(self, gains, rng):
        assert agreement.differ(gains[0], 500) < 0.01
        layouts, noise = rng.normal(0, 0.1, (1, 4, 1)), np.full((9, 1, 1), 0.02)
        noise[0] = 0.3  # of one set-up
        p_values = [
            agreement.differ(layouts + noise * rng.normal(size=(9, 4, 5)), 200) for _ in range(100)
        ]
        assert np.mean(np.array(p_values) <= 0.05) <= 0.12
