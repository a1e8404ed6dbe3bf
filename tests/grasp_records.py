"""Grasps that were never played, for tests of what is read from them."""

import numpy as np

from tactilerl.probe.grasps import links_of

ASKED = ["--joint-noise", "0", "--resamples", "200", "--shuffles", "2", "--folds", "2", "--workers=1"]
TOUCHED = ("index", "distal")


def synthetic(hand, touches):
    """Grasps of a hand with its links far apart, whose joints never differ; where `touches`, a cube
    lies on the tip of the index finger, elsewhere far from everything."""
    touches = np.array(touches, bool)
    n, links = len(touches), links_of(hand)
    surface = next(s for s in hand.surfaces if (s.digit, s.segment) == TOUCHED)
    apart = np.column_stack([np.arange(len(links)), np.zeros((len(links), 2))])
    on_tip = apart[links.index(surface.link)] + surface.place(0, 0)[0] + 0.02 * np.array(surface.palmar)
    return {
        "held": touches.copy(),
        "broken": np.zeros(n, bool),
        "joint_positions": np.zeros((n, len(hand.joints))),
        "joint_velocities": np.zeros((n, len(hand.joints))),
        "link_positions": np.tile(apart, (n, 1, 1)),
        "link_rotations": np.tile(np.eye(3), (n, len(links), 1, 1)),
        "object_position": np.where(touches[:, None], on_tip, on_tip + np.array([0, 5.0, 0])),
        "object_orientation": np.tile([1.0, 0, 0, 0], (n, 1)),
        "object_kind": np.zeros(n, int),
        "object_half_size": np.full((n, 3), 0.02),
    }
