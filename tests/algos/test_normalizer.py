"""Running moments against NumPy's float64, where the digits are easily lost."""

import numpy as np
import pytest
import torch
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.normalizer import BLOCK_NORM, MIN_STD, Normalizer


def fed(batches, size, comm=None):
    stats = Normalizer(size, comm or Communicator())
    for batch in batches:
        stats.update(batch)
    return stats


@pytest.mark.parametrize("offset", [0.0, 1.0, 1e4, 1e8])
def test_moments_of_columns_far_from_zero(offset):
    rows = offset + np.random.default_rng(0).standard_normal((10_000, 3)) * [1.0, 0.1, 30.0]
    stats = fed([rows[:0], *np.array_split(rows, 117), rows[:0]], 3)  # a rank may have none
    np.testing.assert_allclose(stats.mean, rows.mean(axis=0), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(stats.std, rows.std(axis=0), rtol=1e-6 if offset == 1e8 else 1e-9)


def test_constant_columns_do_not_explode():
    stats = fed([np.full((50, 2), [3.0, 1e8]) for _ in range(3)], 2)
    assert (stats.std == MIN_STD).all()
    assert (stats.scaling()(torch.tensor([[3.0, 1e8]])) == 0).all()


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_column_that_explodes_spoils_nothing(kind):
    """Up to the largest float32, beside a calm column; moments as float64 has them."""
    growth = np.logspace(0, 38, 400)
    rows = np.random.default_rng(0).standard_normal((400, 2)) * np.stack([growth, np.ones(400)], 1)
    rows = rows.clip(-3e38, 3e38).astype(kind)
    stats = Normalizer(2, Communicator(), clip=5.0)
    for batch in np.array_split(rows, 37):
        stats.update(batch)
        assert torch.isfinite(stats.scaling()(torch.from_numpy(rows.astype(np.float32)))).all()
    np.testing.assert_allclose(stats.mean, rows.mean(axis=0, dtype=np.float64), rtol=1e-12)
    np.testing.assert_allclose(stats.std, rows.std(axis=0, dtype=np.float64), rtol=1e-12)


def test_clip_and_before_the_first_update():
    stats = Normalizer(2, Communicator(), clip=5.0)
    assert stats.scaling()(torch.tensor([[-1.0, 99.0]])).tolist() == [[-1.0, 5.0]]


def block_of(columns, size=4, clip=np.inf):
    return Normalizer(size, Communicator(), clip, block=np.isin(np.arange(size), columns))


def test_a_block_has_one_gain_by_its_mean_squared_norm():
    """However many columns it has, its norm is that of 24 normalized ones, but for the prior."""
    rng = np.random.default_rng(0)
    for n, rate in ((1, 0.2), (3, 0.05), (111, 0.02)):
        stats, rows = block_of(range(n), n + 1), rng.normal(3.0, 2.0, (20_000, n + 1))
        rows[:, :n] = rng.random((20_000, n)) < rate
        for batch in np.array_split(rows, 7):
            stats.update(batch)
        norm = np.square(rows[:, :n]).sum(axis=1)
        expected = (1000 + norm.sum()) / (1000 + 20_000)
        shown = stats.scaling()(torch.from_numpy(rows.astype(np.float32))).numpy()
        gain = np.sqrt(BLOCK_NORM / expected)
        np.testing.assert_allclose(shown[:, :n], gain * rows[:, :n], rtol=1e-5)
        assert 0.75 < np.square(shown[:, :n]).sum(axis=1).mean() / BLOCK_NORM < 1.1
        assert abs(shown[:, n].mean()) < 1e-5  # others as always


def test_a_gain_never_jumps():
    """Not where nothing has fired for long, nor when something does for the first time."""
    stats, gains = block_of([0, 1], clip=5.0), []
    for epoch in range(60):
        fires = np.zeros((1000, 4))
        fires[: 200 * (epoch >= 30), 0] = 1.0
        stats.update(fires)
        gains.append(stats.scaling()(torch.tensor([[1.0, 0, 0, 0]]))[0, 0].item())
    ratios = np.divide(gains[1:], gains[:-1])
    assert ratios.max() < 1.25
    assert ratios.min() > 0.8
    assert max(gains) <= 5.0
