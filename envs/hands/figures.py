"""Hands made of primitives, from figures in a .toml file: bodies, joints, capsules.

Each [[body]] has a name, its ``parent`` (none: the root), ``pos`` and ``quat`` in the parent's frame;
one that moves has a ``joint`` with ``axis`` and ``range``, one that can be touched a ``capsule`` (both
ends of its axis) with a ``radius``. ``mass``, ``com``, ``inertia`` and ``inertia_quat`` say how heavy
it is; without, it is solid, of the density that is asked for. SI units, rad, quaternions wxyz.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from . import DIGITS, SEGMENTS, SLIDES, Hand, Surface

# contype without conaffinity: touches the object and the ground, not the hand itself.
LOOKS = {"contype": 1, "conaffinity": 0, "rgba": [0.75, 0.76, 0.8, 1.0]}
Figures = dict[str, dict[str, Any]]


@cache
def read(path: Path) -> Figures:
    """The bodies of a file by name, parents first."""
    bodies = tomllib.loads(path.read_text(encoding="utf-8"))["body"]
    return {body["name"]: body for body in bodies}


def joints(figures: Figures) -> tuple[str, ...]:
    """The hinges, in the order of the bodies."""
    return tuple(body["joint"] for body in figures.values() if "joint" in body)


def hand(name: str, figures: Figures, **more: Any) -> Hand:
    """A hand of these bodies: each joint has an actuator of its name, and digits end in body 3."""
    names = (*SLIDES, *joints(figures))
    tips = [f"{digit}3" for digit in DIGITS if f"{digit}3" in figures]
    return Hand(
        name=name,
        joints=names,
        actuators=names,
        actuated=names,
        palm="palm",
        fingertips=tuple((tip, tuple(figures[tip]["capsule"][3:])) for tip in tips),
        **more,
    )


def add_bodies(
    spec: mujoco.MjSpec, figures: Figures, damping: float, armature: float, density: float = 0.0
) -> mujoco.MjsBody:
    """All bodies, their hinges with `damping` (N m s/rad) and `armature` (kg m²); the root."""
    bodies = {"": spec.worldbody}
    for figure in figures.values():
        parent = bodies[figure.get("parent", "")]
        bodies[figure["name"]] = _add_body(parent, figure, damping, armature, density)
    return bodies[next(iter(figures))]


def _add_body(
    parent: mujoco.MjsBody, figure: dict[str, Any], damping: float, armature: float, density: float
) -> mujoco.MjsBody:
    body = parent.add_body(name=figure["name"], pos=figure["pos"], quat=figure["quat"], gravcomp=1.0)
    if "mass" in figure:
        body.mass, body.ipos, body.iquat = figure["mass"], figure["com"], figure["inertia_quat"]
        body.inertia, body.explicitinertial = figure["inertia"], True
    if "joint" in figure:
        body.add_joint(
            name=figure["joint"],
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=figure["axis"],
            range=figure["range"],
            limited=True,
            damping=[damping, 0, 0],
            armature=armature,
        )
    if "capsule" in figure:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=figure["capsule"],
            size=[figure["radius"], 0, 0],
            density=density,
            **LOOKS,
        )
    return body


def phalanges(figures: Figures, shifts: dict[str, float]) -> list[Surface]:
    """The palmar sides of bodies 1 to 3 of every digit, with the `shifts` (m) of their segments."""
    return [
        _phalanx(digit, segment, figures[f"{digit}{number}"], shifts.get(segment, 0.0))
        for digit in DIGITS
        for number, segment in enumerate(SEGMENTS, start=1)
        if f"{digit}{number}" in figures
    ]


def _phalanx(digit: str, segment: str, figure: dict[str, Any], shift: float) -> Surface:
    """The palmar side of a body, the grid `shift` m from the capsule's middle towards the tip."""
    ends = np.array(figure["capsule"]).reshape(2, 3)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    # Flexion turns the bone towards the palmar side.
    palmar = np.cross(figure.get("flexion", figure["axis"]), along)
    palmar /= np.linalg.norm(palmar)
    return Surface(
        digit=digit,
        segment=segment,
        link=figure["name"],
        centre=tuple(ends.mean(axis=0) + shift * along),
        along=tuple(along),
        palmar=tuple(palmar),
        radius=figure["radius"],
        bone=(tuple(ends[0]), tuple(ends[1])),
    )
