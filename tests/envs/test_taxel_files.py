"""Files of points: what they mean, and that a broken one is one line."""

import math
from pathlib import Path

import numpy as np
import pytest
from tactilerl.envs import hands, layouts, taxel_files
from tactilerl.envs.hands import Point

GRIPPER = str(Path(__file__).parents[1] / "hands" / "gripper.toml")
COLUMNS = "link", "x", "y", "z", "nx", "ny", "nz", "radius", "name"
ROW = ("left_2", (0.0, 0.001, -0.02), (-0.8, 0.0, 0.6), 0.0015, "one")
POINTS = [Point(*ROW), Point(*ROW)._replace(position=(0.0, 0.001, -0.015), name="two")]


def csv_of(points):
    """Points as people write them, with a blank after every comma."""
    rows = ((p.link, *p.position, *p.normal, p.radius, p.name) for p in points)
    return "\n".join([", ".join(COLUMNS), *(", ".join(map(str, row)) for row in rows), ""])


def test_a_csv_is_read_as_it_is_written(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text(csv_of(POINTS))
    assert taxel_files.read(path) == tuple(POINTS)


@pytest.mark.parametrize("name", [GRIPPER, "shadow"])
def test_what_has_no_normal_has_that_of_the_nearest_skin(name):
    """Of a shape of any kind, of a capsule and of a flat palm."""
    hand = hands.get(name)
    taxels = layouts.load("4").place(hand)
    bare = tuple(point._replace(normal=()) for point in taxels.points)
    again = layouts.Layout("own", "", (), bare).place(hand)
    cosines = np.einsum("nj,nj->n", taxels.normals, again.normals)
    assert cosines.min() > math.cos(math.radians(5))


def test_a_csv_may_have_further_columns_and_no_normals_or_long_ones(tmp_path):
    """As people publish them: an id, blanks where a normal is not known, normals of any length."""
    path = tmp_path / "own.csv"
    path.write_text("id,link,x,y,z,nx,ny,nz\n0,a,0,0.001,-0.02,,,\n1,a,0,0,-0.02,0,0,250\n")
    bare, long = taxel_files.read(path)
    assert (bare.normal, long.normal) == ((), (0.0, 0.0, 1.0))
    path.write_text("link,x,y,z,threshold_N\na,0,0,0,0.3\n")
    assert taxel_files.read(path)[0].threshold_N == 0.3
    path.write_text("link,x,y,z\na,0,0.001,-0.02\n")
    assert taxel_files.read(path)[0].radius == taxel_files.RADIUS


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("link,x,y,z,radius\na,-6,-3,0,1.5\n", "taxel 1.position: found -6.0, allowed [-1, 1]"),
        (
            "link,x,y\na,0,0\n",
            "line 2: found {'link': 'a', 'x': '0', 'y': '0'}, expected numbers as x, y",
        ),
        ("link,x,y,z\na,0,001,0,002\n", "line 2: found more cells than columns"),
        ("x,y,z\n0,0,0\n", "taxel 1.link: missing, allowed a string"),
        (
            "link,x,y,z,radius_mm\na,0,0,0,2\n",
            "column: found 'radius_mm', allowed 'radius' (lengths in m)",
        ),
        (
            "link,x,y,z,ny,nz\na,0,0,0,0,1\n",
            "expected numbers as x, y, z and, where they are known, nx",
        ),
    ],
)
def test_what_a_file_of_another_form_should_have_is_said(tmp_path, content, complaint):
    path = tmp_path / "p.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"taxel file .*p\.") as error:
        taxel_files.read(path)
    assert complaint in str(error.value)


def test_a_layout_without_normals_is_written_and_read_again(in_tmp):
    bare = layouts.Layout("own", "", (), tuple(point._replace(normal=()) for point in POINTS))
    Path("own.toml").write_text(bare.toml())
    assert layouts.load("own.toml").taxels == bare.taxels


HEADING = ",".join(COLUMNS)
WRONG = [
    "", "a,b", HEADING, f"{HEADING}\na,1,2", f"{HEADING}\na,0,0,0,0,0,0,.002",
    f"{HEADING}\na,0,0,0,0,0,1,9", csv_of(POINTS[:1]).replace("0.", "nan"),
]  # fmt: skip


@pytest.mark.parametrize("content", WRONG)
def test_a_wrong_file_is_one_line(tmp_path, content):
    path = tmp_path / "points.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"taxel file .*points") as error:
        taxel_files.read(path)
    assert "\n" not in str(error.value)
