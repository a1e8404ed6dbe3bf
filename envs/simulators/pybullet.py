"""The scene in PyBullet.

Bullet has no tendons, armature or position servos of its own. Here joints on one tendon
get targets of their own, motors are Bullet's velocity constraints with the model's
force limits, the hand feels no gravity (gravity is a force on the object alone), and
links, which are too light for Bullet's solver, get some rotational inertia.
"""

from __future__ import annotations

import importlib
import math
import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from inspect import isbuiltin
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..hands import model_file
from ..hands.hand import Coupling
from ..hands.mount import servo_figures
from ..objects import Shape
from ..state import Array, Contacts, State, places
from . import Camera, Scene, SimulationError, Simulator, Sphere, joint_limits, urdf
from .mujoco import MujocoSimulator


def _import_quietly() -> Any:
    """Return PyBullet, without the line that it prints to the process's stderr when imported."""
    stderr = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            return importlib.import_module("pybullet")
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


pybullet = _import_quietly()
GRAVITY = 9.81
ENGINE = {"numSolverIterations": 50, "deterministicOverlappingPairs": 1}
LOADING = pybullet.URDF_USE_INERTIA_FROM_FILE
EPSILON = 1e-9
# Of coupled joints: share of an error that a step takes back, and N m.
GEAR_ERP, GEAR_FORCE = 0.5, 1e3
JOINT_DAMPING = 0.01  # N m s/rad
SPINNING_FRICTION = 0.005  # m, of the object's contacts
FRICTION_ANCHOR = 1  # contacts remember where they stick; without, held objects creep


def _bound(client: int) -> Any:
    """Return PyBullet for one of its clients; its own BulletClient prints to stdout."""
    return SimpleNamespace(
        **{
            name: partial(value, physicsClientId=client) if isbuiltin(value) else value
            for name, value in vars(pybullet).items()
        }
    )


class PyBulletSimulator(Simulator):
    """Simulate one scene in PyBullet, with a client of its own."""

    holds_gil = True

    def __init__(self, scene: Scene) -> None:
        """Build a scene in a client of its own."""
        super().__init__(scene)
        hand = scene.hand
        self.model = model_file.compiled(scene.build_hand(visual=False))
        self.joint_limits = joint_limits(self.model, hand)
        self.client = pybullet.connect(pybullet.DIRECT)
        self._bullet = _bound(self.client)
        resources = ExitStack()
        self._release = weakref.finalize(self, resources.close)
        folder = Path(resources.enter_context(tempfile.TemporaryDirectory()))
        resources.enter_context(suppress(pybullet.error))  # disconnected already
        resources.callback(self._bullet.disconnect)
        self._urdf = folder / "hand.urdf"
        self._urdf.write_text(urdf.from_model(self.model, folder), encoding="utf-8")
        self._build()
        self._joints = [self._joint_index[name] for name in hand.joints]
        self._motors, self._gains, self._forces = self._motor_figures()
        self._lowest, self._highest = self._target_limits()
        self._names = tuple(
            self.model.body(body).name for body in range(1, self.model.nbody)
        )
        self._indices = [self._links[name] for name in self._names]
        self._link_of_index = {index: link for link, index in enumerate(self._indices)}
        self._painter: MujocoSimulator | None = None
        self._rest: Array | None = (
            None  # of the giver's spring, while the object is carried
        )
        self._goal = np.zeros(3)

    def __reduce__(self) -> Any:
        """Raise TypeError: Bullet's worlds cannot be copied, a copy would share this one's."""
        raise TypeError(
            "a PyBullet environment cannot be copied or pickled: make another"
        )

    # -- building ----------------------------------------------------------------------------

    def _build(self) -> None:
        """Put the scene into an empty world."""
        scene, bullet = self.scene, self._bullet
        self._weight = (0.0, 0.0, -GRAVITY * scene.mass)
        bullet.resetSimulation()
        bullet.setPhysicsEngineParameter(fixedTimeStep=scene.timestep, **ENGINE)
        self.hand = bullet.loadURDF(str(self._urdf), useFixedBase=True, flags=LOADING)
        # By name; a joint has its child link's index.
        self._joint_index, self._links = {}, {}
        for index in range(bullet.getNumJoints(self.hand)):
            info = bullet.getJointInfo(self.hand, index)
            self._joint_index[info[1].decode()] = index
            self._links[info[12].decode()] = index
        self._body(0.0, {"shapeType": pybullet.GEOM_PLANE}, lateralFriction=1.0)
        own = {}
        if scene.shape.kind == "capsule":  # Bullet takes its box's
            own["localInertiaDiagonal"] = (scene.mass * scene.shape.inertia).tolist()
        self.object = self._body(
            scene.mass,
            _measures(scene.shape),
            **own,
            lateralFriction=scene.friction,
            spinningFriction=SPINNING_FRICTION,
            frictionAnchor=FRICTION_ANCHOR,
        )
        self._set_dynamics()
        for coupling in scene.hand.couplings:
            if coupling.is_rigid:
                self._gear(coupling)

    def _gear(self, coupling: Coupling) -> None:
        """Make two joints move as one, whichever of them is pushed."""
        follower, driver = (self._joint_index[name] for name in coupling[:2])
        bullet, hand, origin = self._bullet, self.hand, [0.0, 0.0, 0.0]
        bullet.setJointMotorControl2(
            hand, follower, pybullet.VELOCITY_CONTROL, force=0.0
        )
        joints, axis = (hand, follower, hand, driver), [0.0, 0.0, 1.0]
        gear = bullet.createConstraint(
            *joints, pybullet.JOINT_GEAR, axis, origin, origin
        )
        law = {"gearRatio": -coupling.ratio, "relativePositionTarget": coupling.offset}
        bullet.changeConstraint(gear, **law, erp=GEAR_ERP, maxForce=GEAR_FORCE)

    def _body(self, mass: float, shape: dict[str, Any], **dynamics: float) -> int:
        bullet = self._bullet
        body = int(bullet.createMultiBody(mass, bullet.createCollisionShape(**shape)))
        bullet.changeDynamics(
            body, -1, linearDamping=0.0, angularDamping=0.0, **dynamics
        )
        return body

    def _set_dynamics(self) -> None:
        """Set friction and damping of the hand.

        Bullet multiplies the frictions of two bodies: 1 everywhere but on the object.
        """
        added = self.scene.hand.file.added_inertia
        for name, index in self._links.items():
            body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
            inertia = (
                self.model.body_inertia[body] + added if body >= 0 else np.zeros(3)
            )
            self._bullet.changeDynamics(
                self.hand, index, lateralFriction=1.0, linearDamping=0.0, angularDamping=0.0,
                jointDamping=JOINT_DAMPING, localInertiaDiagonal=inertia.tolist(),
            )  # fmt: skip

    def _motor_figures(self) -> tuple[list[int], list[float], list[float]]:
        """Return joint, gain and force limit of each motor: the actuated joints, then the coupled.

        A motor takes back the share `gain` of its error in a step. The model's servo, a
        spring of `stiffness` on a damped joint, takes it back at the rate stiffness /
        damping.
        """
        hand, model = self.scene.hand, self.model
        limits, gains = [], []
        for actuator, joint in zip(hand.actuators, hand.actuated, strict=True):
            stiffness, damping, limit = servo_figures(model, actuator, joint)
            limits.append(limit)
            rate = stiffness / max(damping, EPSILON)
            gains.append(min(1.0, rate * self.scene.timestep))
        soft = [each for each in hand.couplings if not each.is_rigid]
        self._drivers = [hand.actuated.index(each.driver) for each in soft]
        self._ratios = np.array([each.ratio for each in soft])
        self._offsets = np.array([each.offset for each in soft])
        for figures in (gains, limits):
            figures += [figures[driver] for driver in self._drivers]
        motors = [*hand.actuated, *(each.joint for each in soft)]
        return [self._joint_index[joint] for joint in motors], gains, limits

    def _target_limits(self) -> Array:
        """Return the lowest and highest targets (2, n_actuators), rad or m.

        Joints that follow rigidly stay in their ranges with these.
        """
        hand = self.scene.hand
        limits = np.outer([-np.inf, np.inf], np.ones(len(hand.actuated)))
        for joint, driver, ratio, offset, is_rigid in hand.couplings:
            if is_rigid and ratio:
                followed = self.joint_limits[hand.joints.index(joint)]
                ends = np.sort((followed - offset) / ratio)
                index = hand.actuated.index(driver)
                limits[:, index] = limits[:, index].clip(*ends)
        return limits

    # -- running -----------------------------------------------------------------------------

    def _begin(
        self, joint_positions: Array, object_position: Array, yaw: float
    ) -> None:
        bullet = self._bullet
        self.let_go()
        self._build()  # a world that has been stepped keeps pairs and contacts
        for index, position in zip(self._joints, joint_positions, strict=True):
            bullet.resetJointState(self.hand, index, position)
        turn = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        bullet.resetBasePositionAndOrientation(self.object, object_position, turn)

    @contextmanager
    def _checked(self) -> Iterator[None]:
        try:
            yield
        except pybullet.error as error:
            raise SimulationError(f"PyBullet: {error}") from error
        position, _ = self._bullet.getBasePositionAndOrientation(self.object)
        if not math.isfinite(sum(position) + sum(map(sum, self._joint_states()))):
            raise SimulationError("PyBullet's state is not finite")

    def _advance(self, n_substeps: int) -> None:
        bullet = self._bullet
        targets = np.clip(self._targets, self._lowest, self._highest)
        coupled = self._ratios * targets[self._drivers] + self._offsets
        bullet.setJointMotorControlArray(
            self.hand, self._motors, pybullet.POSITION_CONTROL,
            targetPositions=[*targets.tolist(), *coupled.tolist()],
            positionGains=self._gains, forces=self._forces,
        )  # fmt: skip
        for _ in range(n_substeps):  # external forces last one step
            position, _ = bullet.getBasePositionAndOrientation(self.object)
            carried = self._rest is not None
            force = self._pull(np.array(position)) if carried else self._weight
            bullet.applyExternalForce(
                self.object, -1, force, position, pybullet.WORLD_FRAME
            )
            bullet.stepSimulation()

    def _pull(self, position: Array) -> Array:
        """Return the giver's force (3,) on the object, N; move the spring's rest point by a timestep.

        The force is without the object's weight, which is carried.
        """
        giver, rest = self.scene.giver, self._rest
        assert giver is not None
        assert rest is not None
        way, step = self._goal - rest, giver.speed * self.scene.timestep
        distance = float(np.linalg.norm(way))
        rest = self._goal if distance <= step else rest + way * (step / distance)
        self._rest = rest
        velocity, _ = self._bullet.getBaseVelocity(self.object)
        return giver.pull(rest, position, np.array(velocity))

    def carry(self, goal: Array) -> None:
        """Make the giver carry the object towards `goal` (3,), m."""
        position, _ = self._bullet.getBasePositionAndOrientation(self.object)
        self._rest, self._goal = np.array(position), goal

    def let_go(self) -> None:
        """Carry the object no longer."""
        self._rest = None

    def _joint_states(self) -> list[tuple[float, float]]:
        """Return position and velocity of each joint."""
        states = self._bullet.getJointStates(self.hand, self._joints)
        return [(state[0], state[1]) for state in states]

    def state(self) -> State:
        """Return what is true now."""
        bullet = self._bullet
        position, xyzw = bullet.getBasePositionAndOrientation(self.object)
        velocity, spin = bullet.getBaseVelocity(self.object)
        poses = bullet.getLinkStates(
            self.hand, self._indices, computeForwardKinematics=True
        )
        positions = np.array([pose[4] for pose in poses])
        rotations = Rotation.from_quat([pose[5] for pose in poses]).as_matrix()
        angles, speeds = np.array(self._joint_states()).T
        pressing = self._contacts()
        return self.scene.state(
            self._names,
            positions,
            rotations,
            targets=self._targets,
            object_position=np.array(position),
            object_rotation=np.array(pybullet.getMatrixFromQuaternion(xyzw)).reshape(
                3, 3
            ),
            object_orientation=np.array([xyzw[3], *xyzw[:3]]),
            object_velocity=np.array(velocity),
            object_angular_velocity=np.array(spin),
            joint_positions=angles,
            joint_velocities=speeds,
            contacts=pressing,
            sensors=self._sensed(pressing.points, positions, rotations),
        )

    def _contacts(self) -> Contacts:
        contacts = self._bullet.getContactPoints(self.hand, self.object)
        pressing = [contact for contact in contacts if contact[9] > 0.0]
        points = np.array([contact[5] for contact in pressing]).reshape(-1, 3)
        links = [self._link_of_index[contact[3]] for contact in pressing]
        forces = np.array([contact[9] for contact in pressing])
        normals = -np.array([contact[7] for contact in pressing]).reshape(-1, 3)
        return Contacts(points, np.array(links, int), forces, normals)

    def _sensed(self, points: Array, positions: Array, rotations: Array) -> Array:
        """Return bool (n,): whether a contact with the object that carries force lies in a sensor."""
        if not self.scene.sensors:
            return np.zeros(0, bool)
        names, centres, radii = zip(*self.scene.sensors, strict=True)
        at = places(self._names, names)
        offsets = np.einsum("nij,nj->ni", rotations[at], np.array(centres))
        centres = positions[at] + offsets
        gaps = np.square(points[None] - centres[:, None]).sum(axis=2)
        return (gaps <= np.square(radii)[:, None]).any(axis=1)

    def render(self, camera: Camera, spheres: Sequence[Sphere] = ()) -> Array:
        """Draw by MuJoCo's renderer: one look for both simulators."""
        if self._painter is None:
            self._painter = MujocoSimulator(self.scene)
        scene, state = self.scene, self.state()
        self._painter.change_object(scene.shape, scene.mass, scene.friction)
        self._painter.place(
            state.joint_positions, state.object_position, state.object_orientation
        )
        return self._painter.render(camera, spheres)

    def close(self) -> None:
        """Release the client and the painter."""
        if self._painter is not None:
            self._painter.close()
        self._release()


def _measures(shape: Shape) -> dict[str, Any]:
    """Return a shape as PyBullet wants it."""
    x, _, z = shape.half_size
    if shape.kind == "sphere":
        return {"shapeType": pybullet.GEOM_SPHERE, "radius": x}
    if shape.kind == "cylinder":
        return {"shapeType": pybullet.GEOM_CYLINDER, "radius": x, "height": 2 * z}
    if shape.kind == "capsule":
        lying = {"collisionFrameOrientation": [0.5] * 4, "height": 2 * (x - z)}
        return {"shapeType": pybullet.GEOM_CAPSULE, "radius": z, **lying}
    return {"shapeType": pybullet.GEOM_BOX, "halfExtents": list(shape.half_size)}
