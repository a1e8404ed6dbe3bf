"""Compute the readings of taxels, by the touch rules.

Rule "skin": a taxel is on when its sensing sphere overlaps the object and the skin that
carries it is no further than `SKIN` from the object. A rigid capsule meets a flat face
in one or two contact points, where skin would meet it in a patch; the overlap of a
small sphere on the skin with the object is that patch. The sphere alone would also feel
what is near and touches nothing. Ground and self-contact cannot fire a taxel, and the
rule is the same in every simulator.

Rule "contact" (the paper's) depends on the simulator, whose own sensors feel it.

Rule "force", and a threshold in newtons: a taxel that is on by rule "skin" reads what a
sensor that stands a little proud of the skin would carry if it were the only one. The
object presses on the hand with the sum F of its contacts' forces along the sensor's
normal, at their centre of pressure. To rest on a sensor at the distance d from there it
tips about the far rim of the contacts, at the distance b on the other side; by the
lever the sensor carries F b / (b + d). Skin that gives way by `SKIN` makes a contact
point a patch of the radius `PATCH`, which widens the rim; d counts from the sensor's
edge. No reading depends on another taxel, so those of several do not add up to F.
Against MuJoCo's touch sensors on such sensors, one at a time: docs/concepts/touch.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from operator import itemgetter
from typing import Any

import numpy as np

from .hands import Hand, Surface
from .layouts import Taxels
from .objects import host, namespace
from .simulators import Sensor
from .state import Array, State

SKIN = 5e-4  # m, how thick the skin is: what is further from a link's surface does not touch it
BONE_TOLERANCE = 5e-5  # m, by how much the distance of a bone may be taken too large
PATCH = 3e-3  # m, radius of a contact: (2 R SKIN)^0.5 on a finger of R = 9 mm
EPSILON = 1e-9  # N and m
RELEASE = 0.8  # of its threshold: the force below which a taxel that fires stops


class LinkPoints:
    """Points that ride on links; where they are follows from the links' poses in one product.

    Row i of the blocks (n, 4k) holds point i's homogeneous coordinates in the four
    columns of its link; the poses stack to (..., 4k, 3).
    """

    def __init__(
        self, links: tuple[str, ...], link_index: Array, points: Array
    ) -> None:
        """Take `points` (n, 3), m, each in the frame of the link with its `link_index` (n,)."""
        n, k = len(points), len(links)
        blocks = np.zeros((n, k, 4))
        blocks[np.arange(n), link_index, :3] = points
        blocks[np.arange(n), link_index, 3] = 1.0
        self.links = links
        self._blocks = blocks.reshape(n, 4 * k)

    def world(self, state: State) -> Array:
        """Return the points in the world's frame, (..., n, 3), m."""
        return self._blocks @ _stacked(*state.poses(self.links))

    def local(self, state: State) -> Array:
        """Return the points in the object's frame, (..., n, 3), m."""
        positions, rotations = state.poses(self.links)
        from_object = _stacked(
            positions - state.object_position[..., None, :], rotations
        )
        return self._blocks @ (from_object @ state.object_rotation)


def _stacked(positions: Array, rotations: Array) -> Array:
    """Return poses (..., k, 3), (..., k, 3, 3) as the factor (..., 4k, 3) of `LinkPoints`."""
    poses = [rotations.swapaxes(-1, -2), positions[..., None, :]]
    stacked: Array = namespace(positions).concatenate(poses, axis=-2)
    return stacked.reshape(*stacked.shape[:-3], -1, 3)


def taxel_points(taxels: Taxels) -> LinkPoints:
    """Return the centres of taxels."""
    return LinkPoints(taxels.links, taxels.link_index, taxels.positions)


def sensors(taxels: Taxels) -> tuple[Sensor, ...]:
    """Return the sensors that a simulator must have for rules that read them."""
    links = (taxels.links[link] for link in taxels.link_index)
    return tuple(map(Sensor, links, taxels.positions, taxels.radii.tolist()))


class Rule(ABC):
    """A touch rule for the taxels of one layout on one hand."""

    is_boolean: bool = True
    """True if the readings are 0 or 1."""
    by_sensors: bool = False
    """True if the rule reads sensors that the simulator has where the taxels are."""
    is_batched: bool = False
    """True if this very class reads states of many scenes, PyTorch's, too
    (`batch.BatchEnv`)."""

    @abstractmethod
    def __init__(self, taxels: Taxels, hand: Hand) -> None:
        """Prepare the rule for these taxels on this hand."""

    def reset(self) -> None:
        """Forget the last episode."""

    @abstractmethod
    def read(self, state: State) -> Array:
        """Return the readings of the taxels, (..., n_taxels)."""


class SkinTouch(Rule):
    """Rule "skin" for the taxels of one layout on one hand. It remembers no reading.

    A taxel is on when its sphere overlaps the object and one of some points is near
    enough to it: the points of its skin. The skin of a phalanx is a capsule around its
    bone, so it is within `SKIN` of the object when one of many points along the bone is
    within radius + `SKIN`. The skin of a taxel on a flat palm is the disc in which its
    sphere meets the plane; what lies above that and up to `SKIN` from it is the cap of
    a larger sphere, whose centre is the only point. Of any other link, the skin of a
    taxel is the geom that is nearest to it, whose distance MuJoCo computes.
    """

    is_batched = True

    def __init__(self, taxels: Taxels, hand: Hand) -> None:
        """Find the points of each taxel's skin, of which those on one phalanx share all."""
        surfaces = [hand.surfaces[index] for index in taxels.surfaces]
        self._shaped = _Shaped(taxels, surfaces)
        own = np.column_stack([taxels.link_index, taxels.positions, taxels.radii])
        rows = [
            np.array([(row[0], *point, reach) for point in points])
            for row, surface, normal in zip(own, surfaces, taxels.normals, strict=True)
            for points, reach in [_skin(surface, row[1:4], normal, row[4])]
        ]
        longest = np.arange(max(map(len, rows)))
        skins = [skin[np.minimum(longest, len(skin) - 1)] for skin in rows]
        both = np.concatenate([own[:, None], skins], axis=1)  # a taxel, then its skin
        points, index = np.unique(both.reshape(-1, 5), axis=0, return_inverse=True)
        self._index = index.reshape(both.shape[:2]).T
        self._points = LinkPoints(
            taxels.links, points[:, 0].astype(int), points[:, 1:4]
        )
        self._squared_reaches = points[:, 4] ** 2

    def read(self, state: State) -> Array:
        """Return which taxels are on, bool (..., n_taxels)."""
        distances = state.shape.squared_distance(self._points.local(state))
        is_near = (distances <= self._squared_reaches)[..., self._index]
        is_on: Array = is_near[..., 0, :] & is_near[..., 1:, :].any(-2)
        self._shaped.correct(is_on, state)
        return is_on


class _Shaped:
    """The taxels whose links are neither one capsule nor flat."""

    def __init__(self, taxels: Taxels, surfaces: list[Surface]) -> None:
        """Find the geom of its link that is nearest to each taxel."""
        from .hands.geometry import Distances  # imports MuJoCo

        self._distances: dict[str, Distances] = {}
        self._taxels_of_geom: dict[tuple[str, int], list[int]] = {}
        for taxel, surface in enumerate(surfaces):
            link = surface.link
            if not surface.geoms:
                continue
            if link not in self._distances:
                self._distances[link] = Distances(surface.geoms)
            geom, _ = self._distances[link].nearest(taxels.positions[taxel])
            self._taxels_of_geom.setdefault((link, geom), []).append(taxel)

    def correct(self, is_on: Array, state: State) -> None:
        """Turn off in `is_on` (..., n) the taxels on geoms that do not touch the object."""
        if not self._taxels_of_geom:
            return
        now, is_many = host(is_on), is_on.ndim > 1
        state = state.map(host) if is_many else state
        for index in map(tuple, np.argwhere(now.any(-1))):
            on, one = now[index], state.map(itemgetter(index)) if is_many else state
            item = one.shape, one.object_position, one.object_rotation
            for (link, geom), taxels in self._taxels_of_geom.items():
                positions, rotations = one.poses((link,))
                away = self._distances[link]
                if on[taxels].any() and not away.within(
                    geom, positions[0], rotations[0], *item, SKIN
                ):
                    on[taxels] = False
        if is_many:
            is_on[:] = namespace(is_on).asarray(now)


def _skin(
    surface: Surface, position: Array, normal: Array, radius: float
) -> tuple[Array, float]:
    """Return points (m, 3) of a taxel's skin, and how near the object must be to one of them.

    From a convex body at least `radius` away, the distance of a line along a bone grows
    by no more than s² / (2 radius) within s of where it is least.
    """
    if surface.geoms:  # `_Shaped` looks closer
        return position[None], radius
    if surface.bone is None:  # a cap that stands `SKIN` proud of a disc
        sphere = (radius**2 + SKIN**2) / (2 * SKIN)
        return (position - (sphere - SKIN) * normal)[None], sphere
    begin, end = np.array(surface.bone)
    spacing = 2 * math.sqrt(2 * surface.radius * BONE_TOLERANCE)
    shares = np.linspace(0.0, 1.0, math.ceil(np.linalg.norm(end - begin) / spacing) + 1)
    return begin + shares[:, None] * (end - begin), surface.radius + SKIN


class ContactRule(Rule):
    """Rule "contact": Boolean, by what the simulator calls a contact."""

    by_sensors = True

    def __init__(self, taxels: Taxels, hand: Hand) -> None:
        """Do nothing: the simulator has a sensor for each taxel."""

    def read(self, state: State) -> Array:
        """Return which sensors feel a contact, bool (n_taxels,)."""
        return state.sensors


class ForceRule(SkinTouch):
    """Rule "force": the normal force that each taxel alone would carry, N."""

    is_boolean, is_batched = False, True

    def __init__(self, taxels: Taxels, hand: Hand) -> None:
        """Prepare the rule "skin" and the taxels' centres."""
        super().__init__(taxels, hand)
        self._centres, self._link = taxel_points(taxels), taxels.link_index
        self._normals, self._radii = taxels.normals[:, :, None], taxels.radii

    def read(self, state: State) -> Array:
        """Return the force on each taxel, N (..., n_taxels)."""
        is_on, forces = self.feel(state)
        return is_on * forces

    def feel(self, state: State) -> tuple[Array, Array]:
        """Return which taxels are on by rule "skin", bool (..., n), and the force on each, N (..., n).

        A taxel with a threshold fires where it is on and carries as much.
        """
        is_on, (points, _, pushes, outward) = super().read(state), state.contacts
        if not (is_on.any() and pushes.shape[-1]):
            return is_on, is_on * 0.0
        xp, (_, rotations) = namespace(is_on), state.poses(self._centres.links)
        normals = (rotations[..., self._link, :, :] @ self._normals)[..., 0]
        along = (normals @ outward.swapaxes(-1, -2)).clip(0.0)
        pressing = (
            along * pushes[..., None, :]
        )  # (..., n, k), N along the normals of taxels
        totals = pressing.sum(-1)
        middles = pressing @ points / totals.clip(EPSILON)[..., None]
        offsets = self._centres.world(state) - middles
        distances = xp.linalg.norm(offsets, axis=-1)
        ways = offsets / distances.clip(EPSILON)[..., None]
        away = middles[..., None, :] - points[..., None, :, :]
        beyond = xp.einsum("...ni,...nki->...nk", ways, away)
        rims = PATCH + xp.amax((beyond * (along > 0)).clip(0.0), axis=-1)
        arms = (distances - self._radii).clip(0.0)
        return is_on, totals * rims / (rims + arms)


class ThresholdTouch(ForceRule):
    """Rule "skin" for sensors that fire from a force up, and stop below another."""

    is_boolean, is_batched = True, True
    _fires: Any

    def __init__(
        self, taxels: Taxels, hand: Hand, thresholds: Array, releases: Array
    ) -> None:
        """Take the forces (n,) in N at which each taxel begins to fire, and below which it stops."""
        super().__init__(taxels, hand)
        self._thresholds, self._releases = thresholds, releases
        self.reset()

    def reset(self) -> None:
        """Forget which taxels fired."""
        self._fires = False

    def read(self, state: State) -> Array:
        """Return which taxels fire, bool (..., n); a second call at the same moment changes nothing."""
        is_on, forces = self.feel(state)
        held = is_on & self._fires
        self._fires = is_on & (
            forces >= namespace(is_on).where(held, self._releases, self._thresholds)
        )
        return self._fires


RULES: dict[str, type[Rule]] = {
    "skin": SkinTouch,
    "contact": ContactRule,
    "force": ForceRule,
}


def make(
    rule: str,
    taxels: Taxels,
    hand: Hand,
    threshold: float | None = None,
    release: float | None = None,
    spread: Array | float = 1.0,
) -> Rule:
    """Return the rule of a name for some taxels.

    They fire from `threshold` N up (None: from their own) and stop below `release` N
    (None: `RELEASE` of the threshold), both times `spread` (n,). Raise ValueError for a
    threshold with a rule that reads no force of its own.
    """
    thresholds = taxels.thresholds
    if threshold is not None:
        thresholds = np.full(len(taxels), threshold)
    if not thresholds.any():
        if np.any(spread != 1.0):
            raise ValueError(
                "taxel_threshold_spread: found without a threshold, which it spreads"
            )
        return RULES[rule](taxels, hand)
    if rule != "skin":
        raise ValueError(f"touch_rule: found {rule} with a threshold, allowed skin")
    releases = (
        RELEASE * thresholds if release is None else np.full(len(taxels), release)
    )
    return ThresholdTouch(taxels, hand, spread * thresholds, spread * releases)
