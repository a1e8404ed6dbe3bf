"""Do set-ups agree? Statistics of several set-ups, on gains whose parts are known."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.studies import agreement


@pytest.fixture
def rng():
    return np.random.default_rng(1)


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
        w, p = agreement.concordance(np.tile([0.1, 0.4, 0.2, 0.3], (6, 1)), 5000)
        assert w == pytest.approx(1)
        assert p < 0.001
        # Two set-ups in opposite order, twice.
        w, p = agreement.concordance(np.tile([[1.0, 2, 3], [3, 2, 1]], (2, 1)), 5000)
        assert w == pytest.approx(0)
        assert p == pytest.approx(1)
        # One of the six orders of three is that of the other set-up.
        _, p = agreement.concordance(np.tile([1.0, 2, 3], (2, 1)), 20_000)
        assert p == pytest.approx(1 / 6, abs=0.01)

    def test_p_values_of_noise_are_uniform(self, rng):
        found = [agreement.concordance(rng.normal(size=(5, 4)), 500)[1] for _ in range(200)]
        assert 0.01 <= np.mean(np.array(found) <= 0.05) <= 0.1

    def test_w_is_as_the_mean_rank_correlation_says(self, rng):
        """r = (m W - 1) / (m - 1) of m set-ups (Kendall 1948)."""
        gains = rng.normal(size=(7, 4, 3)) + np.arange(4.0)[:, None]
        w, _ = agreement.concordance(gains.mean(axis=2), 10)
        assert agreement.agreement_of(gains).value == pytest.approx((7 * w - 1) / 6)

    def test_what_foretells_the_order(self, rng):
        predictor = np.array([3.0, 1, 2, 0])
        gains = [predictor[:, None] + rng.normal(0, noise, (4, 5)) for noise in (0.01, 0.02)]
        assert_allclose(agreement.foretold([predictor, predictor], gains), [1, 1, 1])
        assert agreement.foretold([predictor, -predictor], gains).value == pytest.approx(0)


def test_the_variance_is_shared_as_it_was_put_in(rng):
    sds = {"set-up": 0.1, "layout": 0.1, "set-up × layout": 0.2, "seed within set-up": 0.05}
    n_setups, n_layouts, n_seeds = 12, 12, 3
    effects = {
        "set-up": np.repeat(rng.normal(size=n_setups), n_layouts).reshape(n_setups, n_layouts, 1),
        "layout": rng.normal(size=(1, n_layouts, 1)),
        "set-up × layout": rng.normal(size=(n_setups, n_layouts, 1)),
        "seed within set-up": rng.normal(size=(n_setups, 1, n_seeds)),
    }
    gains = 0.4 + rng.normal(0, 0.02, (n_setups, n_layouts, n_seeds))
    for name, effect in effects.items():
        gains += sds[name] * effect / effect.std()
    rows = [
        (gains[i, j, k], f"setup {i}", f"layout {j}", f"{i} {k}")
        for i, j, k in itertools.product(*map(range, gains.shape))
    ]
    found = agreement.variance_shares(rows, 5)
    whole = sum(sd**2 for sd in sds.values()) + 0.02**2
    assert sum(share.value for share in found.values()) == pytest.approx(1)
    for name, sd in sds.items():
        assert found[name].value == pytest.approx(sd**2 / whole, abs=0.06), name
