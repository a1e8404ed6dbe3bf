"""From a model's file to the hand of a scene: palm down on three slides, driven by position servos."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from fnmatch import filter as filter_names
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..state import Array
from .hand import SLIDES

SLIDE = {"gain": 1000.0, "damping": 79.0, "force": 30.0}
"""N/m, N s/m, N. Without a limit on its force the hand would be pressed into the ground."""
SERVOS = {
    "hinge": {"gain": 10.0, "damping": 0.5, "armature": 0.01, "limit": 1.0},
    "slide": {"gain": 1000.0, "damping": 50.0, "armature": 0.1, "limit": 20.0},
}
"""Of joints whose model has no actuators: N m/rad, N m s/rad, kg m², N m; for slides N/m and so on."""
HINGE, LINEAR = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
# Of an element of MjSpec: where it stands, not what it is like.
NOT_DEFAULTS = {"id", "signature", "parent", "frame", "compiler", "classname", "plugin", "alt", "name"}
PALM_DOWN = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: where the palmar side, the fingers and their cross product point in the world."""


@dataclass(frozen=True)
class Mount:
    """Builds the hand of a scene from its model; plain values, so that it can be pickled."""

    model: Path
    palm: str
    drop: tuple[str, ...] = ()
    """Patterns of names of what is left out of the model: bodies, geoms, tendons, actuators, sites."""
    masses: dict[str, float] = field(default_factory=dict)
    """Of bodies that weigh something else than in the model, kg."""
    keeps_contacts: bool = False
    """Do links touch what the model says, each other too? Else only the object and the ground."""
    slides: dict[str, float] = field(default_factory=lambda: SLIDE)
    """As SLIDE."""
    servos: dict[str, dict[str, float]] = field(default_factory=dict)
    """What is different from SERVOS."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the model's root body, m."""
    rotation: tuple[tuple[float, ...], ...] = ()
    """(3, 3) of the root body."""
    is_turned: bool = False
    """Does the model give it another?"""
    files: tuple[Path, ...] = ()
    """The model's, with what it includes and its meshes."""

    def __call__(self, visual: bool = False, finger_gain: float = 1.0) -> mujoco.MjSpec:
        """The hand alone as an editable model: no ground, no object, no taxels.

        `visual` keeps what only pictures need. `finger_gain` multiplies the position gain and force
        limit of the fingers' actuators.
        """
        spec = self.bare(visual)
        root, rotation = spec.worldbody.first_body(), np.array(self.rotation)
        root.pos = self.position
        if self.is_turned:
            root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            root.quat = _quaternion(rotation)
        damping = [self.slides["damping"], 0, 0]
        for name, axis in zip(SLIDES, rotation, strict=True):
            root.add_joint(name=name, type=LINEAR, axis=axis, damping=damping)
            _add_servo(spec, name, self.slides["gain"], self.slides["force"])
        for actuator in spec.actuators:
            if finger_gain != 1.0 and self._is_finger(spec, actuator.target):
                for figure in ("gainprm", "biasprm", "forcerange"):
                    setattr(actuator, figure, np.array(getattr(actuator, figure)) * finger_gain)
        return spec

    def bare(self, visual: bool = False) -> mujoco.MjSpec:
        """The model with its joints and actuators as they will be, where its file has it."""
        spec = _read(self.model)
        self._leave_out(spec)
        roots = [body.name for body in spec.worldbody.bodies]
        if len(roots) != 1:
            found = f"found {len(roots)} bodies at its root ({', '.join(roots)})"
            raise ValueError(f'model: {found}, allowed one; leave others out with drop = ["NAME"]')
        if not visual:
            spec.discard_visual()
        for body in spec.bodies[1:]:
            body.gravcomp = 1.0
            body.mass = self.masses.get(body.name, body.mass)
        if not self.keeps_contacts:  # contype without conaffinity meets the object and the ground
            for pair in (*spec.pairs, *spec.excludes):
                spec.delete(pair)
            for geom in spec.geoms:
                geom.contype, geom.conaffinity = int(bool(geom.contype or geom.conaffinity)), 0
        if not spec.actuators:
            self._add_servos(spec)
        return spec

    def _leave_out(self, spec: mujoco.MjSpec) -> None:
        """What the file says, and what a scene has of its own or has no use for."""
        kinds = ("bodies", "geoms", "tendons", "actuators", "sites")
        names = [element.name for kind in kinds for element in getattr(spec, kind)]
        for pattern in self.drop:
            if not filter_names(names, pattern):
                raise ValueError(f"drop: found {pattern!r}, which nothing in the model is called")
        for kind in kinds:
            elements = getattr(spec, kind)  # those that are left
            chosen = [element for element in elements if self._is_left_out(element)]
            if kind == "bodies":  # one takes along what hangs on it
                chosen = [body for body in chosen if not any(map(self._is_left_out, _above(body)))]
            for element in chosen:
                spec.delete(element)
        used = {geom.meshname for geom in spec.geoms}
        meshes = [mesh for mesh in spec.meshes if mesh.name not in used]
        joints = [joint for root in spec.worldbody.bodies for joint in root.joints]
        free = [joint for joint in joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
        for element in (*spec.sensors, *spec.lights, *spec.cameras, *spec.keys, *meshes, *free):
            spec.delete(element)

    def _is_left_out(self, element: Any) -> bool:
        is_named = any(fnmatchcase(element.name, pattern) for pattern in self.drop)
        return is_named and element.name != "world"

    def _add_servos(self, spec: mujoco.MjSpec) -> None:
        """For all joints but those that follow another."""
        followers = {follower for follower, _, _ in followed(spec)}
        for joint in spec.joints:
            kind = "slide" if joint.type == LINEAR else "hinge"
            figures = {**SERVOS[kind], **self.servos.get(kind, {})}
            if joint.name not in followers:
                joint.damping = np.maximum(joint.damping, [figures["damping"], 0, 0])
                joint.armature = max(joint.armature, figures["armature"])
                _add_servo(spec, joint.name, figures["gain"], figures["limit"])

    def _is_finger(self, spec: mujoco.MjSpec, joint: str) -> bool:
        """Does a joint move a part of the hand without moving the palm?"""
        palm, moved = spec.body(self.palm), spec.joint(joint).parent.name
        return all(body.name != moved for body in (palm, *_above(palm)))


def _above(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """What a body hangs on, up to the world."""
    while body.name != "world":
        body = body.parent
        yield body


def _read(path: Path) -> mujoco.MjSpec:
    """A model's file, with nothing of it merged; ValueError in one line."""
    included(path)
    with quiet():
        try:
            spec = mujoco.MjSpec.from_file(str(path))
        except ValueError as error:
            raise ValueError(f"model {path}: {' '.join(str(error).split())}") from None
    _forget_defaults(spec)
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = path.suffix.lower() == ".urdf"
    return spec


def included(path: Path) -> list[Path]:
    """A model's file and those that it includes; FileNotFoundError for what is no file, such as a pipe
    that never ends."""
    found = [path]
    for each in found:  # grows: a file that is included may include others
        if not each.is_file():
            raise FileNotFoundError(f"model {str(each)!r} does not exist")
        with suppress(ElementTree.ParseError, UnicodeDecodeError):  # MuJoCo says it better
            elements = ElementTree.parse(each).iter("include")
            more = [path.parent / element.attrib.get("file", "") for element in elements]
            found += [other for other in dict.fromkeys(more) if other not in found]
    return found


def assets(path: Path, spec: mujoco.MjSpec) -> list[Path]:
    """The files of a model's meshes, textures and height fields; ValueError for what is none."""
    folders = {"meshes": spec.meshdir, "hfields": spec.meshdir, "textures": spec.texturedir}
    found = []
    for kind, folder in folders.items():
        found += [path.parent / folder / each.file for each in getattr(spec, kind) if each.file]
    for file in found:
        if not file.is_file():
            raise ValueError(f"model: found no file {str(file)!r}")
    return found


@contextmanager
def quiet() -> Iterator[None]:
    """MuJoCo's warnings are not written to the terminal, nor to a log where it runs."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _forget_defaults(spec: mujoco.MjSpec) -> None:
    """What is added from here on is as MuJoCo has it: the file's own elements have their values."""
    fresh = mujoco.MjSpec()
    for kind in ("geom", "joint", "actuator"):
        own, usual = getattr(spec.default, kind), getattr(fresh.default, kind)
        for name in set(dir(usual)) - NOT_DEFAULTS:
            if not name.startswith(("_", "set_")):
                setattr(own, name, getattr(usual, name))


def _quaternion(rotation: Array) -> Array:
    turn = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(turn))
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.round(turn / max(angle, 1e-9), 12))])


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """A model; ValueError in one line where it is wrong, or a mesh of it cannot be found."""
    with quiet():
        try:
            return spec.compile()
        except ValueError as error:
            raise ValueError(f"model: {' '.join(str(error).split())}") from None


def followed(spec: mujoco.MjSpec) -> Iterator[tuple[str, str, float]]:
    """(joint, joint that it follows, ratio) where an equality of the model couples them."""
    for equality in spec.equalities:
        if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.name2:
            yield equality.name1, equality.name2, float(equality.data[1])


def _add_servo(spec: mujoco.MjSpec, joint: str, gain: float, limit: float) -> None:
    """An actuator of the joint's name: force = gain x (target - position), at most `limit`."""
    servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.forcelimited, servo.forcerange = True, [-limit, limit]
    servo.set_to_position(kp=gain)


def is_servo(actuator: mujoco.MjsActuator) -> bool:
    """Does it pull a joint towards the position that is its control?"""
    is_affine = actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    on_joint = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
    return bool(is_affine and on_joint and actuator.gainprm[0] > 0 > actuator.biasprm[1])


def turned(palm_in_root: Array, palmar: Array, fingers: Array) -> Array:
    """The rotation (3, 3) of the root with which the palm (3, 3) looks down, fingers along -y."""
    axes = np.column_stack([palmar, fingers, np.cross(palmar, fingers)])
    return np.round(PALM_DOWN @ axes.T @ palm_in_root.T, 12) + 0.0
