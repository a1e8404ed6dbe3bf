"""Many scenes at once in MuJoCo Warp, on a GPU; on a CPU it runs, for tests alone.

What differs by world are arrays of the model with a row for each: the object's measures, the giver's
springs, creep. They are made before the graph of a timestep is captured, and only written to after.
"""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp
from torch import Tensor

from ..objects import Shape
from ..state import Array, Contacts, State
from . import Scene
from .batch import MAX_CONTACTS, BatchSimulator
from .mujoco import GIVERS_GROUP, MujocoSimulator

NO_ROOM = 0b11111  # of `mujoco_warp.OverflowType`: constraints, their entries, and contacts in 3 places
BY_WORLD = (
    "geom_size", "geom_rbound", "geom_aabb", "geom_friction", "body_mass", "body_inertia",
    "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_gainprm", "actuator_biasprm",
    "actuator_actrange", "geom_solref",
)  # fmt: skip
HUGE = 1e10  # beyond it MuJoCo warns of a bad state


class WarpSimulator(BatchSimulator):
    """MuJoCo Warp's worlds, in float32."""

    # Memory that Warp and PyTorch share, (n, ...).
    _qpos: Tensor
    _qvel: Tensor
    _act: Tensor
    _ctrl: Tensor
    _xfrc_applied: Tensor
    _xpos: Tensor
    _xquat: Tensor
    _xmat: Tensor
    _qacc_warmstart: Tensor
    _overflow: Tensor

    def __init__(
        self,
        scene: Scene,
        n: int,
        device: str = "cuda",
        nconmax: int = 48,
        njmax: int = 160,
        iterations: int | None = None,
    ) -> None:
        """Build n scenes on a PyTorch device.

        A world has room for `nconmax` contacts and `njmax` rows of constraints. `iterations` are the
        solver's at most (None: the scene's).
        """
        self.scene, self.n, self.kind = scene, n, scene.shape.kind
        self.device, self.dtype = torch.device(device), torch.float32
        self._device = warp.get_device(
            "cpu" if self.device.type == "cpu" else str(self.device)
        )
        self.plain = MujocoSimulator(scene)
        self.links = self.plain.state().links
        host, data = self.plain.model, self.plain.data
        host.opt.disableflags &= ~int(
            mujoco.mjtDisableBit.mjDSBL_AUTORESET
        )  # it has neither
        host.opt.disableactuator &= ~(1 << GIVERS_GROUP)
        host.opt.iterations = iterations or host.opt.iterations
        with warp.ScopedDevice(self._device):
            self._model = mujoco_warp.put_model(host)
            self._data = mujoco_warp.put_data(
                host, data, nworld=n, nconmax=nconmax, njmax=njmax
            )
            self._model.opt.warn_overflow = 0
            self._own = {name: self._by_world(self._model, name) for name in BY_WORLD}
            self._creep = self._by_world(self._model.opt, "impratio_invsqrt")
            names = [
                "qpos",
                "qvel",
                "act",
                "ctrl",
                "xfrc_applied",
                "xpos",
                "xquat",
                "xmat",
                "qacc_warmstart",
                "overflow",
            ]
            for name in names:
                setattr(self, f"_{name}", warp.to_torch(getattr(self._data, name)))
            self._graphs: dict[str, Any] = {}
            self._streams: dict[int, Any] = {}
            self._run("step", mujoco_warp.step)
            self._run("kinematics", mujoco_warp.kinematics)
        self._springs = self._indices(self.plain._giver)
        self._stiff = {
            name: self._own[name][0, self._springs].clone()
            for name in ("actuator_gainprm", "actuator_biasprm")
        }
        self._spring_act = self._indices(host.actuator_actadr[self.plain._giver])
        self._points = self.tensor(scene.points[1])
        self._on_links = self._indices(
            [self.links.index(link) for link in scene.points[0]]
        )
        self._qpos_of, self._qvel_of = (
            self._indices(self.plain._qpos),
            self._indices(self.plain._qvel),
        )
        self._half_size = self.tensor(np.tile(scene.shape.half_size, (n, 1)))
        self._weight = self.tensor(np.full(n, scene.mass * -host.opt.gravity[2]))
        self._kept: list[tuple[Tensor, Contacts]] = []
        self._fresh = torch.ones(n, dtype=torch.bool, device=self.device)
        self.diverged, self.overflowed = np.zeros(n, bool), np.zeros(n, bool)

    def _by_world(self, owner: Any, name: str) -> Tensor:
        """Give an array a row for each world."""
        shared = getattr(owner, name)
        values = np.repeat(shared.numpy()[:1], self.n, axis=0)
        own: Any = warp.array(values, dtype=shared.dtype, device=self._device)
        setattr(owner, name, own)
        return warp.to_torch(own)

    def _indices(self, values: Any) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=torch.long, device=self.device)

    def _run(self, name: str, function: Any) -> None:
        """Run a function of model and data: on a GPU captured as a graph, once it has been compiled."""
        if name in self._graphs:
            warp.capture_launch(self._graphs[name], self._stream())
            return
        function(self._model, self._data)
        if self._device.is_cuda:
            with warp.ScopedCapture(self._device) as capture:
                function(self._model, self._data)
            self._graphs[name] = capture.graph

    def _stream(self) -> Any:
        """Return the stream that PyTorch uses in this thread; None for the usual one."""
        current = torch.cuda.current_stream(self.device)
        if current.cuda_stream == 0:
            return None
        if current.cuda_stream not in self._streams:
            own = warp.stream_from_torch(current)  # type: ignore[no-untyped-call]
            self._streams[current.cuda_stream] = own
        return self._streams[current.cuda_stream]

    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Write what `MujocoSimulator.change_object` compiles, by the formulas of the solids."""
        body, geom, rows = (
            self.plain._object_body,
            self.plain._object_geom,
            self._indices(which),
        )
        shape = Shape(self.kind, tuple(half_size.T))
        bound = np.linalg.norm(half_size, axis=1)  # or less
        inertia, easy = mass[:, None] * shape.inertia, 1 / mass
        turning = (1 / inertia).mean(1)
        for name, index, value in (
            ("geom_size", geom, np.stack(shape.measures, 1)), ("geom_rbound", geom, bound),
            ("body_mass", body, mass), ("body_subtreemass", body, mass),
            ("body_inertia", body, inertia),
            ("body_invweight0", body, np.stack([easy, turning], 1)),
        ):  # fmt: skip
            self._own[name][rows, index] = self.tensor(value)
        around = half_size[:, ::-1].copy() if self.kind == "capsule" else half_size
        self._own["geom_aabb"][rows, geom, 1] = self.tensor(around)
        self._own["geom_friction"][rows, geom, 0] = self.tensor(friction)
        weights = np.repeat(np.stack([easy, turning], 1), 3, axis=1)
        self._own["dof_invweight0"][rows, -6:] = self.tensor(weights)
        if skin := self.scene.skin:
            at, ease = (
                (rows[:, None], self.plain._skin),
                self.plain._ease + easy[:, None],
            )
            solref = skin.solref(ease, self.scene.timestep)
            self._own["geom_solref"][at] = self.tensor(solref)
            self._own["geom_friction"][(*at, 0)] = self.tensor(friction)[:, None]
        self._half_size[rows] = self.tensor(half_size)
        self._weight[rows] = self.tensor(mass * -self.plain.model.opt.gravity[2])

    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Reset worlds as `MujocoSimulator` does."""
        plain, rows = self.plain, self._indices(which)
        model, n = plain.model, len(which)
        qpos, act, ctrl = (np.zeros((n, m)) for m in (model.nq, model.na, model.nu))
        qpos[:] = model.qpos0
        qpos[:, plain._qpos] = joints
        turn = [np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)]
        qpos[:, plain._object_qpos] = np.concatenate([position, np.stack(turn, 1)], 1)
        ctrl[:, plain._ctrl] = joints[:, plain._actuated]
        has_act = model.actuator_actnum[plain._ctrl].astype(bool)
        act[:, model.actuator_actadr[plain._ctrl[has_act]]] = ctrl[
            :, plain._ctrl[has_act]
        ]
        for mine, value in ((self._qpos, qpos), (self._act, act), (self._ctrl, ctrl)):
            mine[rows] = self.tensor(value)
        self._qvel[rows] = self._qacc_warmstart[rows] = 0.0
        self.let_go(which)
        self._overflow[rows] = 0
        self._fresh[rows] = True
        self.diverged[which] = self.overflowed[which] = False
        with warp.ScopedDevice(self._device):
            self._run("kinematics", mujoco_warp.kinematics)

    def step(self, targets: Array, n_substeps: Array) -> None:
        """Launch the timesteps; a world that has had its own is put back to there."""
        self._ctrl[:, self._indices(self.plain._ctrl)] = self.tensor(targets)
        changing = self._qpos, self._qvel, self._act, self._qacc_warmstart
        done, finished = 0, []
        self._kept = []
        with warp.ScopedDevice(self._device):
            for number in np.unique(n_substeps):
                for _ in range(int(number) - done):
                    self._run("step", mujoco_warp.step)
                done = int(number)
                ends = self._indices(np.flatnonzero(n_substeps == number))
                if done < n_substeps.max():
                    finished.append((ends, [values[ends] for values in changing]))
                    if self.wants_contacts and done:
                        self._kept.append((ends, self._contacts_now()))
            for ends, values in finished:
                for mine, value in zip(changing, values, strict=True):
                    mine[ends] = value
            self._run("kinematics", mujoco_warp.kinematics)
        self._fresh[self._indices(np.flatnonzero(n_substeps))] = False

    wants_contacts = False
    """True once a state was asked for with contacts."""

    def check(self) -> None:
        """Look where a state is not finite, or huge, and where there was no room."""
        largest = torch.maximum(self._qpos.abs().amax(1), self._qvel.abs().amax(1))
        lost = ~(largest < HUGE), (self._overflow & NO_ROOM) > 0
        self.diverged, self.overflowed = (part.cpu().numpy() for part in lost)

    def carry(self, which: Array, goal: Array) -> None:
        """Set the givers' springs, activations and speeds."""
        rows, goals = self._indices(which), self.tensor(goal)
        at, springs = rows[:, None], self._springs
        position = self._xpos[rows, self.plain._object_body]
        for name, value in self._stiff.items():
            self._own[name][at, springs] = value
        ends = torch.stack(
            [torch.minimum(position, goals), torch.maximum(position, goals)], -1
        )
        self._own["actuator_actrange"][at, springs] = ends
        self._act[at, self._spring_act] = position
        way = goals - position
        giver: Any = self.scene.giver
        self._ctrl[at, springs] = (
            giver.speed * way / way.norm(dim=1, keepdim=True).clamp_min(1e-9)
        )
        self._xfrc_applied[rows, self.plain._object_body, 2] = self._weight[rows]

    def let_go(self, which: Array) -> None:
        """Make the givers' springs slack."""
        rows = self._indices(which)
        for name in self._stiff:
            self._own[name][rows[:, None], self._springs] = 0.0
        self._xfrc_applied[rows, self.plain._object_body] = 0.0

    def set_creep(self, factor: Array) -> None:
        """Write the impedance of friction."""
        invsqrt = np.sqrt(factor / self.plain._impratio)
        self._creep[:] = self.tensor(invsqrt).reshape(self._creep.shape)

    def state(self, with_contacts: bool = False) -> State:
        """Read the worlds' arrays."""
        self.wants_contacts, body = with_contacts, self.plain._object_body
        positions, rotations = self._xpos[:, 1:body], self._xmat[:, 1:body]
        on_links = (rotations[:, self._on_links] @ self._points)[..., 0]
        placed = positions[:, self._on_links] + on_links
        turning = self._xmat[:, body] @ self._qvel[:, -3:, None]
        nothing: Any = self._qpos[:, :0]
        values: dict[str, Any] = {
            "object_position": self._xpos[:, body],
            "object_rotation": self._xmat[:, body],
            "object_orientation": self._xquat[:, body],
            "object_velocity": self._qvel[:, -6:-3],
            "object_angular_velocity": turning[..., 0],
            "link_positions": positions,
            "link_rotations": rotations,
            "palm": placed[:, 0],
            "fingertips": placed[:, 1:],
            "joint_positions": self._qpos[:, self._qpos_of],
            "joint_velocities": self._qvel[:, self._qvel_of],
        }
        contacts = (
            self._contacts() if with_contacts else Contacts(*[nothing[..., None]] * 4)
        )
        shape = Shape(self.kind, tuple(self._half_size.T))  # type: ignore[arg-type]
        return State(
            shape=shape,
            links=self.links,
            contacts=contacts,
            targets=nothing,
            sensors=nothing,
            **values,
        )

    def _contacts(self) -> Contacts:
        """Return the contacts of each world's own last timestep; none where it was only reset."""
        contacts = self._contacts_now()
        for ends, kept in self._kept:
            for part, before in zip(contacts, kept, strict=True):
                part[ends] = before[ends]
        contacts.forces[self._fresh] = 0.0
        return contacts

    def _contacts_now(self) -> Contacts:
        """Sort the contacts of all worlds with the object that carry force into rows of worlds."""
        found, n = (
            self._data.contact,
            min(int(warp.to_torch(self._data.nacon)[0]), self._data.naconmax),
        )

        def pick(name: str) -> Tensor:
            return warp.to_torch(getattr(found, name))[:n]

        world, geoms, address = (
            pick(name).long() for name in ("worldid", "geom", "efc_address")
        )
        force = warp.to_torch(self._data.efc.force)[world, address[:, 0].clamp_min(0)]
        held, body_of = (
            self.plain._object_geom,
            self._indices(self.plain.model.geom_bodyid),
        )
        other = torch.where(geoms[:, 1] == held, geoms[:, 0], geoms[:, 1]).clamp_min(0)
        is_ours = (
            (geoms == held).any(1)
            & (body_of[other] > 0)
            & (address[:, 0] >= 0)
            & (force > 0)
        )
        rows = is_ours.nonzero()[:, 0]
        rows = rows[world[rows].argsort(stable=True)]
        world = world[rows]
        first = torch.searchsorted(world, torch.arange(self.n, device=self.device))
        place = torch.arange(len(rows), device=self.device) - first[world]
        fits = place < MAX_CONTACTS
        rows, world, place = rows[fits], world[fits], place[fits]
        rooms = (
            torch.zeros((self.n, MAX_CONTACTS, *more), device=self.device)
            for more in ((3,), (), (), (3,))
        )
        points, links, forces, normals = rooms
        sign = torch.where(geoms[rows, 1] == held, 1.0, -1.0)
        points[world, place] = pick("pos")[rows]
        links[world, place] = body_of[other][rows] - 1.0
        forces[world, place] = force[rows]
        normals[world, place] = sign[:, None] * pick("frame")[rows][:, 0]
        return Contacts(points, links.long(), forces, normals)  # type: ignore[arg-type]
