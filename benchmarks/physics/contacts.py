"""What a simulator itself knows of contacts between hand and object, and how to make it find others."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from tactilerl.envs.grasp import GraspEnv

FAR = 0.01  # m: from there on distances do not matter


def deepest(env: GraspEnv) -> float:
    """How far hand and object overlap now, m."""
    sim: Any = env.simulator
    if env.config.simulator == "pybullet":
        from tactilerl.envs.simulators.pybullet import pybullet

        points = pybullet.getContactPoints(sim.hand, sim.object, physicsClientId=sim.client)
        return -min([point[8] for point in points], default=0.0)
    thing, ground = sim.model.geom("object").id, sim.model.geom("ground").id
    touching = (c for c in sim.data.contact if thing in c.geom and ground not in c.geom)
    return -min((contact.dist for contact in touching), default=0.0)


def distances(env: GraspEnv, links: tuple[str, ...]) -> np.ndarray:
    """The simulator's own distance (k,) of each link from the object, m, at most FAR."""
    sim: Any = env.simulator
    if env.config.simulator == "pybullet":
        from tactilerl.envs.simulators.pybullet import pybullet

        found = pybullet.getClosestPoints(sim.hand, sim.object, FAR, physicsClientId=sim.client)
        numbers = [sim._links[link] for link in links]
        return np.array([min([p[8] for p in found if p[3] == n], default=FAR) for n in numbers])
    thing, body_of = sim.model.geom("object").id, sim.model.geom_bodyid
    geoms = [np.flatnonzero(body_of == sim.model.body(link).id) for link in links]
    ask = mujoco.mj_geomDistance
    return np.array([min(ask(sim.model, sim.data, g, thing, FAR, None) for g in of) for of in geoms])


def self_contact() -> int:
    """Flags under which Bullet loads a hand whose links touch each other, but not their parents."""
    from tactilerl.envs.simulators.pybullet import LOADING, pybullet

    parents = pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
    return int(LOADING | pybullet.URDF_USE_SELF_COLLISION | parents)
