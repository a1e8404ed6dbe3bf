"""Where taxels may lie: the palmar sides of the links that a hand's file names; and the touch sensors
that a model has of its own, as taxels on links."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from ..state import Array
from ..validation import require_known
from . import model_file, mount
from .geometry import Geom, beside, geoms_of, meet, outside, posed, unit
from .hand import RADIUS, SEGMENTS, Pitch, Point, Surface
from .parts import DigitTable, Parts

PARALLEL = 0.99  # cosine
BEYOND = 0.01  # m that a fingertip, or a sensor, may lie off the shapes of its link
SENSORS = re.compile(r"(?i)sensor|taxel|tactile|touch")
LEAST, MOST = 1e-3, 0.02  # m, of radii


def of(parts: Parts) -> tuple[Surface, ...]:
    """The palmar sides of all segments, then of the palm at the bases of the fingers."""
    open_hand, found = posed(parts.model, parts.open_pose), []
    shift = parts.file.pitch.distal_shift
    tips = dict(zip(parts.digits, parts.tips(parts.model, open_hand), strict=True))
    for digit, (links, tip, sides) in parts.digits.items():
        for count, (link, segment) in enumerate(
            zip(links, _segments(len(links)), strict=True)
        ):
            body = parts.model.body(link).id
            away = tips[digit] - open_hand.xpos[body]
            towards = unit(
                open_hand.xmat[body].reshape(3, 3).T @ away, f"digits.{digit}.tip"
            )
            flexion = _flexion(parts, links[count:], open_hand)
            found.append(
                _segment(parts, digit, segment, link, towards, flexion, sides[count])
            )
        centre = np.array(found[-1].centre) + shift * np.array(found[-1].along)
        found[-1] = replace(found[-1], centre=tuple(centre))
        _require_on_link(parts, digit, links[-1], tip)
    bases = {d: about for d, about in parts.file.digits.items() if about.base}
    for digit, about in bases.items():
        found.append(_palm_side(parts, digit, about))
    return (*found, *([] if bases else [_palm_side(parts, "palm", None)]))


def pitch(parts: Parts, surfaces: tuple[Surface, ...]) -> Pitch:
    """Return the file's pitch, or what fits on the smallest segment."""
    table = parts.file.pitch
    segments = [surface for surface in surfaces if surface.segment != "palm"]
    rows: dict[str, float] = {}
    for surface in segments:
        low, high, _ = surface.span
        usual = rows.get(surface.segment, 5e-3)
        rows[surface.segment] = min(usual, 0.3 * (high - low))
    require_known(table.rows, rows)
    column = table.column
    if column is None:
        column = min(5e-3, 0.6 * min(surface.span[2] for surface in segments))
    return Pitch(rows | table.rows, column, table.radius, table.large_radius)


def _segments(n: int) -> tuple[str, ...]:
    """What `n` links from knuckle to tip are called."""
    between = [SEGMENTS[1], *(f"{SEGMENTS[1]}{k}" for k in range(2, n - 1))]
    return {1: SEGMENTS[2:], 2: SEGMENTS[::2]}.get(
        n, (SEGMENTS[0], *between, SEGMENTS[2])
    )


def _flexion(parts: Parts, links: tuple[str, ...], data: mujoco.MjData) -> list[Array]:
    """About what the first of these links and those beyond it turn when the hand closes, then about
    what turns them: unit vectors (3,) in the frame of the first. One against which the first is turned
    by more, as a link that stays parallel, counts the other way."""
    carried = _carried(parts, links[0], data, mount.HINGE)
    beyond = [
        move
        for link in links[1:]
        for move in _moves(parts, links[0], link, data, mount.HINGE)
    ]
    own = len(_moves(parts, links[0], links[0], data, mount.HINGE))
    net = sum((way * axis for way, axis in carried), np.zeros(3))
    axes = [axis for _, axis in carried[:own] + beyond + carried[own:]]
    return [-axis if axis @ net < 0 else axis for axis in axes]


def _carried(
    parts: Parts, link: str, data: mujoco.MjData, kind: Any
) -> list[tuple[float, Array]]:
    """How far, and about which axis, joints of a kind move a link, its own first."""
    body, found = parts.spec.body(link), []
    while body.name != "world":
        found += _moves(parts, link, body.name, data, kind)
        body = body.parent
    return found


def _moves(
    parts: Parts, own: str, link: str, data: mujoco.MjData, kind: Any
) -> list[tuple[float, Array]]:
    """How far a link's joints of a kind move when the hand closes, and their axes in that direction:
    unit vectors (3,) in the frame of the link `own`."""
    model, body = parts.model, parts.model.body(link)
    here, turn = data.xmat[model.body(own).id].reshape(3, 3), np.eye(3)
    if link != own:
        turn = np.round(here.T @ data.xmat[body.id].reshape(3, 3), 12)
    joints = range(body.jntadr[0], body.jntadr[0] + body.jntnum[0])
    chosen = [joint for joint in joints if model.jnt_type[joint] == int(kind)]
    ways = [parts.way(model.joint(joint).name) for joint in chosen]
    return [
        (abs(way), np.sign(way) * turn @ model.jnt_axis[joint])
        for joint, way in zip(chosen, ways, strict=True)
        if way
    ]


def _segment(
    parts: Parts, digit: str, segment: str, link: str, towards: Array, flexion: list[Array],
    side: Array | None,
) -> Surface:  # fmt: skip
    """The palmar side of a link: of a capsule along its axis, of anything else towards the tip.
    Closing turns that towards the palmar side, where nothing else is said."""
    geoms = geoms_of(parts.model, parts.model.body(link).id)
    if not geoms:
        raise ValueError(f"digits.{digit}: body {link!r} has no geom that collides")
    ends = (
        _bone(parts, link, geoms[0])
        if [geom.kind for geom in geoms] == ["capsule"]
        else None
    )
    along = towards if ends is None else unit(ends[1] - ends[0], link)
    if side is None:
        turning = next(
            (axis for axis in flexion if np.linalg.norm(np.cross(axis, along)) > 0.5),
            None,
        )
        if turning is not None:
            along = beside(along, turning) if ends is None else along
            side = unit(np.cross(turning, along), link)
    if side is None:  # what slides goes there
        data = posed(parts.model, parts.open_pose)
        slides = _carried(parts, link, data, mount.LINEAR)
        if not slides:
            hint = "say which side of it is palmar: palmar = [x, y, z]"
            raise ValueError(
                f"digits.{digit}: nothing in [closed] bends {link!r}; {hint}"
            )
        side = slides[0][1]
        along = (
            along if abs(side @ along) < PARALLEL else np.cross(side, np.roll(side, 1))
        )
    if ends is None:
        axes: dict[str, Any] = {
            "along": tuple(beside(along, side)),
            "palmar": tuple(side),
        }
        return _around(
            Surface(digit, segment, link, (0.0, 0.0, 0.0), **axes, geoms=geoms)
        )
    axes = {"along": tuple(along), "palmar": tuple(beside(side, along))}
    bone, radius = (tuple(ends[0]), tuple(ends[1])), geoms[0].size[0]
    return Surface(
        digit, segment, link, tuple(ends.mean(axis=0)), **axes, radius=radius, bone=bone
    )


def _around(surface: Surface) -> Surface:
    """With the middle of all of its geoms as its own, and their extent."""
    axes = np.array([surface.along, surface.across, surface.palmar])
    points = np.concatenate([geom.points for geom in surface.geoms]) @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    length, width, _ = (high - low) / 2
    return replace(
        surface,
        centre=tuple((low + high) / 2 @ axes),
        extent=(float(length), float(width)),
    )


def _bone(parts: Parts, link: str, capsule: Geom) -> Array:
    """Both ends (2, 3) of a capsule's axis, that at the joint first."""
    axis = np.array(capsule.rotation)[:, 2] * capsule.size[1]
    each = [np.array(capsule.position) + np.outer([-1.0, 1.0], axis)]
    written = [
        geom.fromto
        for geom in parts.spec.body(link).geoms
        if np.isfinite(geom.fromto).all()
    ]
    if len(written) == 1:
        each.append(np.array(written[0]).reshape(2, 3))
    ends, *own = (
        ends[np.argsort(np.linalg.norm(ends, axis=1), kind="stable")] for ends in each
    )
    # As the file has it, to the last digit, where that is in the link's frame.
    return own[0] if own and np.allclose(own[0], ends, atol=1e-6) else ends


def _palm_side(parts: Parts, digit: str, about: DigitTable | None) -> Surface:
    """Return the palm at a place: a plane where it is said to be flat, else whatever is there."""
    frame, base = parts.palm_frame, parts.palm_point
    if about is not None:
        if about.base_link is not None:
            frame = parts.frame(about.base_link, f"digits.{digit}.base_link")
        base = frame.point(about.base)
    body = parts.model.body(frame.link).id
    data = posed(parts.model, {})
    here, there = (data.xmat[b].reshape(3, 3) for b in (body, parts.palm))
    turn = np.round(here.T @ there, 12)
    along, palmar = (
        tuple((turn @ v + 0.0).tolist()) for v in (parts.fingers, parts.palmar)
    )
    plane = Surface(digit, "palm", frame.link, base, along, palmar)  # type: ignore[arg-type]
    if parts.file.palm_is_flat:
        return plane
    geoms = geoms_of(parts.model, body)
    if meet(geoms, np.array(base), -np.array(palmar)) is None:
        where = f"at {list(base)} on its palmar side"
        raise ValueError(f"palm: found no surface of body {frame.link!r} {where}")
    whole = replace(plane, geoms=geoms)
    return replace(_around(whole), centre=plane.centre) if about is None else whole


def _require_on_link(parts: Parts, digit: str, link: str, tip: Any) -> None:
    """ValueError for a fingertip that is not at its link."""
    away, _ = outside(geoms_of(parts.model, parts.model.body(link).id), np.array(tip))
    if away > BEYOND:
        found = f"found a point {1e3 * away:.1f} mm off body {link!r}"
        raise ValueError(
            f"digits.{digit}.tip: {found}, allowed up to {1e3 * BEYOND:g} mm"
        )


def sensors(parts: Parts) -> tuple[Point, ...]:
    """The sites of `<touch>` sensors, and what is fixed to a link and called a sensor, as in URDF.
    Those that are not at the skin of a link are left out."""
    links = {link for digit in parts.digits.values() for link in digit.links} | {
        parts.palm_frame.link
    }
    geoms = {link: geoms_of(parts.model, parts.model.body(link).id) for link in links}
    found = []
    named = [
        (n, at.link, at.place, RADIUS)
        for n, at in parts.welded.items()
        if SENSORS.search(n)
    ]
    for name, link, place, radius in (*_sites(parts), *named):
        if own := geoms.get(link):
            away, normal = outside(own, place)
            if abs(away) < BEYOND and normal.any():
                radius = float(np.clip(radius, LEAST, MOST))
                where = tuple(place.tolist()), tuple(normal.tolist())
                found.append(Point(link, *where, radius, name))
    return tuple(found)


def _sites(parts: Parts) -> list[tuple[str, str, Array, float]]:
    """Name, link, place on it (3,), m, and radius of each touch sensor."""
    touch = mujoco.mjtSensor.mjSENS_TOUCH
    sensors = model_file.read(parts.unread.model).sensors
    chosen = {sensor.objname for sensor in sensors if sensor.type == touch}
    sites = [
        parts.model.site(site.name) for site in parts.spec.sites if site.name in chosen
    ]
    links = (parts.model.body(site.bodyid[0]).name for site in sites)
    return [
        (site.name, link, site.pos, site.size[0])
        for site, link in zip(sites, links, strict=True)
    ]
