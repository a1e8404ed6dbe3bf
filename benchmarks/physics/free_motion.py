"""What a scene loses where nothing should be lost: a brick in free fall, a hand swinging freely.

Used by speed_vs_error.py, a column for each.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from tactilerl.envs.grasp import GraspEnv

BRICK = (0.02, 0.03, 0.05)  # m
FALL, SWING = 0.3, 0.1  # s
DROP = np.array([0.5, 0.5, 1.0])  # m: away from the hand
SPIN = np.array([3.0, 2.0, 1.0])  # rad/s, about no principal axis
SPEED = 1.0  # rad/s
GRAVITY = 9.81


def fall(env: GraspEnv) -> dict[str, float]:
    """A spinning BRICK falls for FALL s: relative errors of the height fallen and of the rotational
    energy."""
    simulator, n = env.simulator, round(FALL / env.config.timestep)
    simulator.reset(env.hand.start_positions(), DROP, 0.0)
    _spin(env)
    before = _rotational_energy(env)
    simulator.step(env.hand.start_targets(), n)
    fallen = DROP[2] - simulator.state().object_position[2]
    wanted = 0.5 * GRAVITY * (n * env.config.timestep) ** 2
    return {
        "fall_error": float(abs(fallen / wanted - 1.0)),
        "spin_energy_error": abs(_rotational_energy(env) / before - 1.0),
    }


def swing(env: GraspEnv) -> dict[str, float]:
    """The hand without motors, damping, couplings, contacts and weight, every finger joint in the
    middle of its range and at SPEED: relative change of the kinetic energy in SWING s."""
    hand, n = env.hand, round(SWING / env.config.timestep)
    model = env.simulator.model  # type: ignore[attr-defined]
    middles = np.array([model.joint(joint).range.mean() for joint in hand.joints[3:]])
    env.simulator.reset(np.concatenate([np.zeros(3), middles]), DROP, 0.0)
    move = _swing_in_bullet if env.config.simulator == "pybullet" else _swing_in_mujoco
    before, after = move(env, n)
    return {"swing_energy_error": abs(after / before - 1.0)}


def _spin(env: GraspEnv) -> None:
    sim: Any = env.simulator
    if env.config.simulator == "pybullet":
        from tactilerl.envs.simulators.pybullet import pybullet

        pybullet.resetBaseVelocity(
            sim.object, angularVelocity=SPIN.tolist(), physicsClientId=sim.client
        )
    else:
        sim.data.joint("object").qvel[3:] = SPIN  # the object is not turned yet


def _rotational_energy(env: GraspEnv) -> float:
    """Of the object, J."""
    sim: Any = env.simulator
    edges = 2 * np.array(env.shape.half_size)
    inertia = sim.scene.mass / 12 * (np.square(edges).sum() - np.square(edges))
    if env.config.simulator == "pybullet":
        from tactilerl.envs.simulators.pybullet import pybullet

        _, velocity = pybullet.getBaseVelocity(sim.object, physicsClientId=sim.client)
        local = sim.state().object_rotation.T @ np.array(velocity)
    else:
        local = sim.data.joint("object").qvel[3:]
    return float(0.5 * (inertia * np.square(local)).sum())


def _swing_in_mujoco(env: GraspEnv, n: int) -> tuple[float, float]:
    """Kinetic energy before and after, J."""
    model, data = env.simulator.model, env.simulator.data  # type: ignore[attr-defined]
    for part in ("ACTUATION", "CONSTRAINT", "SPRING", "DAMPER", "GRAVITY"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    for joint in env.hand.joints[3:]:
        data.joint(joint).qvel[0] = SPEED
    energies = []
    for steps in (0, n):
        mujoco.mj_step(model, data, steps)
        mujoco.mj_forward(model, data)
        mujoco.mj_energyVel(model, data)
        energies.append(float(data.energy[1]))
    return energies[0], energies[1]


def _swing_in_bullet(env: GraspEnv, n: int) -> tuple[float, float]:
    """Kinetic energy before and after, J."""
    from tactilerl.envs.simulators.pybullet import pybullet as bullet

    simulator: Any = env.simulator
    hand, world = simulator.hand, {"physicsClientId": simulator.client}
    links = range(bullet.getNumJoints(hand, **world))
    for link in links:
        bullet.changeDynamics(hand, link, jointDamping=0.0, **world)
        bullet.setCollisionFilterGroupMask(hand, link, 0, 0, **world)
        bullet.setJointMotorControl2(hand, link, bullet.VELOCITY_CONTROL, force=0.0, **world)
    for joint in env.hand.joints[3:]:
        index = simulator._joint_index[joint]
        position = bullet.getJointState(hand, index, **world)[0]
        bullet.resetJointState(hand, index, position, SPEED, **world)

    def energy(link: int) -> float:
        state = bullet.getLinkState(
            hand, link, computeLinkVelocity=1, computeForwardKinematics=1, **world
        )
        mass, _, inertia, *_ = bullet.getDynamicsInfo(hand, link, **world)
        frame = np.array(bullet.getMatrixFromQuaternion(state[1])).reshape(3, 3)
        velocity, local = np.array(state[6]), frame.T @ np.array(state[7])
        return float(0.5 * (mass * velocity @ velocity + (np.array(inertia) * local) @ local))

    before = sum(map(energy, links))
    for _ in range(n):
        bullet.stepSimulation(**world)
    return before, sum(map(energy, links))
