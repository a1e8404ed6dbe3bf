"""The statistics of evaluations, probes and studies: against rliable and scipy, by hand, simulated."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rliable import library, metrics
from scipy import stats
from tactilerl import statistics as s


def drawn_like_rliable(seed, n_runs, n_resamples):
    """rliable draws from NumPy's global generator, whatever its random_state says."""
    np.random.seed(seed)  # noqa: NPY002
    indices = [np.random.choice(n_runs, (n_runs, 1), replace=True) for _ in range(n_resamples)]  # noqa: NPY002
    return np.array([np.bincount(i.ravel(), minlength=n_runs) for i in indices], np.uint8).T


class TestRates:
    def test_converged_rate_is_the_level_where_the_curve_stays(self):
        curve = [0.0, 0.1, 0.35, 0.61, 0.62, 0.61, 0.9]  # 0.62 is the next bin
        assert_allclose(s.converged_rate(np.array([curve])), [0.61])

    def test_of_equally_full_bins_the_last_one_visited(self):
        assert_allclose(s.converged_rate(np.array([[0.9, 0.9, 0.1, 0.1]])), [0.1])
        assert_allclose(s.converged_rate(np.array([[0.1, 0.1, 0.9, 0.9]])), [0.9])

    def test_a_rate_on_an_edge_belongs_to_the_bin_above(self):
        assert_allclose(s.converged_rate(np.array([[0.58, 0.5999, 0.57]])), [np.mean([0.58, 0.5999])])

    def test_points_without_episodes_are_left_out(self):
        curves = np.array([[np.nan, 0.5, 0.5], [np.nan] * 3])
        assert_allclose(s.converged_rate(curves), [0.5, np.nan])

    def test_rates_outside_of_0_and_1_are_refused(self):
        with pytest.raises(ValueError, match="allowed from 0 to 1"):
            s.converged_rate(np.array([[0.5, 1.5]]))

    def test_final_rate_is_the_mean_of_the_last_tenth(self):
        assert_allclose(s.final_rate(np.arange(20.0)[None]), [18.5])
        assert_allclose(s.final_rate(np.array([[0.2, 0.4]])), [0.4])

    def test_area_counts_steps_not_points(self):
        steps = np.array([0.0, 1.0, 10.0])
        assert_allclose(s.area_under_curve(steps, np.array([[1.0, 0.0, 0.0]])), [0.05])
        assert_allclose(s.area_under_curve(steps, np.full((2, 3), 0.7)), [0.7, 0.7])
        assert_allclose(s.area_under_curve(steps[:1], np.array([[0.3]])), [0.3])

    def test_steps_to_a_threshold_are_infinite_where_it_is_never_reached(self):
        curves = np.array([[0.1, 0.5, 0.2], [0.1, 0.2, 0.3]])
        assert_allclose(s.steps_to_threshold(np.array([10, 20, 30]), curves, 0.5), [20, np.inf])


class TestIntervals:
    @pytest.mark.parametrize("n_runs", [1, 2, 3, 4, 5, 7, 10, 11, 20])
    def test_aggregates_are_those_of_rliable_and_numpy(self, rng, n_runs):
        scores = rng.random(n_runs)
        assert_allclose(s.aggregate(scores, "iqm"), metrics.aggregate_iqm(scores[:, None]))
        assert_allclose(s.aggregate(scores, "mean"), metrics.aggregate_mean(scores[:, None]))
        assert_allclose(s.aggregate(scores, "median"), np.median(scores))

    @pytest.mark.parametrize("n_runs", [1, 2, 3, 5, 10, 20, 300])
    @pytest.mark.parametrize("metric", s.METRICS)
    def test_each_resample_is_aggregated_as_if_it_were_written_out(self, rng, n_runs, metric):
        scores = np.round(rng.random(n_runs), 1)  # with ties
        counts = s.resample(rng, n_runs, 50)
        written_out = [s.aggregate(np.repeat(scores, drawn), metric) for drawn in counts.T]
        assert_allclose(s.bootstrap(scores, metric, counts), written_out, atol=1e-12)

    def test_curves_are_what_rliable_says_point_by_point(self, rng):
        curves = np.sort(rng.random((6, 4)), axis=1)
        curves[:, 2] = curves[:, 1]  # points alike are computed once
        values, intervals = s.sample_efficiency(curves, "iqm", drawn_like_rliable(3, 6, 300))
        for point, value, interval in zip(curves.T, values, intervals, strict=True):
            np.random.seed(3)  # noqa: NPY002
            expected = library.get_interval_estimates(
                {"x": point[:, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=300
            )
            theirs = [expected[0]["x"][0], *expected[1]["x"][:, 0]]
            assert_allclose([value, *interval], theirs, atol=1e-12)

    @pytest.mark.parametrize("scores", [[0.4], [0.4, 0.4, 0.4]])
    def test_runs_alike_have_no_width(self, rng, scores):
        counts = s.resample(rng, len(scores), 100)
        assert_allclose(s.estimate(np.array(scores), "iqm", counts), [0.4] * 3)


def test_holm():
    assert_allclose(s.holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    assert_allclose(s.holm([0.01, np.nan, 0.04]), [0.02, np.nan, 0.04])
    assert len(s.holm([])) == 0


def test_resamples_without_a_number_are_no_evidence():
    drawn = np.random.default_rng(0).normal(size=999)
    assert s.bootstrap_p(np.append(drawn, [np.nan] * 2000)) == s.bootstrap_p(drawn)
    assert s.bootstrap_p(np.full(9, np.nan)) == 1.0


class TestPairs:
    @pytest.mark.parametrize("n", [2, 3, 6, 16])
    def test_sign_flips_are_scipys_exact_test(self, rng, n):
        """With up to 16 pairs."""
        differences = rng.normal(0.5, 1, n)
        theirs = stats.permutation_test(
            (differences,), lambda x, axis: x.mean(axis), permutation_type="samples", vectorized=True,
            n_resamples=2**16,
        )  # fmt: skip
        assert s.sign_flip_p(differences, rng) == pytest.approx(theirs.pvalue)

    def test_beyond_16_pairs_some_ways_stand_for_all(self, rng):
        differences = rng.normal(0.4, 1, 17)
        exact = s.sign_flip_p(differences, rng, 2**16)
        assert s.sign_flip_p(differences, rng, 20_000) == pytest.approx(exact, abs=0.01)

    def test_a_small_difference_shows_through_a_large_spread(self, rng):
        level = rng.random(8)
        better = level + 0.01 + 0.001 * rng.random(8)
        assert s.sign_flip_p(better - level, rng) == pytest.approx(2 / 2**8)  # all signs alike
        assert s.sign_flip_p(np.ones(3), rng) == pytest.approx(0.25)
        assert s.sign_flip_p(np.zeros(6), rng) == 1
        assert math.isnan(s.sign_flip_p(np.ones(1), rng))

    def test_an_expanded_interval_is_a_t_interval_for_normal_samples(self, rng):
        samples = rng.normal(0, 1, 40)
        ours = s.mean(samples, s.resample(rng, 40, 50_000))
        theirs = stats.ttest_1samp(samples, 0).confidence_interval()
        assert_allclose(ours[1:], theirs, atol=0.03)
        assert s.expanded(10**6) == pytest.approx(0.95, abs=1e-4)

    @pytest.mark.parametrize("n", [6, 10])
    def test_an_interval_of_few_pairs_contains_the_truth(self, rng, n):
        counts = s.resample(rng, n, 4000)
        found = [s.mean(rng.normal(0.1, 0.2, n), counts)[1:] for _ in range(1000)]
        assert np.mean([low <= 0.1 <= high for low, high in found]) > 0.93

    def test_no_pairs_no_interval(self, rng):
        assert np.isnan(s.mean(np.array([]), s.resample(rng, 0, 100))).all()

    def test_a_share_is_a_ratio_of_means(self, rng):
        room = rng.normal(0.6, 0.1, 12)
        gain = room / 2 + rng.normal(0, 0.02, 12)
        value, low, high = s.share(gain, room, s.resample(rng, 12, 5000))
        assert value == pytest.approx(gain.mean() / room.mean())
        assert low < 0.5 < high
        assert high - low < 0.1


class TestLooks:
    def test_one_look_is_the_plain_test(self, rng):
        differences = rng.normal(0.5, 1, 9)
        (look,) = s.sequential_sign_flips(differences, [(9, 0.05)], 9, rng)
        assert look.p_value == pytest.approx(s.sign_flip_p(differences, rng))
        assert 0.04 < look.level <= 0.05

    def test_by_hand(self, rng):
        """Six pairs, all ahead: 1 of 32 ways. Nothing can stop at the first look, so that the second is
        a plain test with all of the error."""
        first, second = s.sequential_sign_flips(np.ones(8), [(6, 0.02), (8, 0.05)], 8, rng)
        assert first.p_value == pytest.approx(1 / 32)
        assert second.p_value == pytest.approx(1 / 128)

    def test_what_stopped_earlier_counts_at_the_next_look(self, rng):
        """At the first look one of 32 ways stops, all signs alike. It counts as more extreme than what
        went on."""
        differences = np.array([-1.0, 2, 3, 4, 5, 6, 7, 8])
        first, second = s.sequential_sign_flips(differences, [(6, 0.04), (8, 0.06)], 8, rng)
        signs = s.sign_flips(8, rng)
        stopped = np.abs(signs[:, :6] @ differences[:6]) >= 21
        as_far = np.abs(signs @ differences) >= differences.sum()
        assert first.p_value == pytest.approx(2 / 32)
        assert second.p_value == pytest.approx(np.mean(stopped | as_far))

    @pytest.mark.parametrize("n", [12, 18])
    def test_all_looks_together_keep_the_level(self, rng, n):
        looks = [(k, 0.05 * k / n) for k in (n // 2, 3 * n // 4, n)]
        stopped = 0
        for _ in range(400):
            found = s.sequential_sign_flips(rng.standard_t(3, n), looks, n, rng, 4000)
            stopped += found[-1].p_value <= looks[len(found) - 1][1]
        assert 0.02 < stopped / 400 < 0.085
