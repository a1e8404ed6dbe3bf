"""Layouts: the paper's counts, the geometry of the grids, files and their errors."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from tactilerl.envs import hands, layouts
from tactilerl.pictures.hand_map import LIT, TaxelMap, Unrolled, places

HAND = hands.get("shadow")
COUNTS = {"1": 139, "2": 79, "3": 64, "4": 79, "5": 19, "6": 19}
OTHERS = {"smarthand": 4, "zhang": 13, "abbass": 15}


@pytest.mark.parametrize(("name", "count"), (COUNTS | OTHERS).items())
def test_counts_of_the_paper_and_of_designs_from_the_literature(name, count):
    assert len(layouts.load(name).place(HAND)) == count


def test_a_hand_carries_taxels_on_the_fingers_it_has():
    """Three phalanges on each of four fingers, and three bases of fingers on the palm."""
    hand = hands.get("allegro")
    assert len(hand.fingertips) == 4
    per_phalanx = {"1": 9, "2": 5, "3": 4, "4": 5, "5": 1, "6": 1}
    for name, n in per_phalanx.items():
        taxels = layouts.load(name).place(hand)
        assert len(taxels) == 12 * n + 3
        assert not [name for name in taxels.names if name.startswith("little")]
    little = {"digits": ["little"], "segments": ["distal"], "offsets_mm": [[0, 0]], "radius_mm": 2}
    layout = layouts.parse({"patch": [little]}, "little")
    with pytest.raises(ValueError, match="puts no taxel on the allegro hand"):
        layout.place(hand)


def test_a_layout_that_names_what_a_hand_lacks_is_refused_unless_it_may():
    hand, patch = hands.get("allegro"), {"offsets_mm": [[0, 0]], "radius_mm": 2}
    tips = {"digits": ["index", "little"], "segments": ["distal"], **patch}
    table = {"patch": [tips, {"digits": ["thumb", "ring"], "segments": ["palm"], **patch}]}
    layout = layouts.parse(table, "six")
    found = r"2 of 4 placed: little.distal, thumb.palm are not on this hand; partial = true"
    with pytest.raises(ValueError, match=found):
        layouts.left_out(layout, hand)
    asked = layouts.parse({"partial": True, **table}, "six")
    assert layouts.left_out(asked, hand) == ["little.distal", "thumb.palm"]
    assert layouts.left_out(layouts.load("5"), hand) == []
    assert layouts.parse(tomllib.loads(asked.toml()), "six") == asked
    palm = layouts.parse(
        {"patch": [{"digits": ["palm"], "segments": ["palm"], **patch}]}, Path("palm.toml")
    )
    for known in hands.HANDS:  # whichever fingers its parts belong to
        assert layouts.left_out(palm, hands.get(known)) == []
        assert {
            p.segment for p in hands.get(known).surfaces if palm.patches[0].is_on(p.digit, p.segment)
        } == {"palm"}


def test_taxels_beyond_their_segment_are_named(hand):
    hand = hands.get(hand)
    for known in layouts.names():
        assert layouts.off_skin(layouts.load(known).place(hand), hand) == []
    patch = {"digits": ["index"], "segments": ["distal"], "radius_mm": 2}
    for offset in ([30, 0], [-45, 0]):
        far = layouts.parse({"patch": [{**patch, "offsets_mm": [offset, [0, 0]]}]}, Path("far.toml"))
        taxels = far.place(hand)
        assert layouts.off_skin(taxels, hand) == [taxels.names[0]]
    palm = {"digits": ["index"], "segments": ["palm"], "radius_mm": 2, "offsets_mm": [[0, 45], [0, 0]]}
    taxels = layouts.parse({"patch": [palm]}, Path("beside.toml")).place(hand)
    assert layouts.off_skin(taxels, hand) == [taxels.names[0]]


def test_grids_are_the_papers_figure():
    offsets = {name: set(layouts.PAPER[name].patches[0].offsets) for name in layouts.PAPER}
    assert offsets["2"] | offsets["4"] == offsets["1"]
    assert offsets["2"] & offsets["4"] == offsets["5"] == offsets["6"] == {(0.0, 0.0)}
    assert offsets["3"] == offsets["2"] - {(0.0, 0.0)}


def test_pitches_and_radii_are_the_papers():
    taxels = layouts.load("1").place(HAND)
    at = dict(zip(taxels.names, taxels.positions, strict=True))
    for segment, pitch in (("proximal", 6e-3), ("middle", 3e-3), ("distal", 7.5e-3)):
        up, centre = at[f"index.{segment}[+1,+0]"], at[f"index.{segment}[+0,+0]"]
        assert np.linalg.norm(up - centre) == pytest.approx(pitch)
        side = at[f"index.{segment}[+0,+1]"]
        assert abs(side - centre)[0] == pytest.approx(5e-3)
    assert set(taxels.radii) == {1.5e-3}
    large = layouts.load("6").place(HAND)
    assert sorted(set(large.radii)) == [1.5e-3, 3.5e-3]
    assert sum(large.radii == 1.5e-3) == 4


GOOD = 'digits = ["thumb"]\nsegments = ["distal"]\noffsets_mm = [[0, 0]]\nradius_mm = 2.0\n'


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "at least one"),
        ("colour = 3\n[[patch]]\n" + GOOD, "colour: unknown"),
        ("[[patch]]\n" + GOOD.replace("thumb", "toe"), "found 'toe', allowed: thumb"),
        ("[[patch]]\n" + GOOD.replace("distal", "tip"), "found 'tip', allowed: proximal"),
        ("[[patch]]\n" + GOOD.replace("2.0", "nan"), "radius_mm: found nan"),
        ("[[patch]]\n" + GOOD.replace("[[0, 0]]", "[[0]]"), "offsets_mm: found [0], allowed a list"),
        ("[[patch]]\n" + GOOD.replace('"distal"', ""), "found an empty list of digits or segments"),
        ("[[patch]]\n" + GOOD.replace("[[0, 0]]", "[]"), "needs either offsets_mm or rows"),
        (2 * ("[[patch]]\n" + GOOD), "taxels 1 and 2, thumb.distal[+0,+0 mm]: found the same"),
        ("[[taxel]]\nlink = 3\n", "taxel 1.link: found 3"),
        ("[[taxel]]\nlink = 'a'\nposition = [1e8, 0, 0]\n", "taxel 1.position: found 100000"),
    ],
)
def test_malformed_file_says_what_is_wrong(tmp_path, content, complaint):
    path = tmp_path / "bad.toml"
    path.write_text(content)
    with pytest.raises(ValueError, match="layout") as error:
        layouts.load(str(path)).place(HAND)
    assert complaint in str(error.value)


@pytest.mark.parametrize("name", [*layouts.PAPER, layouts.MODEL])
def test_what_stands_for_a_layout_is_that_layout(name, tmp_path):
    """Not what has its name: files are called anything."""
    assert layouts.load(str(layouts.load(name))) == layouts.load(name)
    own = tmp_path / f"{name}.toml"
    own.write_text("[[patch]]\noffsets_mm = [[0, 0]]\nradius_mm = 2\n")
    assert layouts.load(str(layouts.load(str(own)))).patches == layouts.load(str(own)).patches


def test_taxel_beside_the_phalanx_is_refused(tmp_path):
    path = tmp_path / "wide.toml"
    path.write_text("[[patch]]\n" + GOOD.replace("[0, 0]", "[0, 20]"))
    with pytest.raises(ValueError, match="lies beside the link"):
        layouts.load(str(path)).place(HAND)
    edge = GOOD.replace("distal", "proximal").replace("[0, 0]", "[0, 13]")
    path.write_text("[[patch]]\n" + edge)  # 13 / 1000 is a little more than the radius, 0.013
    layouts.load(str(path)).place(HAND)


def test_unknown_names(in_tmp):
    with pytest.raises(ValueError, match="allowed: 1, 2"):
        layouts.load("7")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        layouts.load("nowhere.toml")
    with pytest.raises(ValueError, match="unknown layout"):
        layouts.load("../layout_files/zhang")


def test_the_map_of_a_hand_lights_the_taxels_that_fire(hand):
    built = hands.get(hand)
    taxels = layouts.load("1").place(built)
    drawn = TaxelMap(built, taxels, 240)
    dark = drawn.picture(np.zeros(len(taxels), bool))
    assert not (dark == LIT).all(axis=-1).any()
    changed = [(drawn.picture(one) != dark).any(axis=-1) for one in np.eye(len(taxels), dtype=bool)]
    alone = np.sum(changed, axis=0) == 1  # neighbours may overlap: they have their true size
    assert all((places & alone).any() for places in changed)  # every taxel is seen


@pytest.mark.parametrize("hand", ["shadow", "mpl", "allegro"])
def test_the_map_of_a_hand_is_what_one_sees_from_the_palmar_side(hand):
    """What is printed is drilled by: right is right where one looks against the normals, tips up."""
    built = hands.get(hand)
    taxels, drawn = layouts.load("1").place(built), Unrolled(built)
    on_map = np.array([drawn.point(place) for place in places(taxels)])
    for index, surface in enumerate(built.surfaces):
        mine = np.flatnonzero(taxels.surfaces == index)
        if surface.segment == "palm" or len(mine) < 9:
            continue
        middle, rows, columns = mine[len(mine) // 2], *taxels.offsets[mine, :2].T
        assert not taxels.offsets[middle].any()
        up = taxels.positions[mine[(rows > 0) & (columns == 0)]][0] - taxels.positions[middle]
        right = np.cross(-taxels.normals[middle], up)
        seen = (taxels.positions[mine] - taxels.positions[middle]) @ right
        found = np.sign((on_map[mine] - on_map[middle]).round(6))
        assert (found == np.sign([seen.round(9), rows]).T).all()
    palm = [i for i in np.argsort(on_map[:, 0]) if "palm" in taxels.names[i]]
    normal, along = taxels.normals[palm[0]], built.surfaces[taxels.surfaces[palm[0]]].along
    from_left = taxels.positions[palm] @ np.cross(-normal, along)
    assert (np.diff(from_left) > 0).all()
