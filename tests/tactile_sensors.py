"""A hand with taxels as MuJoCo's own `<tactile>` sensors: a mesh, a ghost geom and a sensor per link.

The sensor reads how deep each vertex of its mesh is in what touches the link, and how fast that slides
along two tangents. A vertex stands off the skin by the taxel's radius, along its normal, so that it is
in an object of which rule "skin" says that it is within the radius of the taxel's centre.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from tactilerl.envs.hands import Hand
from tactilerl.envs.state import Array

NAME = "taxels of "  # and the link: what mesh, geom and sensor are called
GROUP = 5  # of geoms that are not drawn


def spec(hand: Hand, taxels: Any) -> mujoco.MjSpec:
    """The hand as it hangs in a scene, without ground and object. A sensor has its link's taxels in the
    layout's order, depth (m) first; those beyond are corners of a mesh that is too small without."""
    whole, (path, *_) = hand.build(), hand.build.files
    whole.meshdir = str((path.parent / whole.meshdir).absolute())
    whole.texturedir = str((path.parent / whole.texturedir).absolute())
    mesh, geom = mujoco.mjtObj.mjOBJ_MESH, mujoco.mjtObj.mjOBJ_GEOM
    for number, link in enumerate(taxels.links):
        own, name = taxels.link_index == number, NAME + link
        corners, normals, faces = _mesh(taxels.positions[own], taxels.normals[own], taxels.radii[own])
        made = whole.add_mesh(name=name, uservert=corners, usernormal=normals, userface=faces)
        made.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open, and perhaps flat
        whole.body(link).add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0, mass=0,
            group=GROUP,
        )  # fmt: skip
        whole.add_sensor(
            name=name, type=mujoco.mjtSensor.mjSENS_TACTILE, objtype=mesh, objname=name, reftype=geom,
            refname=name,
        )  # fmt: skip
    return whole


def _mesh(places: Array, normals: Array, radii: Array) -> tuple[list[float], list[float], list[int]]:
    """Vertices and normals (3 n), of taxels first, and a fan of faces, each flat. MuJoCo wants four
    vertices and an area, so what has neither gets three more, within the link."""
    corners = places + radii[:, None] * normals
    if len(corners) < 4 or np.linalg.matrix_rank(corners - corners[0], tol=1e-6) < 2:
        turn = np.linalg.svd(normals[:1])[2]  # rows: the normal, and two tangents
        behind = places[0] - radii[0] * (normals[0] + [turn[1], turn[2], -turn[1] - turn[2]])
        corners, normals = (
            np.vstack([corners, behind]),
            np.vstack([normals, *3 * [normals[:1]]]),
        )
    fan = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    return corners.ravel().tolist(), normals.ravel().tolist(), np.ravel(fan).tolist()
