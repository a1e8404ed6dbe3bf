"""What can be seen to be wrong with a hand before anybody uses it: posed, and closed in the air."""

from __future__ import annotations

from typing import Annotated

import mujoco
import numpy as np

from ..state import Array
from . import model_file, mount
from .geometry import placed, posed, touching
from .hand import SLIDES, Hand
from .parts import Parts

Timestep = Annotated[float, "[1e-05, 1.0]"]
NUDGE, STILL, MOST_MOVED = (
    0.02,
    0.4,
    0.2,
)  # rad, s, rad: of a hand that should hang still
CLOSING, LOOKS = 1.0, 20  # s; a scripted grasp takes that long
PRESS, REACHED = (
    0.3,
    0.7,
)  # N at each fingertip, and the share of its way that a servo goes against it
GROUND = "ground of the check"
DEEP, ALIKE = (
    0.01,
    0.5,
)  # m, and cosine between palmar sides: of digits that may be in each other
IN_GROUND = 1e-3  # m


def examine(hand: Hand, parts: Parts, timestep: float) -> tuple[str, ...]:
    """What to know of it; ValueError for a hand that nobody can mean."""
    spec = hand.build()
    spec.option.timestep = timestep
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name=GROUND, type=plane, size=[1, 1, 0.1], contype=0, conaffinity=0
    )
    model = model_file.compiled(spec)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    _require_still(hand, model, timestep)
    if not hand.closed:
        return ()
    _require_palmar(parts)
    _require_above_ground(hand, model)
    data, reached = _closed(hand, model, timestep)
    _require_apart(hand, model, data)
    own = parts.raw.actuators and not parts.replaced
    return _weak(hand, reached) if own else ()


def _begun(hand: Hand, model: mujoco.MjModel, nudge: float = 0.0) -> mujoco.MjData:
    """At the start, the fingers' joints moved a little."""
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in hand.joints]
    low, high = np.array(
        [j.range if j.limited[0] else (-np.inf, np.inf) for j in joints]
    ).T
    moved = np.where(np.isin(hand.joints, SLIDES), 0.0, nudge)
    data.qpos[_places(model, hand.joints)] = np.clip(
        hand.start_positions() + moved, low, high
    )
    mount.hold(model, data, _actuators(hand, model), hand.start_targets())
    return data


def _places(model: mujoco.MjModel, joints: tuple[str, ...]) -> list[int]:
    """Of joints in qpos."""
    return [int(model.joint(joint).qposadr[0]) for joint in joints]


def _actuators(hand: Hand, model: mujoco.MjModel) -> list[int]:
    return [int(model.actuator(name).id) for name in hand.actuators]


def _require_still(hand: Hand, model: mujoco.MjModel, timestep: float) -> None:
    """ValueError for a model that does not hang still where it starts, its joints a little moved."""
    data, where = _begun(hand, model, NUDGE), _places(model, hand.joints)
    begin = data.qpos[where]
    mujoco.mj_step(model, data, round(STILL / timestep))
    moved = np.nan_to_num(np.abs(data.qpos[where] - begin), nan=np.inf)
    held = [*hand.actuated, *(coupling.joint for coupling in hand.couplings)]
    moved[~np.isin(hand.joints, held)] = 0.0  # nothing holds the others
    worst = int(np.argmax(moved))
    if moved[worst] > MOST_MOVED:
        raise ValueError(
            f"model: does not hang still: joint {hand.joints[worst]!r} moves by {moved[worst]:.2g} "
            f"within {STILL:g} s; look at its servo's gain and damping, or at what it touches"
        )


def _require_palmar(parts: Parts) -> None:
    """ValueError where the closed fingertips are on the other side of the palm."""
    depths = []
    for share in (0.5, 1.0):
        data = posed(parts.model, parts.pose(share))
        up = data.xmat[parts.palm].reshape(3, 3) @ parts.palmar
        point = placed(data, parts.palm_frame.link, parts.palm_point)
        depths.append(float((parts.tips(parts.model, data) - point).mean(axis=0) @ up))
    if max(depths) < 0:
        found = list(parts.file.palmar)
        meant = [0 - value for value in found]
        raise ValueError(
            f"palmar: found {found}, but the closed fingertips are {-1e3 * max(depths):.0f} mm behind "
            f"the palm; did you mean {meant}? Else look at [closed]"
        )


def _require_above_ground(hand: Hand, model: mujoco.MjModel) -> None:
    """ValueError where the hand starts in the ground."""
    data = _begun(hand, model)
    ground = model.geom(GROUND).id
    depth = -min(
        (contact.dist for contact in touching(model, data) if ground in contact.geom),
        default=0,
    )
    if depth > IN_GROUND:
        raise ValueError(
            f"place: with this the hand starts {1e3 * depth:.0f} mm in the ground"
        )


def _closed(
    hand: Hand, model: mujoco.MjModel, timestep: float
) -> tuple[mujoco.MjData, Array]:
    """Where the servos bring it in the air while something presses against each fingertip, and the
    mean positions of the actuated joints in the second half of that."""
    data = _begun(hand, model)
    mujoco.mj_forward(model, data)
    tips = {link: placed(data, link, tip) for link, tip in hand.fingertips}
    targets = hand.start_targets()
    for k, (actuator, joint) in enumerate(
        zip(hand.actuators, hand.actuated, strict=True)
    ):
        moved = model.joint(joint)
        way = hand.closed.get(actuator, targets[k]) - targets[k]
        carried = [
            tip
            for link, tip in tips.items()
            if _carries(model, int(moved.bodyid[0]), link)
        ]
        arms = [
            np.linalg.norm(np.cross(data.xaxis[moved.id], tip - data.xanchor[moved.id]))
            for tip in carried
        ]
        slides = model.jnt_type[moved.id] == int(mount.LINEAR)
        lever = len(carried) if slides else sum(map(float, arms))
        data.qfrc_applied[moved.dofadr[0]] = -np.sign(way) * PRESS * lever
        targets[k] += way
    data.ctrl[_actuators(hand, model)] = targets
    seen = []
    for _ in range(LOOKS):
        mujoco.mj_step(model, data, round(CLOSING / timestep / LOOKS))
        seen.append(data.qpos[_places(model, hand.actuated)])
    return data, np.mean(seen[LOOKS // 2 :], axis=0)


def _carries(model: mujoco.MjModel, body: int, link: str) -> bool:
    """Does a body carry a link, or is it that?"""
    each = int(model.body(link).id)
    while each > body:
        each = int(model.body_parentid[each])
    return each == body


def _weak(hand: Hand, reached: Array) -> tuple[str, ...]:
    """What servos do not reach."""
    shares, shared = {}, {each.driver for each in hand.couplings if not each.is_rigid}
    ends = zip(
        hand.actuators, hand.actuated, hand.start_targets(), reached, strict=True
    )
    for actuator, joint, start, end in ends:
        way = hand.closed.get(actuator, start) - start
        if (
            abs(way) > NUDGE and joint not in shared
        ):  # of a tendon another joint may go the way
            shares[actuator] = float((end - start) / way)
    weak = {name: share for name, share in shares.items() if not share >= REACHED}
    if not weak:
        return ()
    worst, names = max(0.0, min(weak.values())), ", ".join(list(weak)[:4])
    found = f"{len(weak)} of {len(shares)} servos are weak or slow ({names})"
    does = f"against {PRESS:g} N at the fingertips they go {100 * worst:.0f} % of their way or more"
    return (
        f"{found}: in {CLOSING:g} s and {does}; drop them, and joints get the library's",
    )


def _require_apart(hand: Hand, model: mujoco.MjModel, closed: mujoco.MjData) -> None:
    """ValueError where digits of the closed hand that lie side by side are deep in each other. Those
    that oppose each other press."""
    surfaces = {
        surface.link: surface for surface in hand.surfaces if surface.segment != "palm"
    }
    begun = _begun(hand, model)
    mujoco.mj_kinematics(model, begun)
    for contact in touching(model, closed):
        links = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
        if contact.dist >= -DEEP or not all(link in surfaces for link in links):
            continue
        first, second = (surfaces[link] for link in links)
        sides = [
            begun.body(s.link).xmat.reshape(3, 3) @ s.palmar for s in (first, second)
        ]
        digits = {first.digit, second.digit}
        if len(digits - {"thumb"}) == 2 and sides[0] @ sides[1] > ALIKE:
            found = f"{links[0]} ({first.digit}) is {-1e3 * contact.dist:.0f} mm in {links[1]}"
            allowed = f"allowed up to {1e3 * DEEP:g} mm: close them less"
            raise ValueError(f"closed: {found} ({second.digit}), {allowed}")
