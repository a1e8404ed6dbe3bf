"""Many scenes at once in MuJoCo Warp, on a GPU; on a CPU it runs, for tests alone.

What differs by world are arrays of the model with a row for each: the object's measures, the giver's
springs, creep. They are made before the graph of a timestep is captured, and only written to after.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp
from torch import Tensor

from ..objects import Shape
from ..state import Array, Contacts, State, places
from . import Scene
from .batch import BatchSimulator
from .mujoco import GIVERS_GROUP, MujocoSimulator

MAX_CONTACTS = 32  # of hand and object in a world
# Room of a world: its contacts, and rows of constraints.
N_CONTACTS, N_ROWS = 48, 160
NO_ROOM = 0b11111  # of `mujoco_warp.OverflowType`: constraints, their entries, and contacts in 3 places
BY_WORLD = (
    "geom_size", "geom_rbound", "geom_aabb", "geom_friction", "body_mass", "body_inertia",
    "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_gainprm", "actuator_biasprm",
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
        self.device = torch.device(device)
        self._device = warp.get_device(
            "cpu" if self.device.type == "cpu" else str(self.device)
        )
        self.plain = plain = MujocoSimulator(scene)
        host, giver = plain.model, plain._giver
        # MuJoCo Warp has neither.
        host.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        host.opt.disableactuator &= ~(1 << GIVERS_GROUP)
        with warp.ScopedDevice(self._device):
            self._model = mujoco_warp.put_model(host, dict.fromkeys(BY_WORLD, n))
            self._data = mujoco_warp.put_data(
                host, plain.data, nworld=n, nconmax=N_CONTACTS, njmax=N_ROWS
            )
            self._own = {
                name: warp.to_torch(getattr(self._model, name)) for name in BY_WORLD
            }
            options = self._model.opt
            options.warn_overflow = 0
            creep = np.repeat(options.impratio_invsqrt.numpy(), n)
            options.impratio_invsqrt = warp.array(creep, dtype=float)
            self._creep = warp.to_torch(options.impratio_invsqrt)
            # Memory that Warp and PyTorch share, (n, ...).
            self._now = SimpleNamespace()
            for name in SHARED:
                setattr(self._now, name, warp.to_torch(getattr(self._data, name)))
            self._graphs: dict[str, Any] = {}
            self._run("step", mujoco_warp.step)
            self._run("kinematics", mujoco_warp.kinematics)
        self._springs = self._indices(giver)
        self._stiff = {
            name: self._own[name][0, self._springs].clone()
            for name in ("actuator_gainprm", "actuator_biasprm")
        }
        self._spring_act = self._indices(host.actuator_actadr[giver])
        self._body_of = self._indices(host.geom_bodyid)
        self._points = self.tensor(scene.points[1])
        self._on_links = self._indices(places(plain._links, scene.points[0]))
        self._qpos_of, self._qvel_of, self._ctrl_of = map(
            self._indices, (plain._qpos, plain._qvel, plain._ctrl)
        )
        self._half_size = self.tensor(np.tile(scene.shape.half_size, (n, 1)))
        self._contacts = self._contacts_now()
        self.diverged = np.zeros(n, bool)

    def _indices(self, values: Any) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=torch.long, device=self.device)

    def _run(self, name: str, function: Any) -> None:
        """Run a function of model and data: on a GPU captured as a graph, once it has been compiled."""
        if name in self._graphs:
            warp.capture_launch(self._graphs[name])
            return
        function(self._model, self._data)
        if self._device.is_cuda:
            with warp.ScopedCapture(self._device) as capture:
                function(self._model, self._data)
            self._graphs[name] = capture.graph

    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Write what `MujocoSimulator.change_object` compiles, by the formulas of the solids."""
        plain, rows, own = self.plain, self._indices(which), self._own
        body, geom = plain._object_body, plain._object_geom
        shape = Shape(self.kind, tuple(half_size.T))
        inertia, ease = mass[:, None] * shape.inertia, 1 / mass
        weights = np.stack([ease, (1 / inertia).mean(1)], 1)
        for name, index, value in (
            ("geom_size", (rows, geom), np.stack(shape.measures, 1)),
            ("geom_friction", (rows, geom, 0), friction),
            ("body_mass", (rows, body), mass),
            ("body_inertia", (rows, body), inertia),
            ("body_invweight0", (rows, body), weights),
            ("dof_invweight0", (rows, slice(-6, None)), np.repeat(weights, 3, axis=1)),
        ):
            own[name][index] = self.tensor(value)
        with warp.ScopedDevice(self._device):  # bounds follow from sizes
            bounds = mujoco_warp.SetConstGroup.FIXED
            mujoco_warp.set_const(self._model, self._data, bounds)
        if skin := self.scene.skin:
            solref = skin.solref(plain._ease + ease[:, None], self.scene.timestep)
            skins = rows[:, None], self._indices(plain._skin)
            own["geom_solref"][skins] = self.tensor(solref)
            own["geom_friction"][(*skins, 0)] = self.tensor(friction)[:, None]
        self._half_size[rows] = self.tensor(half_size)

    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Reset worlds as `MujocoSimulator` does."""
        now, rows, data = self._now, self._indices(which), self.plain.data
        starts = []
        for start in zip(joints, position, yaw, strict=True):
            self.plain.set_start(*start)
            starts.append([part.copy() for part in (data.qpos, data.act, data.ctrl)])
        for part, values in zip(
            (now.qpos, now.act, now.ctrl), zip(*starts, strict=True), strict=False
        ):
            part[rows] = self.tensor(np.stack(values))
        now.qvel[rows] = now.qacc_warmstart[rows] = 0.0
        now.overflow[rows] = 0
        self.let_go(which)
        self._contacts.forces[rows] = 0.0
        self.diverged[which] = False
        with warp.ScopedDevice(self._device):
            self._run("kinematics", mujoco_warp.kinematics)

    def step(self, targets: Array, n_substeps: Array) -> None:
        """Launch the timesteps; a world that has had its own is put back to there."""
        now, done, finished = self._now, 0, []
        now.ctrl[:, self._ctrl_of] = self.tensor(targets)
        changing = now.qpos, now.qvel, now.act, now.qacc_warmstart
        with warp.ScopedDevice(self._device):
            for number in np.unique(n_substeps):
                for _ in range(int(number) - done):
                    self._run("step", mujoco_warp.step)
                done = int(number)
                ends = self._indices(np.flatnonzero(n_substeps == number))
                finished.append((ends, [values[ends] for values in changing]))
                if done:
                    for kept, part in zip(
                        self._contacts, self._contacts_now(), strict=True
                    ):
                        kept[ends] = part[ends]
            for ends, saved in finished:
                for values, value in zip(changing, saved, strict=True):
                    values[ends] = value
            self._run("kinematics", mujoco_warp.kinematics)
        largest = torch.maximum(now.qpos.abs().amax(1), now.qvel.abs().amax(1))
        lost = ~(largest < HUGE) | ((now.overflow & NO_ROOM) > 0)
        self.diverged = lost.cpu().numpy()

    def carry(self, which: Array, goal: Array) -> None:
        """Set the givers' springs, activations and speeds."""
        rows, goals = self._indices(which), self.tensor(goal)
        at, springs, body = rows[:, None], self._springs, self.plain._object_body
        now, position = self._now, self._now.xpos[rows, body]
        for name, value in self._stiff.items():
            self._own[name][at, springs] = value
        both = torch.stack([position, goals], -1)
        self._own["actuator_actrange"][at, springs] = both.sort(-1).values
        now.act[at, self._spring_act] = position
        way = goals - position
        giver: Any = self.scene.giver
        now.ctrl[at, springs] = giver.speed * torch.nn.functional.normalize(
            way, eps=1e-9
        )
        gravity = float(self.plain.model.opt.gravity[2])
        now.xfrc_applied[rows, body, 2] = -gravity * self._own["body_mass"][rows, body]

    def let_go(self, which: Array) -> None:
        """Make the givers' springs slack."""
        rows = self._indices(which)
        for name in self._stiff:
            self._own[name][rows[:, None], self._springs] = 0.0
        self._now.xfrc_applied[rows, self.plain._object_body] = 0.0

    def set_creep(self, factor: Array) -> None:
        """Write the impedance of friction."""
        invsqrt = np.sqrt(factor / self.plain._impratio)
        self._creep[:] = self.tensor(invsqrt).reshape(self._creep.shape)

    def state(self) -> State:
        """Read the worlds' arrays; targets and sensors are empty."""
        now, body, links = self._now, self.plain._object_body, self._on_links
        positions, rotations = now.xpos[:, 1:body], now.xmat[:, 1:body]
        placed = positions[:, links] + (rotations[:, links] @ self._points)[..., 0]
        half_size: Any = tuple(self._half_size.T)
        return State(
            shape=Shape(self.kind, half_size),
            object_position=now.xpos[:, body],
            object_rotation=now.xmat[:, body],
            object_orientation=now.xquat[:, body],
            object_velocity=now.qvel[:, -6:-3],
            object_angular_velocity=(now.xmat[:, body] @ now.qvel[:, -3:, None])[
                ..., 0
            ],
            links=self.plain._links,
            link_positions=positions,
            link_rotations=rotations,
            palm=placed[:, 0],
            fingertips=placed[:, 1:],
            joint_positions=now.qpos[:, self._qpos_of],
            joint_velocities=now.qvel[:, self._qvel_of],
            contacts=self._contacts,
            targets=now.qpos[:, :0],
            sensors=now.qpos[:, :0],
        )

    def _contacts_now(self) -> Contacts:
        """Sort the contacts of all worlds with the object that carry force into rows of worlds."""
        found, held = self._data.contact, self.plain._object_geom
        n = min(int(warp.to_torch(self._data.nacon)[0]), self._data.naconmax)
        names = "worldid", "geom", "efc_address", "pos", "frame"
        world, geoms, address, pos, frame = (
            warp.to_torch(getattr(found, name))[:n] for name in names
        )
        world, geoms, address = world.long(), geoms.long(), address[:, 0].long()
        force = warp.to_torch(self._data.efc.force)[world, address.clamp_min(0)]
        is_second = geoms[:, 1] == held
        other = torch.where(is_second, geoms[:, 0], geoms[:, 1]).clamp_min(0)
        link = self._body_of[other] - 1  # the world's is -1
        carries = (geoms == held).any(1) & (link >= 0) & (address >= 0) & (force > 0)
        rows = carries.nonzero()[:, 0]
        rows = rows[world[rows].argsort(stable=True)]
        first = torch.searchsorted(
            world[rows], torch.arange(self.n, device=self.device)
        )
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
