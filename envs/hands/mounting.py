"""From a model's file to the hand of a scene: palm down on three slides, driven by position servos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fnmatch import filter as filter_names
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..state import Array
from . import models, servos
from .hand import SLIDES, Coupling
from .servos import LINEAR, SERVOS, SLIDE

BASE = "base of all roots"
FREE = mujoco.mjtJoint.mjJNT_FREE
LOOPS = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD
PALM_DOWN = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: where the palmar side, the fingers and their cross product point in the world."""


@dataclass(frozen=True)
class Mount:
    """Builds the hand of a scene from its model; plain values, so that it can be pickled."""

    model: Path
    palm: str
    drop: tuple[str, ...] = ()
    """Patterns of names of what is left out of the model: bodies, geoms, tendons, actuators, sites."""
    root: str = ""
    """The body from which on the model is the hand; all of it where it is empty."""
    fuses: bool = True
    """Are bodies that are fixed to a link part of it?"""
    keeps_servos: bool = True
    """Those of the model, if it has some."""
    couplings: tuple[Coupling, ...] = ()
    """Those of the hand's file."""
    passive: tuple[str, ...] = ()
    """Joints that get no servo."""
    ranges: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Of joints that have another than in the model, rad or m."""
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
            servos.add(spec, name, self.slides["gain"], self.slides["force"])
        for actuator in spec.actuators if finger_gain != 1.0 else ():
            moved = spec.joint(next(iter(servos.arms(spec, actuator)))).parent.name
            if moved not in chain(
                spec.body(self.palm)
            ):  # it moves a finger, and not the palm
                for figure in ("gainprm", "biasprm", "forcerange"):
                    setattr(
                        actuator,
                        figure,
                        np.array(getattr(actuator, figure)) * finger_gain,
                    )
        return spec

    def bare(self, visual: bool = False) -> mujoco.MjSpec:
        """The model with its joints and actuators as they will be, where its file has it."""
        spec = self.unfused(visual)
        if self.fuses and any(map(is_fixed, spec.bodies)):
            for body in spec.bodies:
                body.fuse = is_fixed(body)
            with models.quiet():
                spec.fuse_static()
        if (
            not self.keeps_contacts
        ):  # contype without conaffinity meets the object and the ground
            for pair in (*spec.pairs, *spec.excludes):
                spec.delete(pair)
            for geom in spec.geoms:
                geom.contype, geom.conaffinity = (
                    int(bool(geom.contype or geom.conaffinity)),
                    0,
                )
        self._couple(spec)
        self._drive(spec)
        return spec

    def unfused(self, visual: bool = False) -> mujoco.MjSpec:
        """The model without what is left out, its bodies carried, what is fixed to them not yet part of
        them."""
        spec = models.read(self.model)
        self._leave_out(spec)
        spec = _with_one_root(spec, self.root)
        if not visual:
            spec.discard_visual()
        for body in spec.bodies[1:]:
            body.gravcomp = 1.0
            body.mass = self.masses.get(body.name, body.mass)
        if self.fuses:
            for body in weightless(spec):
                if list(body.bodies):
                    body.mass, body.inertia = (
                        models.DUMMY["mass"],
                        models.DUMMY["inertia"],
                    )
                    body.explicitinertial = True
        for joint in spec.joints:
            if joint.name in self.ranges:
                joint.range = np.array(self.ranges[joint.name]) / _unit(joint)
                joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        return spec

    def _leave_out(self, spec: mujoco.MjSpec) -> None:
        """What the file says, and what a scene has of its own or has no use for."""
        kinds = ("bodies", "geoms", "tendons", "actuators", "sites")
        names = [element.name for kind in kinds for element in getattr(spec, kind)]
        for pattern in self.drop:
            if not filter_names(names, pattern):
                raise ValueError(
                    f"drop: found {pattern!r}, which nothing in the model is called"
                )
        for kind in kinds:
            elements = getattr(spec, kind)  # those that are left
            chosen = [element for element in elements if self._is_left_out(element)]
            if kind == "bodies":  # one takes along what hangs on it
                chosen = [
                    body
                    for body in chosen
                    if not any(map(self._is_left_out, _above(body)))
                ]
            for element in chosen:
                spec.delete(element)
        used = {geom.meshname for geom in spec.geoms}
        meshes = [mesh for mesh in spec.meshes if mesh.name not in used]
        flat = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD
        floors = [geom for geom in spec.worldbody.geoms if geom.type in flat]
        alone = len(list(spec.worldbody.bodies)) == 1
        floors += [
            geom for geom in spec.worldbody.geoms if alone and geom not in floors
        ]
        for element in (
            *spec.sensors,
            *spec.lights,
            *spec.cameras,
            *spec.keys,
            *meshes,
            *floors,
        ):
            spec.delete(element)

    def _is_left_out(self, element: Any) -> bool:
        is_named = any(fnmatchcase(element.name, pattern) for pattern in self.drop)
        return is_named and element.name != "world"

    def _couple(self, spec: mujoco.MjSpec) -> None:
        """By an equality, what the file couples and neither a tendon nor an equality of the model does;
        what follows another by one gets what a servo's joint has, or it yields under load."""
        if not self.fuses:
            return
        tied = {part.target.name for tendon in spec.tendons for part in tendon.path
                if part.type == mujoco.mjtWrap.mjWRAP_JOINT}  # fmt: skip
        tied |= {coupling.joint for coupling in followed(spec)}
        for coupling in self.couplings:
            if coupling.joint not in tied:
                equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
                equality.name1, equality.name2 = coupling.joint, coupling.driver
                law = np.zeros(len(equality.data))
                law[:2] = coupling.offset - _rest(spec, *coupling[:3]), coupling.ratio
                equality.data = law
        for coupling in followed(spec):
            joint = spec.joint(coupling.joint)
            servos.damp(joint, self._figures(joint))

    def _drive(self, spec: mujoco.MjSpec) -> None:
        """The model's servos in the units of their joints, or the library's on all joints but those
        that follow another or are passive."""
        if not self.keeps_servos:
            for actuator in spec.actuators:
                spec.delete(actuator)
        for actuator in spec.actuators:
            if self.fuses and servos.is_servo(spec, actuator):
                servos.measure_in_joints(spec, actuator)
        if spec.actuators:
            return
        followers = {coupling.joint for coupling in followed(spec)}
        for joint in spec.joints:
            if joint.name not in followers and joint.name not in self.passive:
                figures = self._figures(joint)
                servos.damp(joint, figures)
                servos.add(spec, joint.name, figures["gain"], figures["limit"])

    def _figures(self, joint: mujoco.MjsJoint) -> dict[str, float]:
        kind = "slide" if joint.type == LINEAR else "hinge"
        return {**SERVOS[kind], **self.servos.get(kind, {})}


def _above(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """What a body hangs on, up to the world."""
    while body.name != "world":
        body = body.parent
        yield body


def _with_one_root(spec: mujoco.MjSpec, root: str) -> mujoco.MjSpec:
    """Several bodies at the root are on one rigid base, and so is one that is in a frame or moves on a
    joint; a body that is named as root is all that there is, with what it carries, at rest. ValueError
    where there is none, or some move freely."""
    roots, chosen = list(spec.worldbody.bodies), spec.body(root) if root else None
    if root and chosen is None:
        raise ValueError(f"root: found no body {root!r} in the model")
    if not root and len(roots) == 1:
        for joint in roots[0].joints:
            if joint.type == FREE:
                spec.delete(joint)
        if roots[0].frame is None and not list(roots[0].joints):
            return spec
    elif not root and (not roots or any(map(is_loose, roots))):
        found = f"found {len(roots)} bodies at its root ({', '.join(root.name for root in roots)})"
        hint = 'or several that are fixed; leave others out with drop = ["NAME"]'
        raise ValueError(f"model: {found}, allowed one, {hint}")
    whole = mujoco.MjSpec()
    with models.quiet():  # names stay as they are
        if chosen is None:
            base = whole.worldbody.add_body(name=BASE)
            whole.attach(spec, prefix="", frame=base.add_frame())
            if all(
                list(body.joints) for body in roots
            ):  # nothing of it is part of the base
                base.mass, base.inertia = models.DUMMY["mass"], models.DUMMY["inertia"]
                base.explicitinertial = True
        else:
            for joint in chosen.joints:
                spec.delete(joint)
            whole.worldbody.add_frame().attach_body(chosen, "", "")
    whole.modelfiledir, whole.meshdir = spec.modelfiledir, spec.meshdir
    whole.texturedir = spec.texturedir
    whole.compiler.fusestatic = False
    whole.compiler.balanceinertia = spec.compiler.balanceinertia
    return whole


def chain(body: mujoco.MjsBody) -> list[str]:
    """What a body hangs on, from the root on, and itself."""
    return [each.name for each in (body, *_above(body))][-2::-1]


def loops(spec: mujoco.MjSpec) -> list[set[str]]:
    """The bodies of each loop that an equality of the model closes."""
    found = []
    for equality in spec.equalities:
        if equality.type in LOOPS and equality.active and equality.name2:
            ends = equality.name1, equality.name2
            if equality.objtype == mujoco.mjtObj.mjOBJ_SITE:
                ends = tuple(spec.site(name).parent.name for name in ends)
            first, second = (set(chain(spec.body(name))) for name in ends)
            found.append(first ^ second)
    return found


def is_loose(body: mujoco.MjsBody) -> bool:
    """Does it move by itself, or is it moved from outside?"""
    return bool(body.mocap) or any(joint.type == FREE for joint in body.joints)


def is_fixed(body: mujoco.MjsBody) -> bool:
    """To another body, that is: not at the root, and without joints."""
    return (
        body.name != "world" and body.parent.name != "world" and not list(body.joints)
    )


def weightless(spec: mujoco.MjSpec) -> list[mujoco.MjsBody]:
    """Bodies on joints that have neither a mass nor, they or what is fixed to them, a shape."""

    def weighs(body: mujoco.MjsBody) -> bool:
        fixed = (weighs(child) for child in body.bodies if not list(child.joints))
        return bool(body.mass > 0 or list(body.geoms) or any(fixed))

    return [body for body in spec.bodies[1:] if list(body.joints) and not weighs(body)]


def _quaternion(rotation: Array) -> Array:
    turn = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(turn))
    return np.array(
        [
            np.cos(angle / 2),
            *(np.sin(angle / 2) * np.round(turn / max(angle, 1e-9), 12)),
        ]
    )


def followed(spec: mujoco.MjSpec) -> Iterator[Coupling]:
    """Where an equality of the model couples two joints: the second drives, unless only the first has
    a servo; ValueError where not by a straight line."""
    driven = {
        joint for actuator in spec.actuators for joint in servos.arms(spec, actuator)
    }
    for equality in spec.equalities:
        if (
            equality.type != mujoco.mjtEq.mjEQ_JOINT
            or not equality.name2
            or not equality.active
        ):
            continue
        joint, driver = equality.name1, equality.name2
        offset, ratio, *higher = (float(value) for value in equality.data[:5])
        if any(higher):
            found = f"found {joint!r} coupled to {driver!r} by {higher}"
            raise ValueError(f"model: {found} beyond a straight line, allowed 0")
        offset += _rest(spec, joint, driver, ratio)
        if joint in driven and driver not in driven and ratio:
            joint, driver, offset, ratio = driver, joint, -offset / ratio, 1 / ratio
        yield Coupling(joint, driver, ratio, offset, is_rigid=True)


def _unit(joint: mujoco.MjsJoint) -> float:
    """Of a joint's angles in its model: 1 or a degree, rad; of what slides 1 m."""
    return (
        float(np.radians(1.0))
        if joint.compiler.degree and joint.type != LINEAR
        else 1.0
    )


def _rest(spec: mujoco.MjSpec, joint: str, driver: str, ratio: float) -> float:
    """What a coupled joint is beyond `ratio` times its driver where both are at their `ref`."""
    rest, of_driver = (
        each.ref * _unit(each) for each in map(spec.joint, (joint, driver))
    )
    return float(rest - ratio * of_driver)


def turned(palm_in_root: Array, palmar: Array, fingers: Array) -> Array:
    """The rotation (3, 3) of the root with which the palm (3, 3) looks down, fingers along -y."""
    axes = np.column_stack([palmar, fingers, np.cross(palmar, fingers)])
    return np.round(PALM_DOWN @ axes.T @ palm_in_root.T, 12) + 0.0
