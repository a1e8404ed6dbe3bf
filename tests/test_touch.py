"""The overlap rule against distances known by construction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactilerl.envs import layouts, objects, touch


def brute_force_distance(shape, point, n=60):
    """Distance to a box by sampling its surface densely; 0 inside."""
    half = np.array(shape.half_size)
    if (np.abs(point) <= half).all():
        return 0.0
    grid = np.linspace(-1, 1, n)
    best = np.inf
    for axis in range(3):
        a, b = np.meshgrid(grid, grid)
        for side in (-1, 1):
            points = np.empty((n * n, 3))
            points[:, axis] = side
            points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = a.ravel(), b.ravel()
            best = min(best, np.linalg.norm(points * half - point, axis=1).min())
    return best


def test_distance_to_a_box():
    shape = objects.Shape("box", (0.01, 0.02, 0.03))
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 3))
    got = np.sqrt(shape.squared_distance(points))
    np.testing.assert_allclose(got, [brute_force_distance(shape, p) for p in points], atol=6e-4)
    assert shape.squared_distance(np.array([[0.04, 0.0, 0.0]]))[0] == pytest.approx(0.03**2)
    assert shape.squared_distance(np.zeros((1, 3)))[0] == 0.0


def pose(position, rotation):
    return objects.ObjectState(np.array(position), np.full(4, np.nan), np.array(rotation))


def test_overlap_turns_with_object_and_links():
    """Two taxels 1 mm off the edge of a cube turned by 45 degrees, one a little too small."""
    c = np.cos(np.pi / 4)
    turn = np.array([[c, -c, 0], [c, c, 0], [0, 0, 1]])
    cube, thing = objects.cube(0.04), pose([1.0, 2.0, 3.0], turn)
    edge = 0.02 * np.sqrt(2) + 0.001
    # Taxels on two links: one turned by 45 degrees about z, one not, both at the cube's centre.
    on_turned = turn.T @ [edge, 0, 0]
    taxels = layouts.Taxels(
        links=("a", "b"),
        link_index=np.array([0, 0, 1, 1]),
        positions=np.array([on_turned, on_turned, [edge, 0, 0], [edge, 0, 0]]),
        radii=np.array([0.0009, 0.0011, 0.0009, 0.0011]),
        names=("", "", "", ""),
    )
    placement = touch.TaxelPlacement(taxels)
    links = np.tile(thing.position, (2, 1)), np.stack([turn, np.eye(3)])
    np.testing.assert_allclose(placement.world(*links), np.tile([1 + edge, 2, 3], (4, 1)))
    assert placement.overlap(*links, cube, thing).tolist() == [False, True, False, True]
    assert not placement.overlap(*links, cube, pose([1.0, 2.0, 3.0], np.eye(3))).any()


def test_half_height():
    shape = objects.cube(0.05)
    assert shape.half_height(np.eye(3)) == pytest.approx(0.025)
    c = np.cos(np.pi / 4)
    tipped = np.array([[1, 0, 0], [0, c, -c], [0, c, c]])
    assert shape.half_height(tipped) == pytest.approx(0.025 * np.sqrt(2))


@pytest.fixture(params=objects.KINDS)
def solid(request):
    """A shape, and many points of the box around it that lie inside (n, 3)."""
    sizes = {"box": (0.02, 0.04, 0.06), "sphere": (0.04,), "cylinder": (0.04, 0.06)}
    shape = objects.make(request.param, sizes[request.param])
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 3)) * shape.half_size
    return shape, points[shape.squared_distance(points) == 0]


def test_volume_is_that_of_the_points_inside(solid):
    shape, inside = solid
    share = len(inside) / 200_000
    assert share * np.prod(shape.half_size) * 8 == pytest.approx(shape.volume, rel=0.01)


def test_distance_to_a_shape_is_that_to_the_nearest_of_many_points_inside(solid):
    """Up to the gaps between them."""
    shape, inside = solid
    for point in np.random.default_rng(1).uniform(-0.08, 0.08, (20, 3)):
        nearest = np.linalg.norm(inside - point, axis=1).min()
        distance = np.sqrt(shape.squared_distance(point[None])[0])
        assert distance <= nearest + 1e-12
        assert nearest - distance < 3e-3


def test_half_height_is_that_of_the_lowest_point(solid):
    shape, inside = solid
    for turn in Rotation.random(5, rng=2):
        rotation = turn.as_matrix()
        lowest = -(inside @ rotation.T)[:, 2].min()
        assert lowest <= shape.half_height(rotation) + 1e-12
        assert shape.half_height(rotation) - lowest < 3e-3
