"""Places for taxels: the palmar sides of the links that a hand's file names.

The touch sensors that a model has of its own become taxels on links, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from ..state import Array
from ..validation import require_known
from . import model_file, mount
from .geometry import geoms_of, meet, outside, perpendicular, posed, unit
from .hand import RADIUS, SEGMENTS, Frame, Pitch, Point, Sensors, Surface
from .parts import Parts
from .tables import DigitTable

OFF_SKIN = 0.01  # m that a fingertip, or a sensor, may lie off the shapes of its link
SENSORS = re.compile(r"(?i)sensor|taxel|tactile|touch|fsr")
MIN_RADIUS, MAX_RADIUS = 1e-3, 0.02  # m, of sensors
NANO = 9  # decimals of m that count of a place
ORIGIN = (0.0, 0.0, 0.0)


def of(parts: Parts) -> tuple[Surface, ...]:
    """Return the palmar sides of all segments, then of the palm at the bases of the fingers."""
    opened = parts.opened | parts.followed(parts.opened)
    data, surfaces = posed(parts.model, opened), []
    tips = parts.tips(data)
    for (name, digit), tip in zip(parts.digits.items(), tips, strict=True):
        segments = _segments(len(digit.links))
        for count, side in enumerate(digit.sides):
            links = digit.links[count:]
            body = data.body(links[0])
            turn = body.xmat.reshape(3, 3).T
            along = unit(turn @ (tip - body.xpos), f"digits.{name}.tip")
            inward = turn @ (tips.mean(axis=0) - body.xpos)
            empty = Surface(name, segments[count], links[0], ORIGIN, ORIGIN, ORIGIN)
            surfaces.append(_segment(parts, data, empty, links, along, inward, side))
        last = surfaces[-1]
        shift = parts.file.pitch.distal_shift * np.array(last.along)
        surfaces[-1] = replace(last, centre=tuple(last.centre + shift))
        away, _ = outside(geoms_of(parts.model, last.link), np.array(digit.tip))
        if away > OFF_SKIN:
            raise ValueError(
                f"digits.{name}.tip: found a point {1e3 * away:.1f} mm off body {last.link!r}, "
                f"allowed up to {1e3 * OFF_SKIN:g} mm"
            )
    bases = {name: digit for name, digit in parts.file.digits.items() if digit.base}
    palms = [_palm_side(parts, name, bases.get(name)) for name in bases or ["palm"]]
    return (*surfaces, *palms)


def pitch(parts: Parts, surfaces: tuple[Surface, ...]) -> Pitch:
    """Return the file's pitch, or rows that fit on the shortest of a segment, columns on each link."""
    table, columns = parts.file.pitch, dict[str, float]()
    rows: dict[str, float] = {}
    for side in surfaces:
        if side.segment != "palm":
            low, high, half_width = side.span
            shortest = rows.get(side.segment, 5e-3)
            rows[side.segment] = min(shortest, 0.3 * (high - low))
            columns[side.link] = table.column or min(5e-3, 0.6 * half_width)
    require_known(table.rows, rows)
    return Pitch(rows | table.rows, columns, table.radius, table.large_radius)


def _segments(n: int) -> tuple[str, ...]:
    """Return the names of the segments of a digit of `n` links, from knuckle to tip."""
    first, middle, last = SEGMENTS
    names = [first, middle, *(f"{middle}{number}" for number in range(2, n - 1))]
    return (*names[: n - 1], last)


def _segment(
    parts: Parts, data: mujoco.MjData, empty: Surface, links: tuple[str, ...], along: Array,
    inward: Array, side: Array | None,
) -> Surface:  # fmt: skip
    """Return the palmar side of the first of some links.

    Its rows go along the axis of a capsule, on anything else along the way to the tip.
    """
    geoms = geoms_of(parts.model, links[0])
    if not geoms:
        raise ValueError(
            f"digits.{empty.digit}: body {links[0]!r} has no geom that collides"
        )
    is_capsule = [geom.kind for geom in geoms] == ["capsule"]
    if is_capsule:
        half = geoms[0].turn.apply([0.0, 0.0, geoms[0].size[1]])
        ends = geoms[0].position + np.outer([-1.0, 1.0], half)
        ends = np.round(ends, NANO)  # as a model's file has it
        ends = ends[np.argsort(np.linalg.norm(ends, axis=1), kind="stable")]
        along = unit(ends[1] - ends[0], links[0])
    if side is None:
        side, to_tip = _palmar(parts, data, links, along, inward)
        along = along if is_capsule else to_tip
    if is_capsule:
        return replace(
            empty,
            centre=tuple(ends.mean(axis=0)),
            along=tuple(along),
            palmar=tuple(perpendicular(side, along)),
            radius=geoms[0].size[0],
            bone=(tuple(ends[0]), tuple(ends[1])),
        )
    along = perpendicular(along, side)
    return _around(replace(empty, geoms=geoms, along=tuple(along), palmar=tuple(side)))


def _palmar(
    parts: Parts, data: mujoco.MjData, links: tuple[str, ...], along: Array, inward: Array
) -> tuple[Array, Array]:  # fmt: skip
    """Return the palmar side of the first of some links, and its direction to the tip.

    Both are unit vectors (3,) in its frame. Closing turns the link to its palmar side: about its own
    joints, else about those beyond it, else about those that carry it. A link that slides goes there,
    and one that nothing moves faces `inward`.

    An axis against which the link is turned by more, as one that stays parallel, counts the other way.
    """
    turn = data.body(links[0]).xmat.reshape(3, 3).T

    def moves(bodies: Any, kind: Any) -> list[Array]:
        joints = [j for body in bodies for j in parts.spec.body(body).joints]
        ways = {
            joint.name: parts.way(joint.name) for joint in joints if joint.type == kind
        }
        return [
            way * np.round(turn @ data.joint(name).xaxis, 12)
            for name, way in ways.items()
            if way
        ]

    above = mount.chain(parts.spec.body(links[0]))[-2::-1]
    bending, carrying = moves(links[:1], mount.HINGE), moves(above, mount.HINGE)
    for move in bending + moves(links[1:], mount.HINGE) + carrying:
        axis = unit(move, links[0])
        axis = -axis if axis @ sum(bending + carrying, np.zeros(3)) < 0 else axis
        if np.linalg.norm(np.cross(axis, along)) > 0.5:
            along = perpendicular(along, axis)
            return unit(np.cross(axis, along), links[0]), along
    for move in moves([links[0], *above], mount.LINEAR):
        return unit(move, links[0]), along
    hint = f"nothing in [closed] bends {links[0]!r}; say palmar = [x, y, z]"
    return unit(inward - (inward @ along) * along, hint), along


def _around(surface: Surface) -> Surface:
    """Return a surface with the middle and the extent of all of its geoms."""
    axes = np.array([surface.along, surface.across, surface.palmar])
    points = np.concatenate([geom.points for geom in surface.geoms]) @ axes.T
    low, high = points.min(axis=0), points.max(axis=0)
    length, width, _ = ((high - low) / 2).tolist()
    centre = tuple((low + high) / 2 @ axes)
    return replace(surface, centre=centre, extent=(length, width))


def _palm_side(parts: Parts, name: str, digit: DigitTable | None) -> Surface:
    """Return the palm at the base of a digit, or at its own point.

    It is a plane where the file says that the palm is flat, else what is met from the palmar side.
    """
    frame, base = parts.palm_frame, parts.palm_point
    if digit is not None:
        if digit.base_link is not None:
            frame = parts.frame(digit.base_link, f"digits.{name}.base_link")
        base = frame.point(digit.base)
    data = posed(parts.model, {})
    link, palm = (data.body(b).xmat.reshape(3, 3) for b in (frame.link, parts.palm))
    turn = np.round(link.T @ palm, 12)
    along, palmar = (
        tuple((turn @ v + 0.0).tolist()) for v in (parts.fingers, parts.palmar)
    )
    plane = Surface(name, "palm", frame.link, base, along, palmar)  # type: ignore[arg-type]
    if parts.file.palm_is_flat:
        return plane
    geoms = geoms_of(parts.model, frame.link)
    if meet(geoms, np.array(base), -np.array(palmar)) is None:
        raise ValueError(
            f"palm: found no surface of body {frame.link!r} at {list(base)} on its palmar side"
        )
    whole = replace(plane, geoms=geoms)
    return replace(_around(whole), centre=plane.centre) if digit is None else whole


def sensors(parts: Parts) -> Sensors:
    """Return the touch sensors of the model that are at the skin of a link of the hand."""
    links = {parts.palm_frame.link}.union(*(d.links for d in parts.digits.values()))
    points, left_out = [], []
    for spot in _spots(parts):
        frame = parts.welded.get(spot.link, Frame(spot.link))
        place = np.array(frame.point(spot.position))
        geoms = geoms_of(parts.model, frame.link) if frame.link in links else ()
        others = [geom for geom in geoms if not np.allclose(geom.position, place)]
        # A sensor of a shape of its own is in the middle of it, where no side is the nearest.
        shapes = tuple(others) or geoms
        away, normal = outside(shapes, place) if geoms else (OFF_SKIN, place)
        if abs(away) >= OFF_SKIN or not normal.any():
            left_out.append(spot.name)
        else:
            radius = float(np.clip(spot.radius, MIN_RADIUS, MAX_RADIUS))
            at, outward = tuple(place.tolist()), tuple(normal.tolist())
            points.append(Point(frame.link, at, outward, radius, spot.name))
    return Sensors(tuple(points), tuple(left_out))


def _spots(parts: Parts) -> Iterator[Point]:
    """Yield every touch sensor of the model, whatever it lies on (`LOOKED_FOR`)."""
    whole, touch = model_file.read(parts.path), mujoco.mjtSensor.mjSENS_TOUCH
    touching = {each.objname for each in whole.sensors if each.type == touch}
    for site in map(parts.model.site, (site.name for site in parts.spec.sites)):
        if site.name in touching:
            link = parts.model.body(site.bodyid[0]).name
            yield Point(link, site.pos, (), site.size[0], site.name)
    for name in filter(SENSORS.search, parts.welded):
        yield Point(name, ORIGIN, (), RADIUS, name)
