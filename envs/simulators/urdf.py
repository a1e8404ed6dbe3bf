"""A compiled MuJoCo model as URDF, for simulators that read that.

Every body becomes a link of the same name and frame; a body with several joints hangs
on massless links, one for each joint but the last. Poses, joint ranges, masses and
inertias carry over to the last digit (tests/envs/test_simulators.py), what URDF cannot
say does not: tendons, armature, actuators, friction, contact filters.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from ..hands.geometry import mesh_points
from ..state import Array

# Bullet reads lines, and long ones not to their end.
LINK = """\
<link name={name}>
  <inertial>
    {origin}
    <mass value="{mass}"/>
    <inertia ixx="{inertia[0]!r}" iyy="{inertia[1]!r}" izz="{inertia[2]!r}" ixy="0" ixz="0" iyz="0"/>
  </inertial>
{collisions}</link>
"""
COLLISION = """\
  <collision>
    {origin}
    <geometry>{shape}</geometry>
  </collision>
"""
SHAPES = {
    "BOX": '<box size="{size}"/>',
    "CAPSULE": '<capsule radius="{radius!r}" length="{length!r}"/>',
    "CYLINDER": '<cylinder radius="{radius!r}" length="{length!r}"/>',
    "SPHERE": '<sphere radius="{radius!r}"/>',
    "MESH": "<mesh filename={path}/>",
}
JOINT = """\
<joint name={name} type="{kind}">
  <parent link={parent}/>
  <child link={child}/>
  {origin}
  <axis xyz="{axis}"/>
  <limit effort="0" velocity="0" lower="{limits[0]!r}" upper="{limits[1]!r}"/>
</joint>
"""
WORLD = "world"
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_JOINTS = {_HINGE: "revolute", _SLIDE: "prismatic"}
_LOOPS = [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)]
_UNLIMITED = [-1e9, 1e9]
_UNMOVED = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
BULLETS_SKIN = 1e-3  # m: by so much Bullet makes convex hulls from URDF thicker


def from_model(model: mujoco.MjModel, folder: Path) -> str:
    """Return the model as URDF text, and write the convex hulls of its meshes to files in `folder`.

    Raise ValueError when the model has a joint or a shape that URDF has not.
    """
    if loops := np.isin(model.eq_type, _LOOPS).sum():
        raise _unknown(f"{loops} closed loops in the hand's model", "none")
    parts = [_massless(WORLD)]
    for body in range(1, model.nbody):
        parts += [_link(model, body, folder), *_joints(model, body)]
    return f'<robot name="hand">\n{"".join(parts)}</robot>\n'


def _unknown(what: str, allowed: str) -> ValueError:
    return ValueError(
        f"simulator: found 'pybullet' with {what}, allowed for PyBullet: {allowed}"
    )


def _massless(name: str) -> str:
    return LINK.format(
        name=quoteattr(name),
        origin=_origin(*_UNMOVED),
        mass=0.0,
        inertia=[0.0, 0.0, 0.0],
        collisions="",
    )


def _link(model: mujoco.MjModel, body: int, folder: Path) -> str:
    """Return a body with what of it collides."""
    first = model.body_geomadr[body]
    collisions = [
        _collision(model, geom, folder)
        for geom in range(first, first + model.body_geomnum[body])
        if model.geom_contype[geom] or model.geom_conaffinity[geom]
    ]
    return LINK.format(
        name=quoteattr(model.body(body).name),
        origin=_origin(model.body_ipos[body], model.body_iquat[body]),
        mass=float(model.body_mass[body]),
        inertia=model.body_inertia[body].tolist(),
        collisions="".join(collisions),
    )


def _collision(model: mujoco.MjModel, geom: int, folder: Path) -> str:
    size = model.geom_size[geom]
    kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_")
    if kind not in SHAPES:
        name = model.body(model.geom_bodyid[geom]).name
        what = f"a geom of body {name!r} that is an {kind.lower()}"
        raise _unknown(what, ", ".join(SHAPES).lower())
    path = folder / f"mesh{geom}.obj"
    if kind == "MESH":
        path.write_text(_hull(model, int(model.geom_dataid[geom])), encoding="utf-8")
    shape = SHAPES[kind].format(
        size=_text(2 * size),
        radius=float(size[0]),
        length=2 * float(size[1]),
        path=quoteattr(str(path)),
    )
    origin = _origin(model.geom_pos[geom], model.geom_quat[geom])
    return COLLISION.format(origin=origin, shape=shape)


def _hull(model: mujoco.MjModel, mesh: int) -> str:
    """Return a mesh's convex hull, without the skin that Bullet adds, as the text of an OBJ file."""
    points = mesh_points(model, mesh)
    hull = ConvexHull(points)
    middle = points[hull.vertices].mean(axis=0)
    planes = hull.equations + np.array([0.0, 0.0, 0.0, BULLETS_SKIN])
    if (planes[:, :3] @ middle + planes[:, 3] < 0).all():  # it is thick enough
        points = HalfspaceIntersection(planes, middle).intersections
        hull = ConvexHull(points)
    lines = [f"v {_text(point)}" for point in points]
    lines += [f"f {a} {b} {c}" for a, b, c in hull.simplices + 1]
    return "\n".join(lines) + "\n"


def _joints(model: mujoco.MjModel, body: int) -> list[str]:
    """Return the joints between a body and its parent, with massless links between them."""
    name, parent = model.body(body).name, model.body(model.body_parentid[body]).name
    first, n = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    pose, parts = (model.body_pos[body], model.body_quat[body]), []
    for number in range(max(n, 1)):
        label, kind, axis, limits = f"{name} fixed", "fixed", _UNMOVED[0], _UNLIMITED
        child = name if number >= n - 1 else f"{name} {number}"
        if n > 0:
            joint = model.joint(first + number)
            label, kind, axis = (
                joint.name,
                _JOINTS.get(int(joint.type[0]), ""),
                joint.axis,
            )
            if not kind or np.any(joint.pos) or joint.qpos0[0]:
                what = f"joint {label!r}, whose anchor is not its body's origin or which has a ref"
                raise _unknown(what, "hinges and slides at the origin, without ref")
            if joint.limited[0]:
                limits = joint.range.tolist()
        if child != name:
            parts.append(_massless(child))
        text = JOINT.format(
            name=quoteattr(label),
            kind=kind,
            parent=quoteattr(parent),
            child=quoteattr(child),
            origin=_origin(*pose),
            axis=_text(axis),
            limits=limits,
        )
        parts.append(text)
        parent, pose = child, _UNMOVED
    return parts


def _origin(position: Array, quaternion: Array) -> str:
    with warnings.catch_warnings(action="ignore"):  # where other angles say the same
        angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("xyz")
    return f'<origin xyz="{_text(position)}" rpy="{_text(angles)}"/>'


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
