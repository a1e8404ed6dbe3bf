"""The touch sensors that a model has of its own, as taxels on links."""

from __future__ import annotations

import re

import mujoco
import numpy as np

from ..taxel_files import RADIUS, Point
from . import models
from .parts import Parts
from .skins import geoms_of, outside

WORDS = re.compile(r"(?i)sensor|taxel|tactile|touch")
NEAR = 0.01  # m from its link's skin that a sensor may be
LEAST, MOST = 1e-3, 0.02  # m, of radii


def of(parts: Parts) -> tuple[Point, ...]:
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
        if WORDS.search(n)
    ]
    for name, link, place, radius in (*_sites(parts), *named):
        if own := geoms.get(link):
            away, normal = outside(own, place)
            if abs(away) < NEAR and normal.any():
                radius = float(np.clip(radius, LEAST, MOST))
                found.append(
                    Point(
                        link,
                        tuple(place.tolist()),
                        tuple(normal.tolist()),
                        radius,
                        name,
                    )
                )
    return tuple(found)


def _sites(parts: Parts) -> list[tuple[str, str, np.ndarray, float]]:
    """Name, link, place on it (3,), m, and radius of each touch sensor."""
    touch = mujoco.mjtSensor.mjSENS_TOUCH
    sensors = models.read(parts.asked.model).sensors
    chosen = {sensor.objname for sensor in sensors if sensor.type == touch}
    sites = [
        parts.model.site(site.name) for site in parts.spec.sites if site.name in chosen
    ]
    links = (parts.model.body(site.bodyid[0]).name for site in sites)
    return [
        (site.name, link, site.pos, site.size[0])
        for site, link in zip(sites, links, strict=True)
    ]
