"""BCa, whose coverage `python -m benchmarks coverage` compares with that of other intervals."""

import numpy as np
import pytest
from benchmarks.studies.coverage import bca_interval
from numpy.testing import assert_allclose
from scipy import stats
from tactilerl import statistics


def test_bca_is_scipys(rng):
    scores = rng.beta(0.5, 0.2, 12)
    ours = bca_interval(scores, "mean", statistics.resample(rng, 12, 20_000))
    theirs = stats.bootstrap((scores,), np.mean, method="BCa", n_resamples=20_000, rng=rng)
    assert_allclose(ours, theirs.confidence_interval, atol=0.01)


@pytest.mark.parametrize("scores", [[0.4], [0.4, 0.4, 0.4]])
def test_runs_alike_have_no_bca(rng, scores):
    counts = statistics.resample(rng, len(scores), 100)
    assert np.isnan(bca_interval(np.array(scores), "iqm", counts)).all()
