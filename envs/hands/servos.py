"""Position servos: the library's own, and those of a model in the units of the joints they drive."""

from __future__ import annotations

import mujoco
import numpy as np

from ..state import Array

SLIDE = {"gain": 1000.0, "damping": 79.0, "force": 30.0}
"""N/m, N s/m, N. Without a limit on its force the hand would be pressed into the ground."""
SERVOS = {
    "hinge": {"gain": 10.0, "damping": 0.5, "armature": 0.01, "limit": 1.0},
    "slide": {"gain": 1000.0, "damping": 50.0, "armature": 0.1, "limit": 20.0},
}
"""Of joints whose model has no servos: N m/rad, N m s/rad, kg m², N m; for slides N/m and so on."""
HINGE, LINEAR = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
JOINT, TENDON = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON
DYNAMICS = (
    mujoco.mjtDyn.mjDYN_NONE,
    mujoco.mjtDyn.mjDYN_FILTER,
    mujoco.mjtDyn.mjDYN_FILTEREXACT,
)


def add(spec: mujoco.MjSpec, joint: str, gain: float, limit: float) -> None:
    """An actuator of the joint's name: force = gain x (target - position), at most `limit`."""
    servo = spec.add_actuator(name=joint, target=joint, trntype=JOINT)
    servo.forcelimited, servo.forcerange = True, [-limit, limit]
    servo.set_to_position(kp=gain)


def damp(joint: mujoco.MjsJoint, figures: dict[str, float]) -> None:
    """At least the damping and the armature of the library's servos."""
    joint.damping = np.maximum(joint.damping, [figures["damping"], 0, 0])
    joint.armature = max(joint.armature, figures["armature"])


def is_servo(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> bool:
    """Does it pull a joint, or a tendon over joints, towards the position that is its control?"""
    is_affine = actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    is_fixed = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
    pulls = is_affine and is_fixed and actuator.gainprm[0] > 0 > actuator.biasprm[1]
    moves = sum(arms(spec, actuator).values()) > 0
    return bool(pulls and moves and actuator.dyntype in DYNAMICS)


def arms(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> dict[str, float]:
    """What each joint adds to the length of an actuator, per rad or m; {} where that depends on where
    they are."""
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
    """Have the control of a servo be the position of its joint, or of all joints of its tendon, as
    they are where the servo holds still."""
    gain, offset, stiffness = (
        actuator.gainprm[0],
        actuator.biasprm[0],
        -actuator.biasprm[1],
    )
    length = sum(arms(spec, actuator).values())
    if gain == stiffness and offset == 0 and length == 1:
        return
    ends = (gain * np.array(actuator.ctrlrange) + offset) / stiffness / length
    actuator.ctrlrange = np.sort(ends)
    gains, biases = np.array(actuator.gainprm), np.array(actuator.biasprm)
    gains[0], biases[0] = stiffness * length, 0.0
    actuator.gainprm, actuator.biasprm = gains, biases


def hold(
    model: mujoco.MjModel, data: mujoco.MjData, actuators: list[int], targets: Array
) -> None:
    """Have servos hold these targets from now on, and before: in what they filter and delay, too."""
    data.ctrl[actuators] = targets
    for actuator, target in zip(actuators, targets, strict=True):
        if model.actuator_actnum[actuator]:
            data.act[model.actuator_actadr[actuator]] = target
        if n := int(model.actuator_history[actuator, 0]):
            mujoco.mj_initCtrlHistory(
                model, data, actuator, None, np.full((n, 1), target)
            )
