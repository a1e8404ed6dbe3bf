"""The scene in MuJoCo."""

from __future__ import annotations

import importlib
import math
import os
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ctypes.util import find_library

import mujoco
import numpy as np

from ..hands import model_file
from ..hands.mount import hold
from ..state import Array, Contacts, Shape, State
from . import (
    Camera,
    Giver,
    Scene,
    Sensor,
    SimulationError,
    Simulator,
    Sphere,
    joint_limits,
)

OBJECT, GIVER = "object", "giver"
GIVERS_GROUP = 30  # of actuators, the last: a hand's are elsewhere
GEOM, NOT_DRAWN = mujoco.mjtGeom, 4  # group of sites
# What depends on the object in a compiled model, besides what `mj_setConst` derives.
OBJECT_FIGURES = {
    "body": ("body_pos", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    "geom": ("geom_type", "geom_size", "geom_rbound", "geom_aabb", "geom_friction"),
}
SOLVER_ITERATIONS = 20  # enough for the grasps' contacts: docs/accuracy_and_speed.md
# Warnings after which the state is not the physics' any more.
BROKEN = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}"))
    for what in ("QPOS", "QVEL", "QACC")
]

# Dry friction does not creep, MuJoCo's soft contacts do: with the model's pyramidal cones and
# ratio 1 a held cube slides out of the fingers within the 20 s of a hold test.
FRICTION_TO_NORMAL_IMPEDANCE = 100.0


def build_spec(scene: Scene) -> mujoco.MjSpec:
    """Hand, ground, object and sensors."""
    spec = scene.build_hand(scene.visual)
    spec.option.timestep = scene.timestep
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = SOLVER_ITERATIONS
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # faster when pressed hard
    spec.option.impratio = FRICTION_TO_NORMAL_IMPEDANCE
    spec.worldbody.add_geom(
        name="ground", type=GEOM.mjGEOM_PLANE, size=[1, 1, 0.1], rgba=[0.8, 0.8, 0.8, 1]
    )
    if scene.visual:
        _lighten(spec)
    for place, brightness in (([0.1, -0.2, -0.6], 0.3), ([0.3, -0.5, 1.0], 0.5)):
        shine = [-along for along in place]
        spec.worldbody.add_light(pos=place, dir=shine, diffuse=[brightness] * 3)
    _add_object(spec, scene)
    if scene.giver is not None:
        _add_giver(spec, scene.giver)
    for number, sensor in enumerate(scene.sensors):
        _add_touch_sensor(spec, f"sensor{number}", sensor)
    return spec


def _add_giver(spec: mujoco.MjSpec, giver: Giver) -> None:
    """A damped spring along each axis of the world, whose rest point, the actuator's activation, goes
    at the speed that is its control and stays within the activation's range."""
    spec.worldbody.add_site(name=GIVER, group=NOT_DRAWN)
    spec.body(OBJECT).add_site(name=OBJECT, group=NOT_DRAWN)
    for axis in range(3):
        spec.add_actuator(
            name=f"{GIVER}{axis}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target=OBJECT,
            refsite=GIVER,
            gear=np.eye(6)[axis],
            dyntype=mujoco.mjtDyn.mjDYN_INTEGRATOR,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=[giver.stiffness] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, -giver.stiffness, -giver.damping] + [0] * 7,
            forcelimited=True,
            forcerange=[-giver.force, giver.force],
            actlimited=True,
            actrange=[-1, 1],
            group=GIVERS_GROUP,
        )


def _add_object(spec: mujoco.MjSpec, scene: Scene) -> None:
    x, _, z = scene.shape.half_size
    body = spec.worldbody.add_body(name=OBJECT, pos=[0, 0, z])
    body.add_freejoint(name=OBJECT)
    body.add_geom(
        name=OBJECT,
        type=getattr(GEOM, f"mjGEOM_{scene.shape.kind.upper()}"),
        size=(x, z, 0.0) if scene.shape.kind == "cylinder" else scene.shape.half_size,
        mass=scene.mass,
        condim=4,
        friction=[scene.friction, 0.005, 0.001],
        priority=1,  # else MuJoCo takes the larger friction of the two in contact
        rgba=[0.95, 0.45, 0.1, 0.6 if scene.visual else 1.0],
    )


def _lighten(spec: mujoco.MjSpec) -> None:
    """A light background, in place of the hand model's own if it has one, and light wherever the hand
    goes."""
    spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.3, 0.4
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64,
        height=64,
        rgb1=[0.96, 0.97, 0.99],
        rgb2=[0.75, 0.8, 0.88],
    )


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


def add_spheres(scene: mujoco.MjvScene, spheres: Sequence[Sphere]) -> None:
    """To what is drawn; RuntimeError where there are too many."""
    if scene.ngeom + len(spheres) > scene.maxgeom:
        raise RuntimeError("too many spheres to draw")
    for sphere in spheres:
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom], GEOM.mjGEOM_SPHERE, np.full(3, sphere.radius), sphere.centre,
            np.eye(3).ravel(), np.array(sphere.colour, np.float32),
        )  # fmt: skip
        scene.ngeom += 1


LONGEST_WAIT = 2.0  # s, for a picture to be due
_failures: list[OSError] = []  # of drawing, in this process
DISPLAYS = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
"""Variables that say what MuJoCo draws with, or on."""


def _renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """Return what draws; where there is no display, and nobody says with what, by EGL, or else OSMesa.
    OSError where nothing can."""
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
        needs = (
            "without a display it needs EGL or OSMesa (Debian: libegl1 or libosmesa6)"
        )
        _failures.append(OSError(f"MuJoCo cannot draw here; {needs} ({reason})"))
        raise _failures[0] from error


class _Window:
    """MuJoCo's viewer on a copy of the scene, which nothing done in it can disturb."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._copy = model, mujoco.MjData(model)
        self._shown_at, self._time = time.monotonic(), data.time
        before = set(threading.enumerate())
        try:
            with warnings.catch_warnings(action="ignore"):  # GLFW's, before the error
                import glfw
                from mujoco import viewer

                if not glfw.init():
                    raise RuntimeError("no display")
            self._viewer = viewer.launch_passive(
                model, self._copy, show_left_ui=False, show_right_ui=False
            )
        except (ImportError, RuntimeError) as error:
            reason = f"no window opens here ({error})"
            raise OSError(f"render_mode human: {reason}") from error
        self._threads = set(threading.enumerate()) - before
        camera, view = Camera(), self._viewer.cam
        view.azimuth, view.elevation = camera.azimuth, camera.elevation
        view.distance = 1.5 * camera.distance

    def show(self, data: mujoco.MjData, spheres: Sequence[Sphere]) -> None:
        """Show what is true now when it is due; nothing where the window has been closed."""
        if not self._viewer.is_running():
            return
        ahead = data.time - self._time - (time.monotonic() - self._shown_at)
        if 0.0 < ahead < LONGEST_WAIT:
            time.sleep(ahead)
        self._shown_at, self._time = time.monotonic(), data.time
        with self._viewer.lock():
            mujoco.mj_copyData(self._copy, self._model, data)
            self._viewer.cam.lookat[:] = data.xpos[self._model.body(OBJECT).id]
            self._viewer.user_scn.ngeom = 0
            add_spheres(self._viewer.user_scn, spheres)
        self._viewer.sync()

    def close(self) -> None:
        """Close the window; it draws until its end, and must not outlive the scene."""
        self._viewer.close()
        for thread in self._threads:
            thread.join()


def _set_mean_inertia(model: mujoco.MjModel) -> None:
    """The solver's unit, by one sum for models as compiled and changed: some processors round MuJoCo's
    own differently."""
    model.stat.meaninertia = sum(model.dof_M0.tolist()) / model.nv


class MujocoSimulator(Simulator):
    """One scene."""

    holds_gil = False
    creeps = True

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.model = model_file.compiled(build_spec(scene))
        _set_mean_inertia(self.model)
        # A diverged state is reported, not silently replaced by the start of the episode.
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.data = mujoco.MjData(self.model)
        self._past_warnings = 0
        self._renderer: mujoco.Renderer | None = None
        self._window: _Window | None = None
        hand, model = scene.hand, self.model
        self.joint_limits = joint_limits(model, hand)
        joints = [model.joint(name) for name in hand.joints]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._qvel = np.array([joint.dofadr[0] for joint in joints])
        self._ctrl = np.array([model.actuator(name).id for name in hand.actuators])
        self._actuated = [hand.joints.index(joint) for joint in hand.actuated]
        free = model.joint(OBJECT)
        self._object_qpos = slice(int(free.qposadr[0]), int(free.qposadr[0]) + 7)
        self._object_qvel = int(free.dofadr[0])
        self._object_body = model.body(OBJECT).id
        self._object_geom = model.geom(OBJECT).id
        self._giver: Array | None = None
        if scene.giver is not None:
            actuators = [model.actuator(f"{GIVER}{axis}") for axis in range(3)]
            self._giver = np.array([actuator.id for actuator in actuators])
        bodies = [b for b in range(1, model.nbody) if b != self._object_body]
        self._bodies = np.array(bodies)
        self._links = tuple(model.body(body).name for body in bodies)
        of_body = {body: link for link, body in enumerate(bodies)}
        geoms = model.geom_bodyid.tolist()
        self._link_of_geom = [of_body.get(body, -1) for body in geoms]

    @property
    def warnings(self) -> int:  # type: ignore[override]
        return self._past_warnings + sum(self.data.warning.number.tolist())

    def change_object(self, shape: Shape, mass: float, friction: float) -> None:
        """Writes into the compiled model what another object would have been compiled to."""
        scene = self.scene.with_object(shape, mass, friction)
        if scene is self.scene:
            return
        self.scene, model = scene, self.model
        alone = mujoco.MjSpec()
        _add_object(alone, scene)
        compiled = alone.compile()
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

    def _begin(
        self, joint_positions: Array, object_position: Array, yaw: float
    ) -> None:
        self._past_warnings = self.warnings  # MuJoCo forgets them
        mujoco.mj_resetData(self.model, self.data)
        self.let_go()
        turn = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        held = joint_positions[self._actuated]
        hold(self.model, self.data, self._ctrl.tolist(), held)
        self.place(joint_positions, object_position, turn)

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
        if not math.isfinite(q @ q + v @ v) or any(warned[kind] for kind in BROKEN):
            raise SimulationError("MuJoCo's state is not finite, or huge")

    def carry(self, goal: Array) -> None:
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
        if self._giver is not None:
            self.model.opt.disableactuator |= 1 << GIVERS_GROUP
        self.data.xfrc_applied[self._object_body] = 0.0

    def set_creep(self, factor: float) -> None:
        """A soft contact that sticks moves at (friction force) / (friction impedance)."""
        self.model.opt.impratio = FRICTION_TO_NORMAL_IMPEDANCE / factor

    def state(self) -> State:
        data, body, start = self.data, self._object_body, self._object_qvel
        rotation = data.xmat[body].reshape(3, 3).copy()
        return self._state(
            self._links,
            data.xpos.take(self._bodies, axis=0),
            data.xmat.take(self._bodies, axis=0).reshape(-1, 3, 3),
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
        thing, force, where, links, forces = self._object_geom, np.zeros(6), [], [], []
        for index, pair in enumerate(self.data.contact.geom.tolist()):
            link = self._link_of_geom[pair[0] if pair[1] == thing else pair[1]]
            if thing in pair and link >= 0:
                mujoco.mj_contactForce(self.model, self.data, index, force)
                if force[0] > 0.0:
                    where.append(index)
                    links.append(link)
                    forces.append(force[0])
        points = self.data.contact.pos.reshape(-1, 3)[np.array(where, int)]
        return Contacts(points, np.array(links, int), np.array(forces))

    def render(self, camera: Camera, spheres: Sequence[Sphere] = ()) -> Array:
        if _failures:  # a second attempt would end the process
            raise _failures[0]
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
        add_spheres(scene, spheres)
        return self._renderer.render()

    def show(self, spheres: Sequence[Sphere] = ()) -> None:
        if self._window is None:
            self._window = _Window(self.model, self.data)
        self._window.show(self.data, spheres)

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
