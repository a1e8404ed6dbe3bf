"""What a study says of its comparisons, in sentences and numbers."""

import numpy as np
import pytest
from tactilerl.study import analysis, records, report
from tactilerl.study.grid import Contrast, Run, Setup


class TestAnswers:
    grid, contrast = {"layout": [1, 2], "touch": ["on", "off"]}, Contrast("touch", "on", "off")
    setup = Setup("one", {}, grid, [*range(12)], contrast, "success_rate")

    def said(self, gap, p_holm, n=9, score="area"):
        difference = analysis.Estimate(*gap)
        pairs = analysis.Pairs([*range(n)], np.ones(n), np.zeros(n), difference, p_holm, p_holm)
        return report.answer(self.setup, "layout 2", pairs, score)

    @pytest.mark.parametrize(
        ("gap", "p", "n", "words"),
        [
            ((0.1, 0.02, 0.2), 0.02, 9, "touch raised mean success (touch − no touch: +0.10, 95 %"),
            ((-0.1, -0.2, 0.01), 0.04, 9, "touch lowered mean success (touch − no touch: −0.10, 95 %"),
            ((0.1, -0.02, 0.2), 0.2, 9, "no significant difference in mean success"),
            ((0.1, -0.02, 0.2), 0.2, 6, "too few runs to find a difference, which takes 7 pairs"),
        ],
    )
    def test_each_kind_of_answer(self, gap, p, n, words):
        said = self.said(gap, p, n)
        assert said.startswith(f"one, layout 2: {words}")
        assert said.endswith(f"p = {p:.3f}, {n} of 12 pairs).")

    def test_a_bound_below_zero_keeps_its_sign(self):
        assert "−0.02 to +0.20, p < 0.001" in self.said((0.1, -0.02, 0.2), 1e-4, score="last")


class TestCommonRange:
    """Runs that are compared are scored over the steps that all of them have."""

    def record(self, steps, rates, seed=0):
        run = Run(f"r{seed}", "one", "all", "on", seed, "success_rate", {})
        points = zip(steps, rates, strict=True)
        rows = [dict(zip(("env_steps", "success_rate"), point, strict=True)) for point in points]
        return records.Record(run, "done", "", {}, rows)

    def test_it_begins_and_ends_where_all_have_a_rate(self):
        long = self.record([0, 10, 20, 30, 40], [0, 0, 0.5, 1, 1])
        short = self.record([5, 15, 25], [0.2, 0.4, 0.6])
        assert analysis.span([long, short]) == (5, 25)
        ((area,), (other,)) = (list(x.values()) for x in analysis.scored("area", [long], [short]))
        # From 5 to 25: 0 up to 10, then up to 0.5 at 20, and 0.75 at 25.
        assert area == pytest.approx((0 + 0.25 * 10 + 0.625 * 5) / 20)
        assert other == pytest.approx(0.4)

    def test_what_comes_after_does_not_count(self):
        steps = np.arange(0, 50, 10)
        same = [self.record(steps, [0.1, 0.2, 0.4, 0.6, last], 1) for last in (0.0, 1.0)]
        short = self.record(steps[:4], [0.1, 0.2, 0.4, 0.6], 2)
        for score in ("area", "last", "converged"):
            a, b = (analysis.scored(score, [one], [short]) for one in same)
            assert a[0][1] == b[0][1] == a[1][2]

    def test_runs_without_a_common_step_are_taken_at_their_ends(self):
        one, other = self.record([10], [0.3]), self.record([20], [0.6], 1)
        assert analysis.scored("area", [one], [other]) == [{0: 0.3}, {1: 0.6}]
