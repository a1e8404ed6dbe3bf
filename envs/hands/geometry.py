"""Geometry of links: their shapes, where one meets their skin, how far they are from an object, and
where a model's parts are when it is posed.

A mesh counts as its convex hull, which is what the simulators collide.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ..state import Array, Shape

FAR = 0.5  # m: beyond any hand
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
    """MuJoCo's three."""
    position: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]
    corners: tuple[tuple[float, ...], ...]
    """Corners of a mesh's convex hull, or of the box around another shape, in the geom's frame, m."""

    @property
    def points(self) -> Array:
        """Corners (n, 3) in the link's frame, m."""
        turned = np.array(self.corners) @ np.array(self.rotation).T
        return np.array(self.position) + turned


def geoms_of(model: mujoco.MjModel, link: str) -> tuple[Geom, ...]:
    """Return what collides of a body; ValueError for a shape that no link has."""
    shapes = []
    for geom in colliding(model, link):
        kind = mujoco.mjtGeom(geom.type[0]).name.removeprefix("mjGEOM_").lower()
        if kind not in KINDS:
            raise ValueError(
                f"body {link!r}: found a geom of kind {kind}, "
                f"allowed: {', '.join(KINDS)}"
            )
        corners = list(product((-1, 1), repeat=3)) * model.geom_aabb[geom.id, 3:]
        if kind == MESH:
            mesh = model.mesh(geom.dataid[0])
            corners = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
            corners = corners.astype(float)
            with suppress(QhullError):  # it is flat
                corners = corners[ConvexHull(corners).vertices]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, geom.quat)
        rows, points = (
            tuple(map(tuple, a.tolist())) for a in (rotation.reshape(3, 3), corners)
        )
        shapes.append(Geom(kind, tuple(geom.size), tuple(geom.pos), rows, points))
    return tuple(shapes)


def colliding(model: mujoco.MjModel, body: int | str) -> list[Any]:
    """Return the geoms of a body that collide."""
    about = model.body(body)
    first = int(about.geomadr[0])
    geoms = map(model.geom, range(first, first + int(about.geomnum[0])))
    return [geom for geom in geoms if geom.contype[0] or geom.conaffinity[0]]


def meet(
    geoms: tuple[Geom, ...], above: Array, direction: Array
) -> tuple[Array, Array] | None:
    """Return where one comes upon the geoms from outside, on the line through `above` (3,) along
    `direction`, and the outward normal there; None when one passes."""
    if not geoms:
        return None
    start = above - FAR * direction
    away, normal = _distances(geoms).along(start, direction)
    return None if away < 0 else (start + away * direction, normal)


class Distances:
    """MuJoCo's own distances (mj_geomDistance) between geoms that ride on links and an object."""

    def __init__(self, geoms: list[Geom]) -> None:
        spec = mujoco.MjSpec()
        for number, geom in enumerate(geoms):
            quaternion, name = np.zeros(4), f"mesh{number}"
            mujoco.mju_mat2Quat(quaternion, np.ravel(geom.rotation))
            if geom.kind == MESH:
                spec.add_mesh(name=name, uservert=np.ravel(geom.corners))
            spec.worldbody.add_geom(
                type=KINDS[geom.kind],
                size=geom.size,
                meshname=name if geom.kind == MESH else "",
                pos=geom.position,
                quat=quaternion,
            )
        for kind in ("box", "sphere", "cylinder"):
            spec.worldbody.add_geom(
                name=kind, type=KINDS[kind], size=[0.01, 0.01, 0.01], group=1
            )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        self._places = self._data.geom_xpos.copy(), self._data.geom_xmat.copy()

    def within(
        self, geom: int, position: Array, rotation: Array, shape: Shape, centre: Array, turn: Array,
        reach: float,
    ) -> bool:  # fmt: skip
        """Return whether a geom, whose link has this pose, is no further than `reach` m from an object
        with that."""
        model, data = self._model, self._data
        x, _, z = shape.half_size
        thing = model.geom(shape.kind).id
        model.geom_size[thing] = (
            (x, z, 0.0) if shape.kind == "cylinder" else shape.half_size
        )
        model.geom_rbound[thing] = float(np.linalg.norm(shape.half_size))
        data.geom_xpos[thing], data.geom_xmat[thing] = centre, turn.ravel()
        place, axes = self._places[0][geom], self._places[1][geom].reshape(3, 3)
        data.geom_xpos[geom] = position + rotation @ place
        data.geom_xmat[geom] = (rotation @ axes).ravel()
        return bool(
            mujoco.mj_geomDistance(model, data, geom, thing, 2 * reach, None) <= reach
        )

    def along(self, start: Array, direction: Array) -> tuple[float, Array]:
        """Return how far a ray goes to the geoms where they are on their link, m, -1 where it passes;
        and the normal (3,) there."""
        normal, group = np.zeros(3), np.array([1, 0, 0, 0, 0, 0], np.uint8)
        away = mujoco.mj_ray(
            self._model, self._data, start, direction, group, True, -1, None, normal
        )
        return float(away), normal

    def nearest(self, candidates: list[int], point: Array) -> tuple[int, float]:
        """Return which of these geoms of a link is nearest to a point (3,) in its frame, and how near,
        m."""
        model, data = self._model, self._data
        thing = model.geom("sphere").id
        model.geom_size[thing] = model.geom_rbound[thing] = 1e-6
        data.geom_xpos[thing] = point
        for places, poses in zip(
            self._places, (data.geom_xpos, data.geom_xmat), strict=True
        ):
            poses[candidates] = places[candidates]
        away = [
            mujoco.mj_geomDistance(model, data, geom, thing, FAR, None)
            for geom in candidates
        ]
        best = int(np.argmin(away))
        return candidates[best], float(away[best])


def outside(geoms: tuple[Geom, ...], point: Array) -> tuple[float, Array]:
    """Return how far a point (3,) is outside of all geoms of a link, m, negative within; and the
    outward normal (3,) of the nearest one's skin, zeros where there is none, as in the middle of a
    sphere."""

    def away(place: Array) -> float:
        return _distances(geoms).nearest(list(range(len(geoms))), place)[1]

    steps = STEP * np.eye(3)
    slope = np.array([away(point + step) - away(point - step) for step in steps])
    return away(point), slope / max(float(np.linalg.norm(slope)), 1e-12)


@lru_cache(maxsize=64)
def _distances(geoms: tuple[Geom, ...]) -> Distances:
    return Distances(list(geoms))


# -- models that are posed ----------------------------------------------------------------


def posed(model: mujoco.MjModel, angles: Mapping[str, float]) -> mujoco.MjData:
    """Return a model with these joint angles, the others where its joints rest."""
    data = mujoco.MjData(model)
    for joint, angle in angles.items():
        data.joint(joint).qpos = angle
    mujoco.mj_kinematics(model, data)
    return data


def placed(data: mujoco.MjData, link: str, point: Any) -> Array:
    """Return where a point (3,) in a link's frame is, m."""
    body = data.body(link)
    return np.asarray(body.xpos + body.xmat.reshape(3, 3) @ point)


def gap(
    model: mujoco.MjModel, data: mujoco.MjData, first: int | str, second: int | str
) -> float:
    """Return how far what collides of two bodies is apart, m, at most FAR; negative where they are in
    each other."""
    distances = [
        mujoco.mj_geomDistance(model, data, a.id, b.id, FAR, None)
        for a in colliding(model, first)
        for b in colliding(model, second)
    ]
    return min(distances, default=FAR)


def unit(direction: Any, where: str) -> Array:
    """Return a direction of length 1; ValueError where it has none."""
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise ValueError(f"{where}: found no direction")
    return np.asarray(direction, float) / length


def beside(direction: Array, other: Array) -> Array:
    """Return what of a unit vector is at right angles to another, of length 1."""
    along = float(direction @ other)
    if abs(along) < 1e-9:
        return direction
    return unit(direction - along * other, "directions")
