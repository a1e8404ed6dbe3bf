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
from .objects import ObjectState, Shape


class TaxelPlacement:
    """Positions of taxels from the poses of their links, in one matrix product.

    Row i of `blocks` (n, 4k) holds taxel i's homogeneous coordinates in the four columns of
    its link; the poses stack to (4k, 3).
    """

    def __init__(self, taxels: Taxels) -> None:
        n, k = len(taxels), len(taxels.links)
        blocks = np.zeros((n, k, 4))
        blocks[np.arange(n), taxels.link_index, :3] = taxels.positions
        blocks[np.arange(n), taxels.link_index, 3] = 1.0
        self.links = taxels.links
        self._blocks = blocks.reshape(n, 4 * k)
        self._poses = np.empty((k, 4, 3))
        self._squared_radii = taxels.radii**2

    def world(self, link_positions: Array, link_rotations: Array) -> Array:
        """(n, 3), m, from poses of ``links``: (k, 3) and (k, 3, 3)."""
        self._poses[:, :3] = link_rotations.transpose(0, 2, 1)
        self._poses[:, 3] = link_positions
        return self._blocks @ self._poses.reshape(-1, 3)

    def overlap(
        self, link_positions: Array, link_rotations: Array, shape: Shape, thing: ObjectState
    ) -> Array:
        """Which taxels' spheres overlap the object: bool (n,)."""
        self._poses[:, :3] = link_rotations.transpose(0, 2, 1)
        np.subtract(link_positions, thing.position, out=self._poses[:, 3])
        local = self._blocks @ (self._poses.reshape(-1, 3) @ thing.rotation)
        return shape.squared_distance(local) <= self._squared_radii
