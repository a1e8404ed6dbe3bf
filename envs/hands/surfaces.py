"""Places for taxels: the palmar sides of the links that a hand's file names.

The touch sensors that a model has of its own become taxels on links, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np

from ..state import Array
from ..validation import require_known
from . import model_file
from .geometry import geoms_of, meet, outside, perpendicular, posed, unit
from .hand import RADIUS, SEGMENTS, Frame, Pitch, Point, Sensors, Surface
from .parts import Parts
from .tables import DigitTable

TURNED = 0.1  # rad: what closing turns less moves as a whole
STILL = 1e-4  # m, or rad m: a fingertip that moves less as its hand closes is still
OFF_SKIN = 0.01  # m that a fingertip, or a sensor, may lie off the shapes of its link
SENSORS = re.compile(r"(?i)sensor|taxel|tactile|touch|fsr")
MIN_RADIUS, MAX_RADIUS = 1e-3, 0.02  # m, of sensors
NANO = 9  # decimals of m that count of a place
ORIGIN = (0.0, 0.0, 0.0)


def of(parts: Parts) -> tuple[Surface, ...]:
    """Return the palmar sides of all segments, then of the palm at the bases of the fingers."""
    model, surfaces = parts.model, list[Surface]()
    data = posed(model, parts.opened | parts.followed(parts.opened))
    tips = parts.tips(data)
    mujoco.mj_comPos(model, data)
    ways, moves, turns = np.zeros(model.nv), *np.zeros((2, 3, model.nv))
    for joint in parts.joints:
        ways[model.joint(joint).dofadr] = parts.way(joint)
    for (name, digit), tip in zip(parts.digits.items(), tips, strict=True):
        last = digit.links[-1]
        mujoco.mj_jac(model, data, moves, turns, tip, model.body(last).id)
        links = [model.body(link).id for link in digit.links]
        move, axis = moves @ ways, turns @ (ways * np.isin(model.dof_bodyid, links))
        if np.linalg.norm(move) < STILL:
            move = tips.mean(axis=0) - tip
        segments = _segments(len(digit.links))
        for link, segment, side in zip(digit.links, segments, digit.sides, strict=True):
            body = data.body(link)
            way = np.array([tip - body.xpos, move, axis]) @ body.xmat.reshape(3, 3)
            empty = Surface(name, segment, link, ORIGIN, ORIGIN, ORIGIN)
            surfaces.append(_segment(parts, empty, way, side))
        end = surfaces[-1]
        shift = parts.file.pitch.distal_shift * np.array(end.along)
        surfaces[-1] = replace(end, centre=tuple(end.centre + shift))
        away, _ = outside(geoms_of(model, last), np.array(digit.tip))
        if away > OFF_SKIN:
            raise ValueError(
                f"digits.{name}.tip: found a point {1e3 * away:.1f} mm off body {last!r}, "
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


def _segment(parts: Parts, empty: Surface, way: Array, side: Array | None) -> Surface:
    """Return the palmar side of a link: the given one, or that to which closing turns or moves it.

    `way` (3, 3) is, in the link's frame, the way to the fingertip, how closing moves
    that, and the axis about which it turns the digit. Rows go along the axis of a
    capsule, else towards the tip.
    """
    where = f"digits.{empty.digit}: body {empty.link!r}"
    geoms, (along, move, axis) = geoms_of(parts.model, empty.link), way
    along = unit(along, where)
    if not geoms:
        raise ValueError(f"{where} has no geom that collides")
    is_capsule = [geom.kind for geom in geoms] == ["capsule"]
    if is_capsule:
        half = geoms[0].turn.apply([0.0, 0.0, geoms[0].size[1]])
        ends = geoms[0].position + np.outer([-1.0, 1.0], half)
        ends = np.round(ends, NANO)  # as a model's file has it
        ends = ends[np.argsort(np.linalg.norm(ends, axis=1), kind="stable")]
        bone = along = unit(ends[1] - ends[0], where)
    if side is None:
        if np.linalg.norm(np.cross(axis, along)) > TURNED:
            axis = np.round(unit(axis, where), 12)
            along = perpendicular(along, axis)
            move = np.cross(axis, along)
        side = unit(move, f"{where}: palmar")
    if is_capsule:
        return replace(
            empty,
            centre=tuple(ends.mean(axis=0)),
            along=tuple(bone),
            palmar=tuple(perpendicular(side, bone)),
            radius=geoms[0].size[0],
            bone=(tuple(ends[0]), tuple(ends[1])),
        )
    along = perpendicular(along, side)
    return _around(replace(empty, geoms=geoms, along=tuple(along), palmar=tuple(side)))


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

    It is a plane where the file says that the palm is flat, else what is met from the
    palmar side.
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
        # A sensor of a shape of its own is in the middle of it, where no side is the
        # nearest.
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
