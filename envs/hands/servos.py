"""What hands have in common as models: position servos, and the slides that carry them."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from . import SLIDES


def add_servo(spec: mujoco.MjSpec, joint: str, gain: float, limit: float) -> None:
    """An actuator of the joint's name: force = gain x (target - position), at most `limit`.

    Gain in N/m or N m/rad, limit in N or N m.
    """
    spec.add_actuator(
        name=joint,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gainprm=[gain] + [0] * 9,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=[0, -gain] + [0] * 8,
        forcelimited=True,
        forcerange=[-limit, limit],
    )


def add_slides(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    axes: Sequence[Sequence[float]],
    gain: float,
    damping: float,
    force: float,
) -> None:
    """Joints and servos SLIDES on `body`: world x, y, z, whose `axes` are in its frame.

    Gain in N/m, damping in N s/m, force limit in N.
    """
    for name, axis in zip(SLIDES, axes, strict=True):
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, damping=[damping, 0, 0])
        add_servo(spec, name, gain, force)
