"""The scene in MuJoCo."""

from __future__ import annotations

import importlib
import math
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ctypes.util import find_library

import mujoco
import numpy as np

from ..hands import model_file
from ..hands.mount import GIVER, GROUND, OBJECT
from ..objects import Shape
from ..state import Array, Contacts, State
from . import (
    Camera,
    Scene,
    Sensor,
    SimulationError,
    Simulator,
    Sphere,
    joint_limits,
)

GIVERS_GROUP = 30  # of actuators, the last: a hand's are elsewhere
GEOM, NOT_DRAWN = mujoco.mjtGeom, 4  # group of sites
SURROUNDINGS = f"""
<mujoco>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" width="64" height="64"
             rgb1="0.96 0.97 0.99" rgb2="0.75 0.8 0.88"/>
  </asset>
  <worldbody>
    <geom name="{GROUND}" type="plane" size="1 1 0.1" rgba="0.8 0.8 0.8 1"/>
    <light pos="0.1 -0.2 -0.6" dir="-0.1 0.2 0.6" diffuse="0.3 0.3 0.3"/>
    <light pos="0.3 -0.5 1" dir="-0.3 0.5 -1" diffuse="0.5 0.5 0.5"/>
    <site name="{GIVER}" group="{NOT_DRAWN}"/>
    <body name="{OBJECT}" pos="0 0 {{z!r}}">
      <freejoint name="{OBJECT}"/>
      {{inertial}}
      <geom name="{OBJECT}" type="{{kind}}" size="{{size}}" zaxis="{{axis}}" mass="{{mass!r}}"
            condim="4" priority="1" friction="{{friction!r}} 0.005 0.001"
            rgba="0.95 0.45 0.1 {{opacity}}"/>
      <site name="{OBJECT}" group="{NOT_DRAWN}"/>
    </body>
  </worldbody>
  <actuator>{{actuators}}</actuator>
</mujoco>"""
# MuJoCo's own has the geom's axes, for which a compiled model that was another object's
# has no room.
INERTIAL = '<inertial pos="0 0 0" mass="{!r}" diaginertia="{} {} {}"/>'
# The priority is for the object's friction: else MuJoCo takes the larger of the two in
# contact.
SPRING = f"""
<general name="{GIVER}{{axis}}" site="{OBJECT}" refsite="{GIVER}" gear="{{gear}}" dyntype="integrator"
         gainprm="{{stiffness!r}}" biastype="affine" biasprm="0 -{{stiffness!r}} -{{damping!r}}"
         forcerange="-{{force!r}} {{force!r}}" actlimited="true" actrange="-1 1"
         group="{GIVERS_GROUP}"/>"""
"""A damped spring along an axis of the world, whose rest point, the actuator's
activation, goes at the speed that is its control and stays within the activation's
range."""
# What depends on the object in a compiled model, besides what `mj_setConst` derives.
OBJECT_FIGURES = {
    "body": ("body_pos", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    "geom": (
        "geom_type",
        "geom_size",
        "geom_rbound",
        "geom_aabb",
        "geom_friction",
        "geom_quat",
        "geom_sameframe",
    ),
}
SOLVER_ITERATIONS = 20  # enough for the grasps' contacts: docs/accuracy_and_speed.md
# Warnings after which the state is not the physics' any more.
DIVERGENCE_WARNINGS = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}"))
    for what in ("QPOS", "QVEL", "QACC")
]

# Dry friction does not creep, MuJoCo's soft contacts do: with the model's pyramidal
# cones and ratio 1 a held cube slides out of the fingers within the 20 s of a hold
# test.
FRICTION_TO_NORMAL_IMPEDANCE = 100.0
SKINS = 3.0  # times as much with a soft skin, so that it creeps no faster


def build_spec(scene: Scene) -> mujoco.MjSpec:
    """Return hand, ground, object and sensors as an editable model."""
    spec = scene.build_hand(scene.visual)
    spec.option.timestep = scene.timestep
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = SOLVER_ITERATIONS
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # faster when pressed hard
    spec.option.impratio = FRICTION_TO_NORMAL_IMPEDANCE * (SKINS if scene.skin else 1)
    _take_textures(spec)
    spec.attach(_surroundings(scene), prefix="", frame=spec.worldbody.add_frame())
    for number, sensor in enumerate(scene.sensors):
        _add_touch_sensor(spec, f"touch of taxel {number}", sensor)
    return spec


def _take_textures(spec: mujoco.MjSpec) -> None:
    """Remove a hand model's background and textures, whose files are seldom published."""
    spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.3, 0.4
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in spec.textures:
        spec.delete(texture)


def _surroundings(scene: Scene) -> mujoco.MjSpec:
    """Return what is in a scene besides the hand: ground, light, object and giver."""
    shape, lies = scene.shape, scene.shape.kind == "capsule"
    springs = [
        SPRING.format(axis=axis, gear="0 " * axis + "1", **vars(scene.giver))
        for axis in range(3 if scene.giver else 0)
    ]
    text = SURROUNDINGS.format(
        kind=shape.kind,
        size=" ".join(map(repr, shape.measures)),
        axis="1 0 0" if lies else "0 0 1",
        inertial=INERTIAL.format(scene.mass, *scene.mass * shape.inertia)
        if lies
        else "",
        z=shape.half_size[2],
        mass=scene.mass,
        friction=scene.friction,
        opacity=0.6 if scene.visual else 1.0,
        actuators="".join(springs),
    )
    return mujoco.MjSpec.from_string(text)


def _add_touch_sensor(spec: mujoco.MjSpec, name: str, sensor: Sensor) -> None:
    spec.body(sensor.link).add_site(
        name=name,
        type=GEOM.mjGEOM_SPHERE,
        size=[sensor.radius] * 3,
        pos=sensor.centre,
        group=NOT_DRAWN,
    )
    site, touch = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor.mjSENS_TOUCH
    spec.add_sensor(name=name, type=touch, objtype=site, objname=name)


_cannot_draw: list[str] = []  # the reason, once an attempt has failed in this process
DISPLAYS = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
"""Variables that say what MuJoCo draws with, or on."""


def _renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """Return MuJoCo's renderer; without a display, and unless told how, by EGL, or else OSMesa.

    Raise OSError where nothing can draw.
    """
    if _cannot_draw:  # a second attempt would end the process
        raise OSError(_cannot_draw[0])
    if sys.platform == "linux" and not any(map(os.environ.get, DISPLAYS)):
        library = "egl" if find_library("EGL") else "osmesa"
        # MuJoCo chose when it was imported.
        chosen = sys.modules[mujoco.Renderer.__module__].gl_context
        chosen.GLContext = importlib.import_module(f"mujoco.{library}").GLContext
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        with warnings.catch_warnings(action="ignore"):  # GLFW's, before the error
            return mujoco.Renderer(model, height, width)
    except (mujoco.FatalError, ImportError, AttributeError) as error:
        reason = " ".join(str(error).split()).partition(", this most")[0]
        _cannot_draw.append(
            "MuJoCo cannot draw here; without a display it needs EGL or OSMesa (Debian: libegl1 or "
            f"libosmesa6) ({reason})"
        )
        raise OSError(_cannot_draw[0]) from error


def _set_mean_inertia(model: mujoco.MjModel) -> None:
    """Set the solver's unit by one sum for models as compiled and changed.

    Some processors round MuJoCo's own differently.
    """
    model.stat.meaninertia = sum(model.dof_M0.tolist()) / model.nv


class MujocoSimulator(Simulator):
    """Simulate one scene in MuJoCo."""

    holds_gil = False

    def __init__(self, scene: Scene) -> None:
        """Build a scene."""
        super().__init__(scene)
        self.model = model_file.compiled(build_spec(scene))
        self._impratio = self.model.opt.impratio
        _set_mean_inertia(self.model)
        # A diverged state is reported, not silently replaced by the start of the
        # episode.
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.data = mujoco.MjData(self.model)
        self._past_warnings = 0
        self._renderer: mujoco.Renderer | None = None
        hand, model = scene.hand, self.model
        self.joint_limits = joint_limits(model, hand)
        joints = [model.joint(name) for name in hand.joints]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._qvel = np.array([joint.dofadr[0] for joint in joints])
        self._ctrl = np.array([model.actuator(name).id for name in hand.actuators])
        self._actuated = [hand.joints.index(joint) for joint in hand.actuated]
        # The object is the last body, and its free joint the last joint.
        self._object_qpos, self._object_qvel = slice(model.nq - 7, None), model.nv - 6
        self._object_body, self._object_geom = model.nbody - 1, model.geom(OBJECT).id
        springs = [f"{GIVER}{axis}" for axis in range(3 if scene.giver else 0)]
        self._giver = np.array([model.actuator(name).id for name in springs], int)
        # The world is the first: links are what is between.
        self._bodies = slice(1, self._object_body)
        self._links = tuple(
            model.body(body).name for body in range(1, self._object_body)
        )
        self._link_of_geom = (model.geom_bodyid - 1).tolist()
        on_hand = (model.geom_bodyid > 0) & (model.geom_bodyid < self._object_body)
        self._skin = np.flatnonzero(on_hand)
        self._cover()

    @property
    def warnings(self) -> int:  # type: ignore[override]
        """Number of times that MuJoCo has warned, resets included."""
        return self._past_warnings + sum(self.data.warning.number.tolist())

    def change_object(self, shape: Shape, mass: float, friction: float) -> None:
        """Write into the compiled model what another object would have been compiled to."""
        scene = self.scene.with_object(shape, mass, friction)
        if scene is self.scene:
            return
        self.scene, model = scene, self.model
        compiled = _surroundings(scene).compile()
        for part, names in OBJECT_FIGURES.items():
            here, there = (getattr(m, part)(OBJECT).id for m in (model, compiled))
            for name in names:
                getattr(model, name)[here] = getattr(compiled, name)[there]
        for values in ("qpos0", "qpos_spring"):
            getattr(model, values)[self._object_qpos] = getattr(compiled, values)
        leaf = model.body_bvhadr[self._object_body]
        model.bvh_aabb[leaf] = compiled.bvh_aabb[
            compiled.body_bvhadr[compiled.body(OBJECT).id]
        ]
        mujoco.mj_setConst(model, self.data)
        _set_mean_inertia(model)
        self._cover()

    def _cover(self) -> None:
        """Make contacts with the hand as soft as its skin, with the object's friction."""
        if skin := self.scene.skin:
            model, geoms = self.model, self._skin
            model.geom_priority[geoms], model.geom_condim[geoms] = 2, 4
            model.geom_friction[geoms] = model.geom_friction[self._object_geom]
            model.geom_solimp[geoms] = skin.solimp
            self._ease = model.body_invweight0[model.geom_bodyid[geoms], 0]
            ease = self._ease + 1 / self.scene.mass
            model.geom_solref[geoms] = skin.solref(ease, self.scene.timestep)

    def _begin(
        self, joint_positions: Array, object_position: Array, yaw: float
    ) -> None:
        self._past_warnings = self.warnings  # MuJoCo forgets them
        mujoco.mj_resetData(self.model, self.data)
        self.let_go()
        start = self.start(joint_positions, object_position, np.array(yaw))
        self.data.qpos[:], self.data.ctrl[:] = start
        mujoco.mj_forward(self.model, self.data)

    def start(
        self, joint_positions: Array, object_position: Array, yaw: Array
    ) -> tuple[Array, Array]:
        """Return MuJoCo's qpos (..., nq) and ctrl (..., nu) where episodes begin, at yaws (...)."""
        qpos = np.tile(self.model.qpos0, (*yaw.shape, 1))
        qpos[..., self._qpos] = joint_positions
        zero = np.zeros_like(yaw)  # 0 * yaw may be -0.0
        turn = np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)
        pose = np.concatenate([object_position, np.stack(turn, axis=-1)], axis=-1)
        qpos[..., self._object_qpos] = pose
        ctrl = np.zeros((*yaw.shape, self.model.nu))
        ctrl[..., self._ctrl] = joint_positions[..., self._actuated]
        return qpos, ctrl

    def place(
        self, joint_positions: Array, object_position: Array, orientation: Array
    ) -> None:
        """Put hand and object (quaternion wxyz) somewhere, velocities and time as they are."""
        self.data.qpos[self._qpos] = joint_positions
        self.data.qpos[self._object_qpos] = [*object_position, *orientation]
        mujoco.mj_forward(self.model, self.data)

    def _advance(self, n_substeps: int) -> None:
        model, data = self.model, self.data
        data.ctrl[self._ctrl] = self._targets
        if self.scene.sensors:  # only the last substep's readings are looked at
            off = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
            model.opt.disableflags |= off
            try:
                mujoco.mj_step(model, data, n_substeps - 1)
            finally:
                model.opt.disableflags &= ~off
            n_substeps = 1
        mujoco.mj_step(model, data, n_substeps)
        # mj_step leaves body poses one substep behind qpos.
        mujoco.mj_kinematics(model, data)

    @contextmanager
    def _checked(self) -> Iterator[None]:
        try:
            yield
        except mujoco.FatalError as error:
            raise SimulationError(f"MuJoCo: {' '.join(str(error).split())}") from error
        q, v, warned = self.data.qpos, self.data.qvel, self.data.warning.number.tolist()
        if not math.isfinite(q @ q + v @ v) or any(
            warned[kind] for kind in DIVERGENCE_WARNINGS
        ):
            raise SimulationError("MuJoCo's state is not finite, or huge")

    def carry(self, goal: Array) -> None:
        """Make the giver carry the object towards `goal` (3,), m."""
        assert self.scene.giver is not None
        model, data, position = self.model, self.data, self.data.xpos[self._object_body]
        way = goal - position
        model.opt.disableactuator &= ~(1 << GIVERS_GROUP)
        model.actuator_actrange[self._giver] = np.sort([position, goal], axis=0).T
        data.act[model.actuator_actadr[self._giver]] = position
        distance = max(np.linalg.norm(way), 1e-9)
        data.ctrl[self._giver] = self.scene.giver.speed * way / distance
        data.xfrc_applied[self._object_body, :3] = -self.scene.mass * model.opt.gravity

    def let_go(self) -> None:
        """Carry the object no longer."""
        self.model.opt.disableactuator |= 1 << GIVERS_GROUP
        self.data.xfrc_applied[self._object_body] = 0.0

    def set_creep(self, factor: float) -> None:
        """Set the impedance: a soft contact that sticks moves at friction force / impedance."""
        self.model.opt.impratio = self._impratio / factor

    def state(self) -> State:
        """Return what is true now."""
        data, body, start = self.data, self._object_body, self._object_qvel
        rotation = data.xmat[body].reshape(3, 3).copy()
        return self.scene.state(
            self._links,
            data.xpos[self._bodies].copy(),
            data.xmat[self._bodies].reshape(-1, 3, 3).copy(),
            targets=self._targets,
            object_position=data.xpos[body].copy(),
            object_rotation=rotation,
            object_orientation=data.xquat[body].copy(),
            object_velocity=data.qvel[start : start + 3].copy(),
            object_angular_velocity=rotation @ data.qvel[start + 3 : start + 6],
            joint_positions=data.qpos.take(self._qpos),
            joint_velocities=data.qvel.take(self._qvel),
            contacts=self._contacts(),
            sensors=data.sensordata > 0.0,
        )

    def _contacts(self) -> Contacts:
        """Return the contacts of links with the object that carry force."""
        indices, links, forces, ways = [], [], [], []
        force, held = np.zeros(6), self._object_geom
        for index, pair in enumerate(self.data.contact.geom.tolist()):
            link = self._link_of_geom[pair[0] if pair[1] == held else pair[1]]
            if held in pair and link >= 0:
                mujoco.mj_contactForce(self.model, self.data, index, force)
                if force[0] > 0.0:
                    indices.append(index)
                    links.append(link)
                    forces.append(force[0])
                    ways.append(1.0 if pair[1] == held else -1.0)  # 1st to 2nd geom
        which = np.array(indices, int)
        points = self.data.contact.pos.reshape(-1, 3)[which]
        normals = self.data.contact.frame.reshape(-1, 9)[which, :3]
        normals = np.array(ways)[:, None] * normals
        return Contacts(points, np.array(links, int), np.array(forces), normals)

    def render(self, camera: Camera, spheres: Sequence[Sphere] = ()) -> Array:
        """Return an RGB picture (height, width, 3) uint8; OSError where nothing can draw."""
        size = camera.height, camera.width
        if self._renderer and (self._renderer.height, self._renderer.width) != size:
            self.close()
        if self._renderer is None:
            self._renderer = _renderer(self.model, *size)
        view = mujoco.MjvCamera()
        middle = (self.data.xpos[self._object_body] + self.state().palm) / 2
        view.lookat[:] = middle if camera.lookat is None else camera.lookat
        view.azimuth, view.elevation = camera.azimuth, camera.elevation
        view.distance = camera.distance
        self._renderer.update_scene(self.data, view)
        scene = self._renderer.scene
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = camera.shadows
        for sphere in spheres[: scene.maxgeom - scene.ngeom]:  # as there is room for
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom], GEOM.mjGEOM_SPHERE, np.full(3, sphere.radius),
                sphere.centre, np.eye(3).ravel(), np.array(sphere.colour, np.float32),
            )  # fmt: skip
            scene.ngeom += 1
        return self._renderer.render()

    def close(self) -> None:
        """Close the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
