"""Read contacts of hand and object from a simulator, and let a hand touch itself."""

from __future__ import annotations

from typing import Any

from tactilerl.envs.grasp import GraspEnv


def deepest(env: GraspEnv) -> float:
    """Return how far hand and object overlap now, m."""
    sim: Any = env.simulator
    if env.config.simulator == "pybullet":
        from tactilerl.envs.simulators.pybullet import pybullet

        points = pybullet.getContactPoints(sim.hand, sim.object, physicsClientId=sim.client)
        return -min([point[8] for point in points], default=0.0)
    object_id, ground = sim.model.geom("object").id, sim.model.geom("ground").id
    touching = (c for c in sim.data.contact if object_id in c.geom and ground not in c.geom)
    return -min((contact.dist for contact in touching), default=0.0)


def self_contact() -> int:
    """Return Bullet's loading flags for a hand whose links touch each other, but not their parents."""
    from tactilerl.envs.simulators.pybullet import LOADING, pybullet

    parents = pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
    return int(LOADING | pybullet.URDF_USE_SELF_COLLISION | parents)
