"""The statistics of evaluations and studies: against scipy, by hand, simulated."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from tactilerl import statistics as s

# What the sign-flip test of tactilerl 0.4.0 said of these differences, all exact.
SIGN_FLIPS = [
    ([-0.14, 0.499], 1.0),
    ([0.756, 0.405, 0.241, 1.556, -1.751, 0.361], 0.53125),
    ([0.1, -0.1, 0.2, 0.3, -0.2, 0.4], 0.34375),  # with ties
    ([-10, 22, 3, -1, 6, 3, 13, 5, 5, -2, 9, -5, 11, 20, -10, -19], 0.279327392578125),
]
HOLM = [
    ([0.01, np.nan, 0.04], [0.02, np.nan, 0.04]),
    ([0.2, 0.2, 0.001, 0.6, 0.04], [0.6, 0.6, 0.005, 0.6, 0.16]),
    ([], []),
]


class TestRates:
    @pytest.mark.parametrize(
        ("curve", "rate"),
        [
            ([0.0, 0.1, 0.35, 0.61, 0.62, 0.61, 0.9], 0.61),  # 0.62 is the next bin
            ([0.9, 0.9, 0.1, 0.1], 0.1),  # of equally full bins the last one visited
            ([0.1, 0.1, 0.9, 0.9], 0.9),
            ([0.58, 0.5999, 0.57], 0.58995),  # an edge belongs to the bin above
        ],
    )
    def test_converged_rate_is_the_level_where_the_curve_stays(self, curve, rate):
        assert s.converged_rate(np.array(curve)) == pytest.approx(rate)

    def test_the_end_is_the_mean_of_the_last_fifth(self):
        assert s.end_rate(np.arange(20.0)) == pytest.approx(17.5)
        assert s.end_rate(np.array([0.2, 0.4])) == pytest.approx(0.4)

    def test_area_counts_steps_not_points(self):
        steps = np.array([0.0, 1.0, 10.0])
        assert s.area_under_curve(steps, np.array([1.0, 0.0, 0.0])) == pytest.approx(0.05)
        assert s.area_under_curve(steps[:1], np.array([0.3])) == pytest.approx(0.3)


class TestIntervals:
    @pytest.mark.parametrize("n", [2, 10])
    def test_each_resample_is_averaged_as_if_it_were_written_out(self, rng, n):
        scores, counts = rng.random(n), s.resample(rng, n, 50)
        assert counts.shape == (n, 50)
        written_out = [np.repeat(scores, drawn).mean() for drawn in counts.T]
        wanted = s.percentile_interval(np.array(written_out), s.expanded(n))
        assert_allclose(s.mean(scores, counts), [scores.mean(), *wanted])

    def test_a_curve_has_the_interval_of_each_point(self, rng):
        curves = rng.random((5, 3))[:, [0, 1, 1, 2]]
        counts = s.resample(rng, 5, 50)
        means, bounds = s.mean_curve(curves, counts)
        points = [s.mean(point, counts) for point in curves.T]
        assert_allclose(np.column_stack([means, bounds]), points)

    def test_an_expanded_interval_is_a_t_interval_for_normal_samples(self, rng):
        samples = rng.normal(0, 1, 40)
        ours = s.mean(samples, s.resample(rng, 40, 50_000))
        theirs = stats.ttest_1samp(samples, 0).confidence_interval()
        assert_allclose(ours[1:], theirs, atol=0.03)
        assert s.expanded(10**6) == pytest.approx(0.95, abs=1e-4)

    @pytest.mark.parametrize("n", [6, 10])
    def test_an_interval_of_few_pairs_contains_the_truth(self, rng, n):
        counts = s.resample(rng, n, 4000)
        intervals = [s.mean(rng.normal(0.1, 0.2, n), counts)[1:] for _ in range(1000)]
        assert np.mean([low <= 0.1 <= high for low, high in intervals]) > 0.93

    def test_no_samples_no_interval_and_equal_ones_no_width(self, rng):
        assert np.isnan(s.mean(np.array([]), s.resample(rng, 0, 100))).all()
        assert_allclose(s.mean(np.full(3, 0.4), s.resample(rng, 3, 100)), [0.4] * 3)


class TestPValues:
    def test_sign_flips_say_what_they_said_before(self, rng):
        for differences, p_value in SIGN_FLIPS:
            assert s.sign_flip_p(np.array(differences), rng) == pytest.approx(p_value)
        assert math.isnan(s.sign_flip_p(np.ones(1), rng))

    def test_beyond_16_pairs_some_ways_stand_for_all(self, rng):
        differences = rng.normal(0.4, 1, 17)
        exact = s.sign_flip_p(differences, rng, 2**16)
        assert s.sign_flip_p(differences, rng, 10_000) == pytest.approx(exact, abs=0.01)

    def test_holm(self):
        for p_values, corrected in HOLM:
            assert_allclose(s.holm(p_values), corrected)
