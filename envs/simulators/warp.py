"""Many scenes at once in MuJoCo Warp, on a GPU; on a CPU it runs, for tests alone.

What differs by world are arrays of the model with a row for each: the object's
measures, the giver's springs, creep. They are made before the graph of a timestep is
captured, and only written to after.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp

from ..objects import Shape
from ..state import Array, Contacts, State
from . import Scene
from .batch import BatchSimulator
from .mujoco import GIVERS_GROUP, MujocoSimulator

# Room for contacts, of a world on average (all share it), and each world's rows of constraints.
N_CONTACTS, N_ROWS = 48, 160
MAX_CONTACTS = N_ROWS // 4  # of hand and object in a world: each has four rows
NO_ROOM = 0b11111  # of `mujoco_warp.OverflowType`: constraints, their entries, and contacts in 3 places
BY_WORLD = (
    "geom_size", "geom_rbound", "geom_aabb", "geom_friction", "body_mass", "body_inertia",
    "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_forcerange",
    "actuator_actrange", "geom_solref",
)  # fmt: skip
SHARED = (
    "qpos", "qvel", "act", "ctrl", "qacc_warmstart", "xfrc_applied", "xpos", "xquat", "xmat",
    "overflow",
)  # fmt: skip
HUGE = 1e10  # beyond it MuJoCo warns of a bad state


class WarpSimulator(BatchSimulator):
    """MuJoCo Warp's worlds, in float32."""

    dtype = torch.float32

    def __init__(self, scene: Scene, n: int, device: str) -> None:
        """Build n scenes on a PyTorch device."""
        self.scene, self.n, self.kind = scene, n, scene.shape.kind
        self.device, self._device = torch.device(device), warp.get_device(device)
        self.plain = plain = MujocoSimulator(scene)
        host = plain.model
        # MuJoCo Warp has neither.
        host.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        host.opt.disableactuator &= ~(1 << GIVERS_GROUP)
        with warp.ScopedDevice(self._device):
            self._model = model = mujoco_warp.put_model(
                host, dict.fromkeys(BY_WORLD, n)
            )
            self._data = mujoco_warp.put_data(
                host, plain.data, nworld=n, nconmax=N_CONTACTS, njmax=N_ROWS
            )
            model.opt.warn_overflow = 0
            creep = np.repeat(model.opt.impratio_invsqrt.numpy(), n)
            model.opt.impratio_invsqrt = warp.array(creep, dtype=float)
        # Memory that Warp and PyTorch share, (n, ...).
        self._creep = warp.to_torch(model.opt.impratio_invsqrt)
        self._own = {name: warp.to_torch(getattr(model, name)) for name in BY_WORLD}
        now = {name: warp.to_torch(getattr(self._data, name)) for name in SHARED}
        self._now = SimpleNamespace(**now)
        self._graphs: dict[Any, Any] = {}
        self._run(mujoco_warp.step)
        self._run(mujoco_warp.kinematics)
        self._link_of = self.tensor(host.geom_bodyid - 1)  # -1: the world's
        self._half_size = self.tensor(np.tile(scene.shape.half_size, (n, 1)))
        self._contacts = self._contacts_now()
        self.diverged = np.zeros(n, bool)

    def _run(self, function: Any) -> None:
        """Run a function of model and data: on a GPU captured as a graph, once it has been compiled."""
        with warp.ScopedDevice(self._device):
            if function in self._graphs:
                warp.capture_launch(self._graphs[function])
                return
            function(self._model, self._data)
            if self._device.is_cuda:
                with warp.ScopedCapture() as capture:
                    function(self._model, self._data)
                self._graphs[function] = capture.graph

    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Write what `MujocoSimulator.change_object` compiles, by the formulas of the solids."""
        plain, own = self.plain, self._own
        body, geom = plain._object_body, plain._object_geom
        shape = Shape(self.kind, tuple(half_size.T))
        inertia, ease = mass[:, None] * shape.inertia, 1 / mass
        weights = np.stack([ease, (1 / inertia).mean(1)], 1)
        for name, index, value in (
            ("geom_size", (which, geom), np.stack(shape.measures, 1)),
            ("geom_friction", (which, geom, 0), friction),
            ("body_mass", (which, body), mass),
            ("body_inertia", (which, body), inertia),
            ("body_invweight0", (which, body), weights),
            ("dof_invweight0", (which, slice(-6, None)), np.repeat(weights, 3, axis=1)),
        ):
            own[name][index] = self.tensor(value)
        with warp.ScopedDevice(self._device):  # bounds follow from sizes
            mujoco_warp.set_const(
                self._model, self._data, mujoco_warp.SetConstGroup.FIXED
            )
        if skin := self.scene.skin:
            solref = skin.solref(plain._ease + ease[:, None], self.scene.timestep)
            skins = which[:, None], plain._skin
            own["geom_solref"][skins] = self.tensor(solref)
            own["geom_friction"][(*skins, 0)] = self.tensor(friction)[:, None]
        self._half_size[which] = self.tensor(half_size)

    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Reset worlds as `MujocoSimulator` does."""
        now, start = self._now, self.plain.start(joints, position, yaw)
        now.qpos[which], now.ctrl[which] = map(self.tensor, start)
        for part in (now.qvel, now.act, now.qacc_warmstart, now.overflow):
            part[which] = 0
        self.let_go(which)
        self._contacts.forces[which] = 0.0
        self.diverged[which] = False
        self._run(mujoco_warp.kinematics)

    def step(self, targets: Array, n_substeps: Array) -> None:
        """Launch the timesteps; a world that has had its own is put back to there."""
        now, done, finished = self._now, 0, []
        now.ctrl[:, self.plain._ctrl] = self.tensor(targets)
        moving = now.qpos, now.qvel, now.act, now.qacc_warmstart, now.overflow
        for number in np.unique(n_substeps):
            for _ in range(number - done):
                self._run(mujoco_warp.step)
            ends, done = np.flatnonzero(n_substeps == number), number
            latest = *moving, *(self._contacts_now() if done else self._contacts)
            for part, now_there in zip((*moving, *self._contacts), latest, strict=True):
                finished.append((part, ends, now_there[ends]))
        for part, ends, values in finished:
            part[ends] = values
        self._run(mujoco_warp.kinematics)
        largest = torch.maximum(now.qpos.abs().amax(1), now.qvel.abs().amax(1))
        lost = ~(largest < HUGE) | ((now.overflow & NO_ROOM) > 0)
        self.diverged = lost.cpu().numpy()

    def carry(self, which: Array, goal: Array) -> None:
        """Set the givers' springs, activations and speeds."""
        plain, goals, at = self.plain, self.tensor(goal), which[:, None]
        body, springs, now = plain._object_body, plain._giver, self._now
        position = now.xpos[which, body]
        giver: Any = self.scene.giver
        both_ways = self.tensor([-giver.force, giver.force])
        self._own["actuator_forcerange"][at, springs] = both_ways
        both = torch.stack([position, goals], -1)
        self._own["actuator_actrange"][at, springs] = both.sort(-1).values
        now.act[at, plain.model.actuator_actadr[springs]] = position
        way = torch.nn.functional.normalize(goals - position, eps=1e-9)
        now.ctrl[at, springs] = giver.speed * way
        weight = float(plain.model.opt.gravity[2]) * self._own["body_mass"][which, body]
        now.xfrc_applied[which, body, 2] = -weight

    def let_go(self, which: Array) -> None:
        """Make the givers' springs slack: what has no force has no stiffness either."""
        self._own["actuator_forcerange"][which[:, None], self.plain._giver] = 0.0
        self._now.xfrc_applied[which, self.plain._object_body] = 0.0

    def set_creep(self, factor: Array) -> None:
        """Write the impedance of friction."""
        invsqrt = np.sqrt(factor / self.plain._impratio)
        self._creep[:] = self.tensor(invsqrt)

    def state(self) -> State:
        """Read the worlds' arrays; targets and sensors are empty."""
        now, plain, body = self._now, self.plain, self.plain._object_body
        half_size: Any = tuple(self._half_size.T)
        scene = replace(self.scene, shape=Shape(self.kind, half_size))
        spin = now.xmat[:, body] @ now.qvel[:, -3:, None]
        return scene.state(
            plain._links,
            now.xpos[:, plain._bodies],
            now.xmat[:, plain._bodies],
            object_position=now.xpos[:, body],
            object_rotation=now.xmat[:, body],
            object_orientation=now.xquat[:, body],
            object_velocity=now.qvel[:, -6:-3],
            object_angular_velocity=spin[..., 0],
            joint_positions=now.qpos[:, plain._qpos],
            joint_velocities=now.qvel[:, plain._qvel],
            contacts=self._contacts,
            targets=now.qpos[:, :0],
            sensors=now.qpos[:, :0],
        )

    def _contacts_now(self) -> Contacts:
        """Sort the contacts of all worlds with the object that carry force into rows of worlds."""
        found, held = self._data.contact, self.plain._object_geom
        n = int(
            warp.to_torch(self._data.nacon)[0]
        )  # perhaps more than there is room for
        names = "worldid", "geom", "efc_address", "pos", "frame"
        world, geoms, address, pos, frame = (
            warp.to_torch(getattr(found, name))[:n] for name in names
        )
        world, address = world.long(), address[:, 0]
        force = warp.to_torch(self._data.efc.force)[world, address]
        is_second = geoms[:, 1] == held
        link = self._link_of[torch.where(is_second, geoms[:, 0], geoms[:, 1])]
        carries = (geoms == held).any(1) & (link >= 0) & (address >= 0) & (force > 0)
        rows = carries.nonzero()[:, 0]
        rows = rows[world[rows].argsort(stable=True)]
        worlds = torch.arange(self.n, device=self.device)
        first = torch.searchsorted(world[rows], worlds)
        place = torch.arange(len(rows), device=self.device) - first[world[rows]]
        fits = place < MAX_CONTACTS
        rows, place = rows[fits], place[fits]
        sign = torch.where(is_second, 1.0, -1.0)[:, None]
        parts = []
        for values in (pos, link, force, sign * frame[:, 0]):
            part = values.new_zeros((self.n, MAX_CONTACTS, *values.shape[1:]))
            part[world[rows], place] = values[rows]
            parts.append(part)
        return Contacts(*parts)  # type: ignore[arg-type]
