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
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ..state import Array, Shape

FAR = 0.5  # m: beyond any hand
STEP = 1e-4  # m, of differences
SAMPLES = 500, 20_000  # points on a hull, and on its mesh
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
    corners: tuple[tuple[float, ...], ...] = ()
    """Of a mesh's convex hull, in the geom's frame, m."""

    @property
    def points(self) -> Array:
        """Corners (n, 3) of the shape, or of a box around it, in the link's frame, m."""
        radius, half, size = *self.size[:2], self.size
        if self.kind in ("sphere", "capsule", "cylinder"):
            length = {"sphere": radius, "capsule": half + radius}.get(self.kind, half)
            size = radius, radius, length
        corners = np.array(
            self.corners or [*product((-1, 1), repeat=3)] * np.array(size)
        )
        return np.array(self.position) + corners @ np.array(self.rotation).T


def geoms_of(model: mujoco.MjModel, body: int) -> tuple[Geom, ...]:
    """Return what collides of a body; ValueError for a shape that no link has."""
    names = {int(value): name for name, value in KINDS.items()}
    found = []
    for geom in colliding(model, body):
        if int(geom.type[0]) not in names:
            what = f"body {model.body(body).name!r}: found a geom of another kind"
            raise ValueError(f"{what}, allowed: {', '.join(KINDS)}")
        kind = names[int(geom.type[0])]
        corners: Array = np.zeros((0, 3))
        if kind == MESH:
            corners = _corners(model, geom)
            with suppress(QhullError):  # it is flat
                corners = corners[ConvexHull(corners).vertices]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, geom.quat)
        rows, points = (
            tuple(map(tuple, a.tolist())) for a in (rotation.reshape(3, 3), corners)
        )
        found.append(Geom(kind, tuple(geom.size), tuple(geom.pos), rows, points))
    return tuple(found)


def colliding(model: mujoco.MjModel, body: int) -> list[Any]:
    """Return the geoms of a body that collide."""
    first = model.body_geomadr[body]
    geoms = map(model.geom, range(first, first + model.body_geomnum[body]))
    return [geom for geom in geoms if geom.contype[0] or geom.conaffinity[0]]


def _corners(model: mujoco.MjModel, geom: Any) -> Array:
    """Return all corners (n, 3) of a geom's mesh, m."""
    mesh = model.mesh(geom.dataid[0])
    return model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(float)


def stand_off(model: mujoco.MjModel, body: int) -> float:
    """Return how far the convex hull of a mesh of a body is off that mesh, at most, m; 0 without
    meshes. All corners count, as in the hull: MuJoCo reads the faces of a file's first part only."""
    worst, rng = 0.0, np.random.default_rng(0)
    for geom in colliding(model, body):
        if geom.type[0] == KINDS[MESH]:
            corners, mesh = _corners(model, geom), model.mesh(geom.dataid[0])
            faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
            with suppress(QhullError):  # it is flat
                hull = _scattered(
                    corners[ConvexHull(corners).simplices], SAMPLES[0], rng
                )
                skin = np.vstack([corners, _scattered(corners[faces], SAMPLES[1], rng)])
                worst = max(worst, float(cKDTree(skin).query(hull)[0].max()))
    return worst


def _scattered(triangles: Array, n: int, rng: np.random.Generator) -> Array:
    """Return points (n, 3) evenly on triangles (k, 3, 3)."""
    a, b, c = triangles.swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(triangles), n, p=areas / areas.sum())
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def meet(
    geoms: tuple[Geom, ...], above: Array, direction: Array
) -> tuple[Array, Array] | None:
    """Return where one comes upon the geoms from outside, on the line through `above` (3,) along
    `direction`, and the outward normal there; None when one passes."""
    start = above - FAR * direction
    away, normal = _distances(geoms).along(start, direction) if geoms else (-1.0, start)
    return None if away < 0 else (start + away * direction, normal)


class Distances:
    """MuJoCo's own distances (mj_geomDistance) between geoms that ride on links and an object."""

    def __init__(self, geoms: list[Geom]) -> None:
        spec = mujoco.MjSpec()
        for number, geom in enumerate(geoms):
            more = (
                {"meshname": f"mesh{number}"}
                if geom.kind == MESH
                else {"size": geom.size}
            )
            if geom.kind == MESH:
                spec.add_mesh(name=f"mesh{number}", uservert=np.ravel(geom.corners))
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, np.ravel(geom.rotation))
            spec.worldbody.add_geom(
                type=KINDS[geom.kind], pos=geom.position, quat=quaternion, **more
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
        """Is a geom, whose link has this pose, no further than `reach` m from an object with that?"""
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
        """How far a ray goes to the geoms where they are on their link, m, -1 where it passes; and the
        normal (3,) there."""
        normal, group = np.zeros(3), np.array([1, 0, 0, 0, 0, 0], np.uint8)
        away = mujoco.mj_ray(
            self._model, self._data, start, direction, group, True, -1, None, normal
        )
        return float(away), normal

    def nearest(self, candidates: list[int], point: Array) -> tuple[int, float]:
        """Which of these geoms of a link is nearest to a point (3,) in its frame, and how near, m."""
        model, data = self._model, self._data
        thing = model.geom("sphere").id
        model.geom_size[thing] = model.geom_rbound[thing] = 1e-6
        data.geom_xpos[thing] = point
        for geom in candidates:
            data.geom_xpos[geom], data.geom_xmat[geom] = (
                places[geom] for places in self._places
            )
        away = [
            mujoco.mj_geomDistance(model, data, geom, thing, FAR, None)
            for geom in candidates
        ]
        best = int(np.argmin(away))
        return candidates[best], float(away[best])


def outside(geoms: tuple[Geom, ...], point: Array) -> tuple[float, Array]:
    """How far a point (3,) is outside of all geoms of a link, m, negative within; and the outward
    normal (3,) of the nearest one's skin, zeros where there is none, as in the middle of a sphere."""
    skin, own = _distances(geoms), list(range(len(geoms)))
    ways = STEP * np.eye(3)
    slope = np.array(
        [
            skin.nearest(own, point + d)[1] - skin.nearest(own, point - d)[1]
            for d in ways
        ]
    )
    return skin.nearest(own, point)[1], slope / max(float(np.linalg.norm(slope)), 1e-12)


@lru_cache(maxsize=64)
def _distances(geoms: tuple[Geom, ...]) -> Distances:
    return Distances(list(geoms))


# -- models that are posed ----------------------------------------------------------------


def posed(model: mujoco.MjModel, angles: Mapping[str, float]) -> mujoco.MjData:
    """A model with these joint angles, the others where its joints rest."""
    data = mujoco.MjData(model)
    for joint, angle in angles.items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    return data


def placed(data: mujoco.MjData, link: str, point: Any) -> Array:
    """Where a point (3,) in a link's frame is, m."""
    body = data.body(link)
    return np.asarray(body.xpos + body.xmat.reshape(3, 3) @ point)


def unit(direction: Any, where: str) -> Array:
    """A direction of length 1; ValueError where it has none."""
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise ValueError(f"{where}: found no direction")
    return np.asarray(direction, float) / length


def beside(direction: Array, other: Array) -> Array:
    """What of a unit vector is at right angles to another, of length 1."""
    along = float(direction @ other)
    return (
        direction
        if abs(along) < 1e-9
        else unit(direction - along * other, "directions")
    )


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> list[Any]:
    """All contacts, as if whatever collides collided with all else, and the ground with all."""
    kinds = [
        model.geom_contype,
        model.geom_conaffinity,
        model.body_contype,
        model.body_conaffinity,
    ]
    before = [kind.copy() for kind in kinds]
    model.geom_conaffinity[:] = model.geom_contype
    model.body_conaffinity[:] = model.body_contype
    for geom in np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)):
        model.geom_conaffinity[geom] = model.body_conaffinity[0] = 1
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    for kind, values in zip(kinds, before, strict=True):
        kind[:] = values
    return list(data.contact)
