"""From geometry to Boolean taxel readings.

Rule "overlap": a taxel is on when its sensing sphere overlaps the object. A rigid capsule
meets a flat face in one or two contact points, where skin would meet it in a patch; the
overlap of a small sphere on the skin with the object is that patch. Ground and self-contact
cannot fire it, and it is the same rule in every simulator.

Rule "contact" (the paper's) depends on the simulator and lives there.
"""

from __future__ import annotations

import numpy as np

from .hands import Array
from .layouts import Taxels
from .objects import Shape


def taxel_positions(taxels: Taxels, link_positions: Array, link_rotations: Array) -> Array:
    """World positions (n, 3) of taxels from poses of ``taxels.links``: (k, 3) and (k, 3, 3)."""
    rotations = link_rotations[taxels.link_index]
    offsets = np.matmul(rotations, taxels.positions[:, :, None])[:, :, 0]
    return link_positions[taxels.link_index] + offsets


def overlap(points: Array, radii: Array, shape: Shape, position: Array, rotation: Array) -> Array:
    """Which spheres overlap the object: bool (n,).

    `points` (n, 3) and `radii` (n,) in m, world frame; `position` (3,) and `rotation` (3, 3)
    are the object's pose.
    """
    local = (points - position) @ rotation
    return shape.signed_distance(local) <= radii
