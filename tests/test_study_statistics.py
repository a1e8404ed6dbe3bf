"""The statistics of studies: against rliable and scipy, by hand, and by simulation."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rliable import library, metrics
from scipy import stats

from tactilerl.study import statistics as s

RLIABLE = {
    "median": metrics.aggregate_median,
    "iqm": metrics.aggregate_iqm,
    "mean": metrics.aggregate_mean,
}


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def drawn_like_rliable(seed, n_runs, n_resamples):
    """rliable draws from NumPy's global generator, whatever its random_state says."""
    np.random.seed(seed)  # noqa: NPY002
    indices = [np.random.choice(n_runs, (n_runs, 1), replace=True) for _ in range(n_resamples)]  # noqa: NPY002
    return np.array([np.bincount(i.ravel(), minlength=n_runs) for i in indices], np.uint8).T


class TestRates:
    def test_converged_rate_is_the_level_where_the_curve_stays(self):
        curve = [0.0, 0.1, 0.35, 0.61, 0.62, 0.61, 0.9]
        assert_allclose(
            s.converged_rate(np.array([curve])), [np.mean([0.61, 0.61])]
        )  # 0.62 is the next bin

    def test_of_equally_full_bins_the_last_one_visited(self):
        assert_allclose(s.converged_rate(np.array([[0.9, 0.9, 0.1, 0.1]])), [0.1])
        assert_allclose(s.converged_rate(np.array([[0.1, 0.1, 0.9, 0.9]])), [0.9])

    def test_a_level_curve_converges_to_its_level_on_any_edge(self):
        levels = np.arange(101) / 100
        assert_allclose(s.converged_rate(np.repeat(levels[:, None], 5, axis=1)), levels)

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

    @pytest.mark.parametrize("metric", ["iqm", "mean"])
    def test_same_resamples_same_interval_as_rliable(self, rng, metric):
        scores = {"x": rng.random((10, 1))}
        counts = drawn_like_rliable(5, 10, 400)
        np.random.seed(5)  # noqa: NPY002
        value, interval = library.get_interval_estimates(
            scores, lambda x: np.array([RLIABLE[metric](x)]), reps=400
        )
        ours = s.estimate(scores["x"][:, 0], metric, counts)
        assert_allclose(ours, [value["x"][0], *interval["x"][:, 0]], atol=1e-12)

    def test_rliables_median_over_one_task_is_the_mean(self, rng):
        scores = rng.random((10, 1))
        assert_allclose(metrics.aggregate_median(scores), s.aggregate(scores[:, 0], "mean"))

    def test_strata_are_resampled_apart_as_in_rliable(self, rng):
        counts = s.resample(rng, [3, 5], 100)
        assert counts.shape == (8, 100)
        assert set(counts[:3].sum(axis=0)) == {3}
        assert set(counts[3:].sum(axis=0)) == {5}
        scores = rng.random((10, 3))
        _, interval = library.get_interval_estimates(
            {"x": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=5000
        )
        counts = s.resample(rng, [10] * 3, 20_000)
        ours = s.estimate(scores.T.ravel(), "iqm", counts)
        assert_allclose(ours[1:], interval["x"][:, 0], atol=0.015)  # Monte-Carlo error

    def test_curves_are_what_rliable_says_point_by_point(self, rng):
        curves = np.sort(rng.random((6, 4)), axis=1)
        curves[:, 2] = curves[:, 1]  # points alike are computed once
        values, intervals = s.sample_efficiency(curves, "iqm", drawn_like_rliable(3, 6, 300))
        for point, value, interval in zip(curves.T, values, intervals, strict=True):
            np.random.seed(3)  # noqa: NPY002
            expected = library.get_interval_estimates(
                {"x": point[:, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=300
            )
            assert_allclose(
                [value, *interval], [expected[0]["x"][0], *expected[1]["x"][:, 0]], atol=1e-12
            )

    def test_bca_is_scipys(self, rng):
        scores = rng.beta(0.5, 0.2, 12)
        ours = s.bca_interval(scores, "mean", s.resample(rng, 12, 20_000))
        theirs = stats.bootstrap((scores,), np.mean, method="BCa", n_resamples=20_000, rng=rng)
        assert_allclose(ours, theirs.confidence_interval, atol=0.01)

    @pytest.mark.parametrize("scores", [[0.4], [0.4, 0.4, 0.4]])
    def test_runs_alike_have_no_width_and_no_bca(self, rng, scores):
        counts = s.resample(rng, len(scores), 100)
        assert_allclose(s.estimate(np.array(scores), "iqm", counts), [0.4] * 3)
        assert np.isnan(s.bca_interval(np.array(scores), "iqm", counts)).all()

    def test_an_interval_of_many_normal_runs_contains_the_truth_as_often_as_it_says(self, rng):
        counts = s.resample(rng, 40, 500)
        intervals = [s.estimate(rng.normal(0.5, 0.1, 40), "mean", counts)[1:] for _ in range(400)]
        assert 0.90 < np.mean([low <= 0.5 <= high for low, high in intervals]) < 0.98


class TestComparisons:
    def test_overlap_is_relative_to_the_control(self):
        assert s.interval_overlap((0.61, 0.68), (0.54, 0.66)) == pytest.approx(
            5 / 12
        )  # the paper: 38 %
        assert s.interval_overlap((0.5, 0.68), (0.6, 0.65)) == 1
        assert s.interval_overlap((0.1, 0.2), (0.3, 0.4)) == 0
        assert math.isnan(s.interval_overlap((0.1, 0.2), (0.3, 0.3)))

    def test_difference(self, rng):
        a, b = rng.normal(0.8, 0.1, 10), rng.normal(0.5, 0.1, 10)
        drawn = s.resample(rng, 10, 5000), s.resample(rng, 10, 5000)
        value, low, high = s.difference(a, b, "mean", drawn)
        assert value == pytest.approx(a.mean() - b.mean())
        theirs = stats.bootstrap(
            (a, b), lambda x, y, axis: x.mean(axis) - y.mean(axis), method="percentile",
            n_resamples=20_000, rng=rng,
        )  # fmt: skip
        assert_allclose([low, high], theirs.confidence_interval, atol=0.01)

    def test_probability_of_improvement_is_rliables(self, rng):
        a, b = np.round(rng.random(8), 1), np.round(rng.random(6), 1)
        expected = metrics.probability_of_improvement(a[:, None], b[:, None])
        drawn = s.resample(rng, 8, 3000), s.resample(rng, 6, 3000)
        value, low, high = s.probability_of_improvement(a, b, drawn)
        assert value == pytest.approx(expected)
        scores = {"x": [a[:, None], b[:, None]]}
        interval = library.get_interval_estimates(
            scores, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]), reps=2000
        )[1]["x"][:, 0]
        assert_allclose([low, high], interval, atol=0.03)

    def test_permutation_test_of_means_by_hand(self, rng):
        assert s.permutation_p(
            np.array([4.0, 5, 6]), np.array([1.0, 2, 3]), "iqm", rng
        ) == pytest.approx(0.1)
        assert s.permutation_p(np.full(4, 0.5), np.full(4, 0.5), "iqm", rng) == pytest.approx(1)

    def test_permutation_test_keeps_its_level(self, rng):
        p = [
            s.permutation_p(rng.beta(0.5, 0.5, 6), rng.beta(0.5, 0.5, 6), "iqm", rng, 200)
            for _ in range(300)
        ]
        assert np.mean(np.array(p) <= 0.05) < 0.09

    def test_within_pairs_a_small_difference_shows_through_a_large_spread(self, rng):
        level = rng.random(8)
        better = level + 0.01 + 0.001 * rng.random(8)
        assert s.permutation_p(better, level, "mean", rng, paired=True) == pytest.approx(
            2 / 2**8
        )  # all signs alike: exact
        assert s.permutation_p(better, level, "mean", rng) > 0.5
        three = np.array([1.0, 2.0, 3.0])
        assert s.permutation_p(three + 1, three, "mean", rng, paired=True) == pytest.approx(0.25)
        assert math.isnan(s.permutation_p(three[:1], three[:1], "mean", rng, paired=True))

    def test_paired_test_keeps_its_level(self, rng):
        p = []
        for _ in range(300):
            level = rng.random(7)
            pair = level + rng.normal(size=(2, 7))
            p.append(s.permutation_p(*pair, "mean", rng, 500, paired=True))
        assert np.mean(np.array(p) <= 0.05) < 0.09

    def test_holm(self):
        assert_allclose(s.holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
        assert_allclose(s.holm([0.01, np.nan, 0.04]), [0.02, np.nan, 0.04])
        assert len(s.holm([])) == 0

    def test_a_single_run_has_no_p_value(self, rng):
        assert math.isnan(s.permutation_p(np.array([0.5]), np.array([0.1, 0.2]), "iqm", rng))


class TestOverSetups:
    def test_rank_agreement_is_spearmans(self, rng):
        values = rng.random((2, 6))
        assert s.rank_agreement(values).value == pytest.approx(stats.spearmanr(*values).statistic)

    def test_same_and_opposite_order(self, rng):
        order = np.arange(5.0)
        sure = np.repeat(np.stack([order, order * 2])[..., None], 100, axis=2)
        assert_allclose(s.rank_agreement(sure[..., 0], sure), [1, 1, 1])
        assert s.rank_agreement(np.stack([order, -order])).value == pytest.approx(-1)
        unsure = sure + rng.normal(0, 3, sure.shape)
        _, low, high = s.rank_agreement(sure[..., 0], unsure)
        assert low < 0.5 < high

    def test_mixed_model_finds_what_was_put_in(self, rng):
        rows = [
            (hand, simulator, layout, treatment)
            for hand in "ab" for simulator in "cd" for layout in range(6) for treatment in (0, 1)
            for _ in range(10)
        ]  # fmt: skip
        offsets = dict(zip({row[:3] for row in rows}, rng.normal(0, 0.05, 24), strict=True))
        scores = np.array(
            [0.5 + 0.1 * t + 0.2 * t * (h == "b") + offsets[h, m, c] for h, m, c, t in rows]
        )
        scores += rng.normal(0, 0.02, len(rows))
        factors = {
            "hand": [r[0] for r in rows],
            "simulator": [r[1] for r in rows],
            "algorithm": ["x"] * len(rows),
        }
        cells = [f"{r[0]}{r[1]}{r[2]}" for r in rows]
        terms = {
            t.name: t for t in s.mixed_model(scores, np.array([r[3] for r in rows]), factors, cells)
        }
        assert terms["treatment"].effect.value == pytest.approx(0.1, abs=0.01)
        assert terms["treatment:C(hand)[T.b]"].effect.value == pytest.approx(0.2, abs=0.01)
        assert terms["treatment:C(hand)[T.b]"].p_value < 0.001
        assert (
            terms["treatment:C(simulator)[T.d]"].effect.low
            < 0
            < terms["treatment:C(simulator)[T.d]"].effect.high
        )
        assert not [name for name in terms if "algorithm" in name]


class TestPower:
    def test_the_papers_best_comparison_had_one_chance_in_two(self):
        assert s.power_from_intervals(0.05, (0.62, 0.68), (0.57, 0.65)) == pytest.approx(
            0.50, abs=0.005
        )
        assert s.power_from_intervals(0.07, (0.82, 0.94), (0.75, 0.86)) == pytest.approx(
            0.39, abs=0.005
        )

    def test_runs_needed_reach_the_power_and_one_fewer_does_not(self):
        n = s.runs_needed(0.05, 0.06, 0.8, 0.05)
        assert (
            s.power_of_t_test(0.05, 0.06, n, 0.05) >= 0.8 > s.power_of_t_test(0.05, 0.06, n - 1, 0.05)
        )
        assert n == 24  # d = 0.83: Cohen's tables say 24 to 26

    def test_more_than_anybody_can_run(self):
        assert s.runs_needed(1e-6, 1.0, 0.8, 0.05) is None
        assert s.runs_needed(0.05, 0.0, 0.8, 0.05) == 2

    def test_power_by_simulation(self, rng):
        a, b = rng.normal(0, 0.05, 200), rng.normal(0, 0.05, 200)
        sure = s.simulated_power(rng, a, b, 0.3, 6, 0.05, n_studies=30, n_permutations=199)
        none = s.simulated_power(rng, a, b, 0.0, 6, 0.05, n_studies=200, n_permutations=199)
        three = s.simulated_power(rng, a, b, 0.3, 3, 0.05, n_studies=20, n_permutations=199)
        assert sure == 1
        assert none < 0.1
        assert three == 0  # three against three cannot be told apart at 0.05
