"""Taxels as places, and the skin of a whole hand."""

import numpy as np
import pytest
from tactilerl.envs import hands, layouts
from tactilerl.pictures import hand_map
from tactilerl.placement import candidates

ALL = ["mpl", *(pytest.param(hand, marks=pytest.mark.slow) for hand in ("shadow", "allegro"))]


@pytest.mark.parametrize("hand", ALL)
class TestPlaces:
    def test_a_layout_written_from_its_places_is_the_same_layout(self, hand, tmp_path):
        hand = hands.get(hand)
        for name in ("1", "6", "4mm"):
            placed = candidates.skin(name, hand)
            spots = hand_map.places(placed)
            file = tmp_path / "layout.toml"
            file.write_text(layouts.of_taxels(placed, hand, 'a "name"').toml())
            again = layouts.load(str(file)).place(hand)
            assert sorted(hand_map.places(again)) == sorted(spots)
            assert len(set(spots)) == len(placed)
            order = [hand_map.places(again).index(spot) for spot in spots]
            assert np.allclose(again.positions[order], placed.positions, atol=2e-7)

    def test_the_skin_reaches_as_far_as_the_papers_layouts(self, hand):
        """Over the round fingertips too: no taxel of layout 1 is far out beyond the skin."""
        built = hands.get(hand)
        skin = hand_map.places(candidates.skin("1mm", built))
        for place in hand_map.places(layouts.load("1").place(built)):
            beside = [other for other in skin if other.surface == place.surface]
            assert min(np.hypot(o.row - place.row, o.column - place.column) for o in beside) < 2.5
