"""The overlap rule against distances known by construction."""

import numpy as np
import pytest

from tactilerl.envs import objects, touch


def brute_force_distance(shape, point, n=60):
    """Distance to a box by sampling its surface densely."""
    half = np.array(shape.half_size)
    grid = np.linspace(-1, 1, n)
    best = np.inf
    for axis in range(3):
        a, b = np.meshgrid(grid, grid)
        for side in (-1, 1):
            points = np.empty((n * n, 3))
            points[:, axis] = side
            points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = a.ravel(), b.ravel()
            best = min(best, np.linalg.norm(points * half - point, axis=1).min())
    return best if (np.abs(point) > half).any() else -best


def test_signed_distance_of_a_box():
    shape = objects.Shape("box", (0.01, 0.02, 0.03))
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.05, 0.05, (200, 3))
    got = shape.signed_distance(points)
    reference = [brute_force_distance(shape, point) for point in points]
    np.testing.assert_allclose(got, reference, atol=6e-4)
    assert shape.signed_distance(np.array([[0.04, 0.0, 0.0]]))[0] == pytest.approx(0.03)
    assert shape.signed_distance(np.zeros((1, 3)))[0] == pytest.approx(-0.01)


def test_overlap_turns_with_the_object():
    shape = objects.cube(0.04)
    c, s = np.cos(np.pi / 4), np.sin(np.pi / 4)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    position = np.array([1.0, 2.0, 3.0])
    corner = position + np.array([0.02 * np.sqrt(2) + 0.001, 0, 0])  # 1 mm off the edge
    radii = np.array([0.0009, 0.0011])
    points = np.stack([corner, corner])
    assert touch.overlap(points, radii, shape, position, turned).tolist() == [False, True]
    assert not touch.overlap(points, radii, shape, position, np.eye(3)).any()


def test_half_height():
    shape = objects.cube(0.05)
    assert shape.half_height(np.eye(3)) == pytest.approx(0.025)
    c = np.cos(np.pi / 4)
    tipped = np.array([[1, 0, 0], [0, c, -c], [0, c, c]])
    assert shape.half_height(tipped) == pytest.approx(0.025 * np.sqrt(2))
