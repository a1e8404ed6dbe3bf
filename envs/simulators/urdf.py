"""A compiled MuJoCo model as URDF, for simulators that read that.

Every body becomes a link of the same name and frame; a body with several joints hangs on
massless links, one for each joint but the last. Poses, joint ranges, masses and inertias
carry over to the last digit (tests/envs/test_simulators.py), what URDF cannot say does not:
tendons, armature, actuators, friction, contact filters.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from ..state import Array

WORLD = "world"
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_JOINTS = {_HINGE: "revolute", _SLIDE: "prismatic"}
_LOOPS = [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)]
_UNLIMITED = 1e9
_UNMOVED = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
BULLETS_SKIN = 1e-3  # m: by so much Bullet makes convex hulls from URDF thicker


def from_model(model: mujoco.MjModel, folder: Path) -> str:
    """The text, with the convex hulls of meshes as files in `folder`; ValueError when the model has a
    joint or a shape that URDF has not."""
    if loops := np.isin(model.eq_type, _LOOPS).sum():
        raise _unknown(f"{loops} closed loops in the hand's model", "none")
    robot = Element("robot", name="hand")
    _link(robot, WORLD, 0.0, np.zeros(3))
    for body in range(1, model.nbody):
        _add_link(robot, model, body, folder)
        _add_joints(robot, model, body)
    ElementTree.indent(robot)  # Bullet reads lines, and long ones not to their end
    return ElementTree.tostring(robot, encoding="unicode")


def _unknown(found: str, allowed: str) -> ValueError:
    return ValueError(
        f"simulator: found 'pybullet' with {found}, allowed for PyBullet: {allowed}"
    )


def _add_link(robot: Element, model: mujoco.MjModel, body: int, folder: Path) -> None:
    link = _link(
        robot, model.body(body).name, model.body_mass[body], model.body_inertia[body]
    )
    _origin(link[0], model.body_ipos[body], model.body_iquat[body])
    first = model.body_geomadr[body]
    in_pairs = {*model.pair_geom1, *model.pair_geom2}
    for geom in range(first, first + model.body_geomnum[body]):
        if model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in in_pairs:
            collision = SubElement(link, "collision")
            _origin(collision, model.geom_pos[geom], model.geom_quat[geom])
            _shape(SubElement(collision, "geometry"), model, geom, folder)


def _link(robot: Element, name: str, mass: float, inertia: Array) -> Element:
    """A link whose first element is its inertia."""
    link = SubElement(robot, "link", name=name)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "mass", value=repr(float(mass)))
    xx, yy, zz = (repr(float(value)) for value in inertia)
    SubElement(inertial, "inertia", ixx=xx, iyy=yy, izz=zz, ixy="0", ixz="0", iyz="0")
    return link


def _shape(parent: Element, model: mujoco.MjModel, geom: int, folder: Path) -> None:
    size, kind = model.geom_size[geom], mujoco.mjtGeom(int(model.geom_type[geom]))
    name, radius = kind.name.removeprefix("mjGEOM_").lower(), repr(float(size[0]))
    if name == "box":
        SubElement(parent, name, size=_text(2 * size))
    elif name in ("capsule", "cylinder"):
        SubElement(parent, name, radius=radius, length=repr(2 * float(size[1])))
    elif name == "sphere":
        SubElement(parent, name, radius=radius)
    elif name == "mesh":
        path = folder / f"mesh{geom}.obj"
        path.write_text(_hull(model, int(model.geom_dataid[geom])), encoding="utf-8")
        SubElement(parent, name, filename=str(path))
    else:
        found = f"a geom of body {model.body(model.geom_bodyid[geom]).name!r} that is an {name}"
        raise _unknown(found, "box, capsule, cylinder, sphere, mesh")


def _hull(model: mujoco.MjModel, mesh: int) -> str:
    """A mesh's convex hull, without the skin that Bullet adds, as the text of an OBJ file."""
    first, n = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = model.mesh_vert[first : first + n].astype(float)
    hull = ConvexHull(points)
    middle = points[hull.vertices].mean(axis=0)
    planes = hull.equations + np.array([0.0, 0.0, 0.0, BULLETS_SKIN])
    if (planes[:, :3] @ middle + planes[:, 3] < 0).all():  # it is thick enough
        points = HalfspaceIntersection(planes, middle).intersections
        hull = ConvexHull(points)
    corner = {int(index): number for number, index in enumerate(hull.vertices, 1)}
    lines = [f"v {_text(points[index])}" for index in hull.vertices]
    for (a, b, c), normal in zip(hull.simplices, hull.equations[:, :3], strict=True):
        is_outward = np.cross(points[b] - points[a], points[c] - points[a]) @ normal > 0
        face = (a, b, c) if is_outward else (a, c, b)
        lines.append("f " + " ".join(str(corner[int(index)]) for index in face))
    return "\n".join(lines) + "\n"


def _add_joints(robot: Element, model: mujoco.MjModel, body: int) -> None:
    """The joints between a body and its parent, with massless links between them."""
    name, parent = model.body(body).name, model.body(model.body_parentid[body]).name
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    if not joints:
        joint = _joint(robot, f"{name} fixed", "fixed", parent, name)
        _origin(joint, model.body_pos[body], model.body_quat[body])
    for number, index in enumerate(joints):
        if int(model.jnt_type[index]) not in _JOINTS or np.any(model.jnt_pos[index]):
            found = f"joint {model.joint(index).name!r}, whose anchor is not its body's origin"
            raise _unknown(found, "hinges and slides at the origin")
        child = name
        if index != joints[-1]:
            child = _link(robot, f"{name} {number}", 0.0, np.zeros(3)).attrib["name"]
        kind = _JOINTS[int(model.jnt_type[index])]
        joint = _joint(robot, model.joint(index).name, kind, parent, child)
        at, turned = _UNMOVED
        if number == 0:
            at, turned = model.body_pos[body], model.body_quat[body]
        ref = model.qpos0[model.jnt_qposadr[index]]  # at which the joint is unmoved
        if ref:
            at, turned = _moved(at, turned, -ref * model.jnt_axis[index], kind)
        if number == 0 or ref:
            _origin(joint, at, turned)
        SubElement(joint, "axis", xyz=_text(model.jnt_axis[index]))
        limits = -_UNLIMITED, _UNLIMITED
        if model.jnt_limited[index]:
            limits = model.jnt_range[index]
        lower, upper = (repr(float(limit)) for limit in limits)
        SubElement(joint, "limit", effort="0", velocity="0", lower=lower, upper=upper)
        parent = child


def _moved(
    position: Array, quaternion: Array, by: Array, kind: str
) -> tuple[Array, Array]:
    """A pose, moved along or turned about an axis of its own."""
    turn = Rotation.from_quat(quaternion, scalar_first=True)
    if kind == "prismatic":
        return position + turn.apply(by), quaternion
    return position, (turn * Rotation.from_rotvec(by)).as_quat(scalar_first=True)


def _joint(robot: Element, name: str, kind: str, parent: str, child: str) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    return joint


def _origin(parent: Element, position: Array, quaternion: Array) -> None:
    with (
        warnings.catch_warnings()
    ):  # where other angles would say the same (gimbal lock)
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("xyz")
    SubElement(parent, "origin", xyz=_text(position), rpy=_text(angles))


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
