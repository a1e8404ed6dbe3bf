"""Geometry of links: their shapes, their skin, their distance from an object, and where they are.

A mesh counts as its convex hull, which is what the simulators collide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from ..objects import KINDS as OBJECT_KINDS
from ..objects import Shape
from ..state import Array

BEYOND_ANY_HAND = 0.5  # m: beyond any hand
STEP = 1e-4  # m, of differences
MESH = "mesh"
KINDS = {
    kind: getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    for kind in ("sphere", "capsule", "ellipsoid", "cylinder", "box", MESH)
}


class Geom(NamedTuple):
    """One shape of a link, in the link's frame."""

    kind: str
    """One of KINDS."""
    size: tuple[float, ...]
    """The three numbers of MuJoCo's `size`, m."""
    position: tuple[float, ...]
    """(3,), m."""
    quaternion: tuple[float, ...]
    """(4,), wxyz."""
    corners: tuple[tuple[float, ...], ...]
    """Corners of a mesh's convex hull, or of the box around another shape, in the
    geom's frame, m."""

    @property
    def turn(self) -> Rotation:
        """Rotation of the geom in its link."""
        return Rotation.from_quat(self.quaternion, scalar_first=True)

    @property
    def points(self) -> Array:
        """Corners (n, 3) in the link's frame, m."""
        return self.position + self.turn.apply(self.corners)


def geoms_of(model: mujoco.MjModel, link: str) -> tuple[Geom, ...]:
    """Return the shapes of a body that collide."""
    shapes = []
    for geom in colliding(model, link):
        kind = mujoco.mjtGeom(geom.type[0]).name.removeprefix("mjGEOM_").lower()
        corners = list(product((-1, 1), repeat=3)) * model.geom_aabb[geom.id, 3:]
        if kind == MESH:
            corners = mesh_points(model, geom.dataid[0])
            with suppress(QhullError):  # it is flat
                corners = corners[ConvexHull(corners).vertices]
        size, place, turn, points = (
            values.tolist() for values in (geom.size, geom.pos, geom.quat, corners)
        )
        shapes.append(
            Geom(
                kind, tuple(size), tuple(place), tuple(turn), tuple(map(tuple, points))
            )
        )
    return tuple(shapes)


def mesh_points(model: mujoco.MjModel, mesh: int) -> Array:
    """Return the vertices (n, 3) of a mesh, m."""
    first, n = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return model.mesh_vert[first : first + n].astype(float)


def colliding(model: mujoco.MjModel, body: int | str) -> list[Any]:
    """Return the geoms of a body that collide, as MuJoCo's views of them."""
    number = model.body(body).id
    geoms = map(model.geom, np.flatnonzero(model.geom_bodyid == number).tolist())
    return [geom for geom in geoms if geom.contype[0] or geom.conaffinity[0]]


def meet(
    geoms: tuple[Geom, ...], above: Array, direction: Array
) -> tuple[Array, Array] | None:
    """Return where a ray from outside meets the geoms, and the outward normal there, each (3,).

    The ray goes through `above` (3,) along `direction` (3,). None where it misses them.
    """
    normal, group = np.zeros(3), np.array([1, 0, 0, 0, 0, 0], np.uint8)
    start, scene = above - BEYOND_ANY_HAND * direction, _distances(geoms)
    away = mujoco.mj_ray(
        scene.model, scene.data, start, direction, group, True, -1, None, normal
    )
    return None if away < 0 else (start + away * direction, normal)


class Distances:
    """MuJoCo's own distances (mj_geomDistance) between geoms that ride on links and an object."""

    def __init__(self, geoms: Sequence[Geom]) -> None:
        """Put the geoms of links, each in the frame of its link, beside an object of each shape."""
        spec = mujoco.MjSpec()
        for number, geom in enumerate(geoms):
            name = f"mesh{number}" if geom.kind == MESH else ""
            if name:
                spec.add_mesh(name=name, uservert=np.ravel(geom.corners))
            place = {"pos": geom.position, "quat": geom.quaternion, "meshname": name}
            spec.worldbody.add_geom(type=KINDS[geom.kind], size=geom.size, **place)
        for kind in OBJECT_KINDS:
            spec.worldbody.add_geom(
                name=kind, type=KINDS[kind], size=[0.01, 0.01, 0.01], group=1
            )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        self._places = self.data.geom_xpos.copy(), self.data.geom_xmat.copy()

    def within(
        self, geom: int, position: Array, rotation: Array, shape: Shape, centre: Array, turn: Array,
        reach: float,
    ) -> bool:  # fmt: skip
        """Return whether a geom is within `reach` m of an object.

        `position` (3,) and `rotation` (3, 3) are of the geom's link, `centre` and
        `turn` of the object.
        """
        model, data = self.model, self.data
        item = model.geom(shape.kind).id
        model.geom_size[item] = shape.measures
        model.geom_rbound[item] = float(np.linalg.norm(shape.half_size))
        axes = turn[:, [1, 2, 0]] if shape.kind == "capsule" else turn
        data.geom_xpos[item], data.geom_xmat[item] = centre, axes.ravel()
        place, axes = self._places[0][geom], self._places[1][geom].reshape(3, 3)
        data.geom_xpos[geom] = position + rotation @ place
        data.geom_xmat[geom] = (rotation @ axes).ravel()
        return bool(
            mujoco.mj_geomDistance(model, data, geom, item, 2 * reach, None) <= reach
        )

    def nearest(self, point: Array) -> tuple[int, float]:
        """Return the geom that is nearest to a point (3,) of its link, and its distance, m."""
        model, data = self.model, self.data
        data.geom_xpos[:], data.geom_xmat[:] = self._places
        item = model.geom("sphere").id
        model.geom_size[item] = model.geom_rbound[item] = 1e-6
        data.geom_xpos[item] = point
        n_geoms = model.ngeom - len(OBJECT_KINDS)
        away = [
            mujoco.mj_geomDistance(model, data, geom, item, BEYOND_ANY_HAND, None)
            for geom in range(n_geoms)
        ]
        best = int(np.argmin(away))
        return best, away[best]


_distances = lru_cache(maxsize=64)(Distances)


def outside(geoms: tuple[Geom, ...], point: Array) -> tuple[float, Array]:
    """Return the distance of a point (3,) to all geoms of a link, and the normal of the nearest.

    The distance is in m, negative inside. The outward normal (3,) is zero where there
    is none, as in the middle of a sphere.
    """

    def away(place: Array) -> float:
        return _distances(geoms).nearest(place)[1]

    steps = STEP * np.eye(3)
    slope = np.array([away(point + step) - away(point - step) for step in steps])
    return away(point), slope / max(float(np.linalg.norm(slope)), 1e-12)


# -- models that are posed ----------------------------------------------------------------


def posed(model: mujoco.MjModel, angles: Mapping[str, float]) -> mujoco.MjData:
    """Return a model with these joint angles, the others where its joints rest."""
    data = mujoco.MjData(model)
    for joint, angle in angles.items():
        data.joint(joint).qpos = angle
    mujoco.mj_kinematics(model, data)
    return data


def placed(data: mujoco.MjData, link: str, point: Any) -> Array:
    """Return the place (3,) in the world of a point (3,) in a link's frame, m."""
    body = data.body(link)
    return body.xpos + body.xmat.reshape(3, 3) @ point


def gap(
    model: mujoco.MjModel, data: mujoco.MjData, first: int | str, second: int | str
) -> float:
    """Return the distance between what collides of two bodies, m, at most BEYOND_ANY_HAND.

    It is negative where they are in each other.
    """
    distances = [
        mujoco.mj_geomDistance(model, data, a.id, b.id, BEYOND_ANY_HAND, None)
        for a in colliding(model, first)
        for b in colliding(model, second)
    ]
    return min(distances, default=BEYOND_ANY_HAND)


def unit(direction: Any, where: str) -> Array:
    """Return a direction of length 1; ValueError where it has none."""
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise ValueError(f"{where}: found no direction")
    return np.asarray(direction, float) / length


def perpendicular(direction: Array, other: Array) -> Array:
    """Return the part of a unit vector at right angles to another one, at unit length."""
    along = float(direction @ other)
    if abs(along) < 1e-9:
        return direction
    return unit(direction - along * other, "directions")
