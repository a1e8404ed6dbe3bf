"""Say what is wrong with a hand before anybody uses it: posed, and closed in the air."""

from __future__ import annotations

from typing import Annotated

import mujoco
import numpy as np

from . import model_file, mount
from .geometry import placed, posed
from .hand import Hand
from .parts import Parts

Timestep = Annotated[float, "[1e-05, 1.0]"]
NUDGE, STILL, MOST_MOVED, GONE = 0.02, 0.4, 0.2, 10.0
"""rad or m, s, rad or m twice: of a hand that should hang still, its joints moved a
little."""
CLOSING = 1.0  # s; a scripted grasp takes that long
PRESS, REACHED = 0.3, 0.7
"""N at each fingertip, and the share of its way that a servo goes against it."""


def examine(hand: Hand, parts: Parts, timestep: float) -> tuple[str, ...]:
    """Return warnings about a hand.

    Raise ValueError if it does not hang still, or closes away from its palm.
    """
    model = model_file.compiled(hand.build())
    model.opt.timestep = timestep
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    _require_still(hand, model)
    if not hand.closed:
        return ()
    _require_palmar(parts)
    has_own_servos = parts.raw.actuators and not parts.misfits
    return _weak(hand, model) if has_own_servos else ()


def _begun(hand: Hand, model: mujoco.MjModel) -> mujoco.MjData:
    """Return the hand at its start."""
    data = mujoco.MjData(model)
    for joint, position in zip(hand.joints, hand.start_positions(), strict=True):
        data.joint(joint).qpos = position
    for actuator, target in zip(hand.actuators, hand.start_targets(), strict=True):
        data.actuator(actuator).ctrl = target
    return data


def _require_still(hand: Hand, model: mujoco.MjModel) -> None:
    """Raise ValueError for a model that does not hang still where it starts.

    Its joints are moved a little before.
    """
    data = _begun(hand, model)
    data.qpos += NUDGE
    held = [*hand.actuated, *(coupling.joint for coupling in hand.couplings)]
    places = [int(model.joint(joint).qposadr[0]) for joint in held]
    before = data.qpos[places]
    for _ in range(round(STILL / model.opt.timestep)):
        mujoco.mj_step(model, data)
        moved = np.nan_to_num(np.abs(data.qpos[places] - before), nan=np.inf)
        if moved.max() > GONE:  # whoever is first is the cause
            break
    worst = int(np.argmax(moved))
    if moved[worst] <= MOST_MOVED:
        return
    raise ValueError(
        f"model: does not hang still: joint {held[worst]!r} moves by {moved[worst]:.2g} within "
        f"{STILL:g} s; look at its servo's gain and damping, or at what it touches, or drop the servos"
    )


def _require_palmar(parts: Parts) -> None:
    """Raise ValueError where the closed fingertips are on the other side of the palm."""
    depths = []
    for share in (0.5, 1.0):
        data = posed(parts.model, parts.pose(share))
        up = data.xmat[parts.palm].reshape(3, 3) @ parts.palmar
        point = placed(data, parts.palm_frame.link, parts.palm_point)
        depths.append(float((parts.tips(data) - point).mean(axis=0) @ up))
    if max(depths) < 0:
        raise ValueError(
            f"palmar: found {list(parts.file.palmar)}, but the closed fingertips are "
            f"{-1e3 * max(depths):.0f} mm behind the palm; did you mean "
            f"{[0 - value for value in parts.file.palmar]}? Else look at [closed]"
        )


def _weak(hand: Hand, model: mujoco.MjModel) -> tuple[str, ...]:
    """Return a note naming servos that do not close the hand in time.

    Meanwhile something presses against each fingertip. It names none of a tendon of
    which another joint may go the way.
    """
    data = _begun(hand, model)
    mujoco.mj_forward(model, data)
    levers, jacobian = np.zeros(model.nv), np.zeros((3, model.nv))
    for link, tip in hand.fingertips:
        body, point = model.body(link).id, placed(data, link, tip)
        mujoco.mj_jac(model, data, jacobian, None, point, body)
        levers += np.linalg.norm(jacobian, axis=0)
    shared = {each.driver for each in hand.couplings if not each.is_rigid}
    shares = {}
    for name, joint, start in zip(
        hand.actuators, hand.actuated, hand.start_targets(), strict=True
    ):
        way = abs(hand.closed.get(name, start) - start)
        if way > NUDGE and joint not in shared:
            stiffness, damping, limit = mount.servo_figures(model, name, joint)
            pressed = PRESS * levers[model.joint(joint).dofadr[0]]
            held_back = pressed / stiffness if pressed < limit else way
            late = np.exp(-0.75 * CLOSING * stiffness / damping) if damping > 0 else 0.0
            shares[name] = (1 - held_back / way) * (1 - late)
    weak = [name for name, share in shares.items() if share < REACHED]
    if not weak:
        return ()
    worst = max(0.0, min(shares.values()))
    return (
        f"{len(weak)} of {len(shares)} servos are weak or slow ({', '.join(weak[:4])}): in "
        f"{CLOSING:g} s and against {PRESS:g} N at the fingertips the weakest goes "
        f"{100 * worst:.0f} % of its way; drop all servos, and joints get the library's",
    )
