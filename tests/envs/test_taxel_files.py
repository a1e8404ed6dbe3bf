"""Files of other projects: what they mean, and that a broken one is one line."""

import math
from pathlib import Path

import numpy as np
import pytest
from tactilerl.envs import hands, layouts, taxel_files
from tactilerl.envs.hands import Point

GRIPPER = str(Path(__file__).parents[1] / "hands" / "gripper.toml")
PROBE = '[{"link_name": "a", "probes": [{"pos": [%s, 0, 0], "normal": [1, 0, 0], "radius": %s}]}]'
COLUMNS = "link", "x", "y", "z", "nx", "ny", "nz", "radius", "name"
ROW = ("left_2", (0.0, 0.001, -0.02), (-0.8, 0.0, 0.6), 0.0015, "one")
POINTS = [Point(*ROW), Point(*ROW)._replace(position=(0.0, 0.001, -0.015), name="two")]


def csv_of(points, heading="link, x, y, z, nx, ny, nz, radius, name"):
    """Points as people write them, with a blank after every comma; without the column of links where
    the heading has none."""
    rows = ((p.link, *p.position, *p.normal, p.radius, p.name) for p in points)
    skipped = not heading.startswith("link")
    lines = (", ".join(map(str, row[skipped:])) for row in rows)
    return "\n".join([heading, *lines, ""])


def test_the_same_sensor_twice_on_a_link(tmp_path):
    heading = "x, y, z, nx, ny, nz, radius, name"
    (tmp_path / "pad.csv").write_text(csv_of(POINTS[:2], heading))
    sensor = "[[sensor]]\nfile = 'pad.csv'\nlinks = ['left_2']\nposition = [0, 0, {}]\n"
    (tmp_path / "two.toml").write_text(sensor.format(0) + sensor.format(0.01))
    names = [point.name for point in layouts.load(str(tmp_path / "two.toml")).taxels]
    assert names == [f"left_2.pad[{n}]" for n in (1, 2, 3, 4)]


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
    path.write_text("id,x,y,z,nx,ny,nz\n0,0,0.001,-0.02,,,\n1,0,0,-0.02,0,0,250\n")
    bare, long = taxel_files.read(path, "left_2")
    assert (bare.normal, long.normal) == ((), (0.0, 0.0, 1.0))
    path.write_text("x,y,z\n0,0.001,-0.02\n")
    assert taxel_files.read(path, "left_2")[0].radius == taxel_files.RADIUS


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("p.csv", "x,y,z,radius\n-6,-3,0,1.5\n", "taxel 1.position: found -6.0, allowed [-1, 1]"),
        ("p.csv", "x,y\n0,0\n", "line 2: KeyError: 'z'; found"),
        ("p.json", '{"taxels": []}', 'expected [{"link_name": NAME, "probes":'),
    ],
)
def test_what_a_file_of_another_form_should_have_is_said(tmp_path, name, content, complaint):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=r"taxel file .*p\.") as error:
        taxel_files.read(tmp_path / name, "left_2")
    assert complaint in str(error.value)


def test_a_layout_without_normals_is_written_and_read_again(in_tmp):
    bare = layouts.Layout("own", "", (), tuple(point._replace(normal=()) for point in POINTS))
    Path("own.toml").write_text(bare.toml())
    assert layouts.load("own.toml").taxels == bare.taxels


WRONG = {
    ".json": ["[]", "{}", "[1]", PROBE % ("NaN", 0.002), PROBE % (0, 0), PROBE % ("1e999", 0.002)],
    ".csv": ["", "a,b", ",".join(COLUMNS),
             *(f"{','.join(COLUMNS)}\n{rows}" for rows in (
                 "a,1,2", "a,0,0,0,0,0,0,.002", "a,0,0,0,0,0,1,9")),
             csv_of(POINTS[:1]).replace("0.", "nan")],
}  # fmt: skip


@pytest.mark.parametrize("suffix", WRONG)
def test_a_wrong_file_is_one_line(tmp_path, suffix):
    path = tmp_path / f"points{suffix}"
    for content in WRONG[suffix]:
        path.write_text(content)
        with pytest.raises(ValueError, match=r"taxel file .*points") as error:
            taxel_files.read(path, "left_2")
        assert "\n" not in str(error.value), content
