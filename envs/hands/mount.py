"""Fit a hand's model into a scene: parts left out, links, couplings and servos.

Position servos drive it: the model's own, in the units of their joints, or the
library's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fnmatch import filter as filter_names
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np

from ..validation import require_one_of
from . import model_file
from .hand import Coupling
from .tables import HandFile, HingeServo, Names, Servos

BASE = "base of all roots"
OBJECT, GROUND, GIVER = "object", "ground", "giver"
"""Names of what is in a scene besides the hand."""
KINDS = ("tendons", "actuators", "sites", "geoms", "bodies")  # of what can be left out
DEFAULT_RANGES = {mujoco.mjtJoint.mjJNT_HINGE: 1.57, mujoco.mjtJoint.mjJNT_SLIDE: 0.05}
"""End of the range that a driven joint without one gets, to both sides, rad or m."""
UNLIMITED = mujoco.mjtLimited.mjLIMITED_FALSE
FREE_JOINT = mujoco.mjtJoint.mjJNT_FREE
LOOPS = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD
HINGE, LINEAR = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
JOINT, TENDON = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON


def cleaned(model: Path, file: HandFile, visual: bool) -> mujoco.MjSpec:
    """Return a hand's model without what is left out, its bodies carried, on a single root.

    What is fixed to a body is not yet part of it. `visual` keeps what only pictures
    need.
    """
    spec = model_file.read(model)
    _leave_out(spec, file)
    spec = _with_one_root(spec, file.root)
    if not visual:
        with model_file.reading():
            spec.discard_visual()
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
        body.mass = file.masses.get(body.name, body.mass)
    return spec


def _leave_out(spec: mujoco.MjSpec, file: HandFile) -> None:
    """Delete what no hand needs.

    That is what the file says, what moves freely beside the hand, and what a scene has
    of its own or has no use for.
    """
    names = [each.name for kind in KINDS for each in getattr(spec, kind)]
    for pattern in file.drop:
        if not filter_names(names, pattern):
            raise ValueError(
                f"drop: found {pattern!r}, which nothing in the model is called"
            )
        for kind in KINDS:
            for element in reversed(list(getattr(spec, kind))):  # children first
                if element.name != "world" and fnmatchcase(element.name, pattern):
                    spec.delete(element)
    roots = list(spec.worldbody.bodies)
    if not file.root and not all(map(is_loose, roots)):
        for body in filter(is_loose, roots):
            spec.delete(body)
    used = {geom.meshname for geom in spec.geoms}
    for element in (
        *spec.sensors,
        *spec.lights,
        *spec.cameras,
        *spec.keys,
        *(mesh for mesh in spec.meshes if mesh.name not in used),
        *(equality for equality, *bodies in joined(spec) if "world" in bodies),
        *spec.worldbody.geoms,
    ):
        spec.delete(element)


def touch_only_others(spec: mujoco.MjSpec) -> None:
    """Have a hand collide with the object and the ground, and not with itself."""
    for pair in (*spec.pairs, *spec.excludes):
        spec.delete(pair)
    for geom in spec.geoms:  # a contype without conaffinity
        geom.contype = int(bool(geom.contype or geom.conaffinity))
        geom.conaffinity = 0


def fuse(spec: mujoco.MjSpec) -> None:
    """Make what is fixed to a link part of it."""
    for body in spec.bodies:
        body.fuse = is_fixed(body)
    spec.fuse_static()


def set_range(joint: mujoco.MjsJoint, low: float, high: float) -> None:
    """Give a joint a range, in rad or m."""
    joint.range = np.array([low, high]) / _unit(joint)
    joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE


def couple(spec: mujoco.MjSpec, couplings: Iterable[Coupling], servos: Servos) -> None:
    """Couple by an equality what a hand's file couples and its model does not.

    What follows another joint by one gets what a servo's joint has, or it yields under
    load.
    """
    tied = {part.target.name for tendon in spec.tendons for part in tendon.path
            if part.type == mujoco.mjtWrap.mjWRAP_JOINT}  # fmt: skip
    tied |= {coupling.joint for coupling in followed(spec)}
    for coupling in couplings:
        if coupling.joint not in tied:
            equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
            equality.name1, equality.name2 = coupling.joint, coupling.driver
            equality.data[:] = 0.0
            equality.data[0] = coupling.offset - _rest(spec, *coupling[:3])
            equality.data[1] = coupling.ratio
    for coupling in followed(spec):
        joint = spec.joint(coupling.joint)
        _damp(joint, _servo_of(joint, servos))


def drive(spec: mujoco.MjSpec, passive: Names, servos: Servos) -> None:
    """Have servos on the joints, measured in the joints' units.

    They are the model's, or where it has none the library's on all joints but those
    that follow another or are passive. All joints that are driven have a range.
    """
    for actuator in spec.actuators:
        measure_in_joints(spec, actuator)
    unmoved = {coupling.joint for coupling in followed(spec)}.union(passive)
    for joint in spec.joints if not spec.actuators else ():
        if joint.name not in unmoved:
            servo = _servo_of(joint, servos)
            _damp(joint, servo)
            add_servo(spec, joint.name, servo.gain, servo.limit)
    for actuator in spec.actuators:
        for joint in map(spec.joint, arms(spec, actuator)):
            if is_unranged(joint):
                end = DEFAULT_RANGES[joint.type]
                set_range(joint, -end, end)


def _with_one_root(spec: mujoco.MjSpec, root: str) -> mujoco.MjSpec:
    """Return the model with a single body at its root.

    A body that is named as root is all that there is, with what it carries, at rest.
    Otherwise several roots are put on one rigid base, and so is one that is in a frame
    or moves on a joint. Raise ValueError where there is none, or several move freely.
    """
    roots, whole = list(spec.worldbody.bodies), mujoco.MjSpec()
    if root:
        require_one_of([body.name for body in spec.bodies[1:]], root, "root")
        chosen = spec.body(root)
        for joint in chosen.joints:
            spec.delete(joint)
        whole.worldbody.add_frame().attach_body(chosen, "", "")
    else:
        for joint in roots[0].joints if len(roots) == 1 else ():
            if joint.type == FREE_JOINT:
                spec.delete(joint)
        if len(roots) == 1 and not (roots[0].frame or list(roots[0].joints)):
            return spec
        if not roots or any(map(is_loose, roots)):
            names = ", ".join(body.name for body in roots)
            raise ValueError(
                f"model: found {len(roots)} bodies at its root ({names}), allowed one, or some that "
                'are fixed; leave others out with drop = ["NAME"]'
            )
        base = whole.worldbody.add_body(name=BASE)
        # Where nothing is part of the base it is as light as can be: 1 g, 1e-6 kg m².
        if all(list(body.joints) for body in roots):
            base.mass, base.inertia, base.explicitinertial = 1e-3, [1e-6] * 3, True
        whole.attach(spec, prefix="", frame=base.add_frame())
    whole.modelfiledir, whole.meshdir = spec.modelfiledir, spec.meshdir
    whole.compiler.balanceinertia = spec.compiler.balanceinertia
    return whole


def chain(body: mujoco.MjsBody) -> list[str]:
    """Return what a body hangs on, from the root on, and itself."""
    return [] if body.name == "world" else [*chain(body.parent), body.name]


def loops(spec: mujoco.MjSpec) -> list[set[str]]:
    """Return the bodies of each loop that an equality of the model closes."""
    return [
        {*chain(spec.body(first))} ^ {*chain(spec.body(second))}
        for equality, first, second in joined(spec)
        if equality.active
    ]


def joined(spec: mujoco.MjSpec) -> Iterator[tuple[mujoco.MjsEquality, str, str]]:
    """Yield every weld and connection with the two bodies that it joins.

    Raise ValueError where one joins no bodies, but sites.
    """
    bodies = [body.name for body in spec.bodies]
    for equality in spec.equalities:
        if equality.type in LOOPS:
            first, second = equality.name1, equality.name2 or "world"
            for name in (first, second):
                require_one_of(bodies, name, "model: a body of an equality")
            yield equality, first, second


def is_loose(body: mujoco.MjsBody) -> bool:
    """Return whether a body moves by itself, or is moved from outside."""
    return bool(body.mocap) or any(joint.type == FREE_JOINT for joint in body.joints)


def is_fixed(body: mujoco.MjsBody) -> bool:
    """Return whether a body is fixed to another: not at the root, and without joints."""
    return (
        body.name != "world" and body.parent.name != "world" and not list(body.joints)
    )


def link_of(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """Return the body that moves by itself, or is at the root, and of which a body is a part."""
    return link_of(body.parent) if is_fixed(body) else body


def is_unranged(joint: mujoco.MjsJoint) -> bool:
    """Return whether a joint has no range."""
    is_auto = joint.limited == mujoco.mjtLimited.mjLIMITED_AUTO
    return joint.limited == UNLIMITED or bool(is_auto and np.ptp(joint.range) == 0)


def followed(spec: mujoco.MjSpec) -> Iterator[Coupling]:
    """Yield a coupling where an equality of the model couples two joints.

    The second drives, unless only the first has a servo. Raise ValueError where it is
    no straight line.
    """
    driven = {joint for actuator in spec.actuators for joint in arms(spec, actuator)}
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
            raise ValueError(
                f"model: found {joint!r} coupled to {driver!r} by {higher} beyond a straight "
                "line, allowed 0"
            )
        offset += _rest(spec, joint, driver, ratio)
        if joint in driven and driver not in driven and ratio:
            joint, driver, offset, ratio = driver, joint, -offset / ratio, 1 / ratio
        yield Coupling(joint, driver, ratio, offset, is_rigid=True)


def _unit(joint: mujoco.MjsJoint) -> float:
    """Return the unit of a joint's positions in its model: 1 or a degree in rad, or 1 m."""
    return (
        float(np.radians(1.0))
        if joint.compiler.degree and joint.type != LINEAR
        else 1.0
    )


def _rest(spec: mujoco.MjSpec, joint: str, driver: str, ratio: float) -> float:
    """Return what a coupled joint is beyond `ratio` times its driver where both are at their `ref`."""
    rest, of_driver = (
        each.ref * _unit(each) for each in map(spec.joint, (joint, driver))
    )
    return float(rest - ratio * of_driver)


# -- servos ----------------------------------------------------------------------------------


def add_servo(spec: mujoco.MjSpec, joint: str, gain: float, limit: float) -> None:
    """Add an actuator of the joint's name: force = gain x (target - position), at most `limit`."""
    usual = model_file.EMPTY_SPEC.default
    servo = spec.add_actuator(usual, name=joint, target=joint, trntype=JOINT)
    servo.forcelimited, servo.forcerange = True, [-limit, limit]
    servo.set_to_position(kp=gain)


def _servo_of(joint: mujoco.MjsJoint, servos: Servos) -> HingeServo:
    return servos.slide if joint.type == LINEAR else servos.hinge


def _damp(joint: mujoco.MjsJoint, servo: HingeServo) -> None:
    """Give a joint at least the damping and the armature of the library's servos."""
    joint.damping = np.maximum(joint.damping, [servo.damping, 0, 0])
    joint.armature = max(joint.armature, servo.armature)


def is_servo(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> bool:
    """Return whether an actuator pulls towards the position that is its control.

    It may pull a joint, or a tendon over joints.
    """
    is_affine = actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    is_fixed = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
    pulls = is_affine and is_fixed and actuator.gainprm[0] > 0 > actuator.biasprm[1]
    moves = sum(arms(spec, actuator).values()) > 0
    return bool(pulls and moves and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE)


def arms(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> dict[str, float]:
    """Return what each joint adds to the length of an actuator, per rad or m.

    It is empty where that depends on where they are.
    """
    gear = float(actuator.gear[0])
    if actuator.trntype == JOINT:
        return {actuator.target: gear}
    if actuator.trntype != TENDON:
        return {}
    path = list(spec.tendon(actuator.target).path)
    if any(part.type != mujoco.mjtWrap.mjWRAP_JOINT for part in path):
        return {}
    return {part.target.name: gear * float(part.coef) for part in path}


def measure_in_joints(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> None:
    """Make the control of a servo the position of its joint.

    Of a tendon, it is that of all its joints, as they are where the servo holds still.
    """
    gain, offset = actuator.gainprm[0], actuator.biasprm[0]
    stiffness, length = -actuator.biasprm[1], sum(arms(spec, actuator).values())
    if gain == stiffness and offset == 0 and length == 1:
        return
    ends = (gain * np.array(actuator.ctrlrange) + offset) / stiffness / length
    actuator.ctrlrange = np.sort(ends)
    actuator.gainprm[0], actuator.biasprm[0] = stiffness * length, 0.0


def servo_figures(
    model: mujoco.MjModel, name: str, joint: str
) -> tuple[float, float, float]:
    """Return stiffness, damping and largest force of a servo at its joint, in SI units."""
    servo, moved = model.actuator(name), model.joint(joint)
    gain = servo.gainprm[0]
    arm = float(gain / -servo.biasprm[1])  # force on the joint by the servo's
    damping = model.dof_damping[moved.dofadr[0]] - servo.biasprm[2]
    limit = gain * np.ptp(moved.range if moved.limited[0] else servo.ctrlrange)
    if servo.forcelimited[0]:
        limit = servo.forcerange[1]
    limit = float(limit) * arm
    if model.jnt_actfrclimited[moved.id]:  # as by a URDF's effort
        limit = min(limit, float(model.jnt_actfrcrange[moved.id, 1]))
    return float(gain * arm), float(damping), limit
