"""Test the statistics of the study of set-ups on scores whose answer is known."""

import numpy as np
import pytest
from benchmarks.studies import setups_study

RNG = np.random.default_rng(0)
HANDS = ["mpl", "shadow", "allegro"]


def noise(*shape):
    return 0.1 * RNG.standard_normal(shape)


def test_an_order_that_all_hands_share_is_found_and_predicted():
    layouts = np.array([0.0, 1.0, 2.0, 3.0])
    values = np.array([layouts] * 6)
    w, p = setups_study.concordance(values, HANDS * 2)
    assert w == pytest.approx(1.0)
    assert p == pytest.approx(1 / 24**2, rel=0.3)  # the other hands' orders have to match the first
    correlation, p, p_shared = setups_study.prediction(values, values, HANDS * 2)
    assert (correlation, p, p_shared) == pytest.approx((1.0, 2 / 24**3, 2 / 24))
    against, p, _ = setups_study.prediction(-values, values, HANDS * 2)
    assert (against, p) == pytest.approx((-1.0, 2 / 24**3))


def test_layouts_that_differ_alike_have_no_interaction():
    layouts = np.array([0.0, 0.2, 0.1, 0.3])[:, None]
    alike = [layouts + noise(1, seeds) + noise(4, seeds) for seeds in (10, 10, 5)]
    assert setups_study.interaction(alike) > 0.05
    assert setups_study.interaction([*alike[1:], layouts[::-1] + noise(4, 10)]) < 0.001


@pytest.mark.parametrize(("ahead", "answer"), [(0.1, "yes"), (-0.3, "no"), (-0.05, "cannot tell")])
def test_chosen_taxels_are_enough_or_not(ahead, answer):
    one = ahead + noise(3, 10)
    at_least, is_within = setups_study.compared([one, one, one])
    assert is_within == answer
    assert at_least < ahead + 0.1
    (first, *_) = setups_study.over_setups([one])
    assert first.value == pytest.approx(one[0].mean())
