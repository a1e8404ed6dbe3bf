"""The interface of many simulated scenes side by side, and its plain form: MuJoCo in a loop.

All worlds have the same hand and the same kind of object, whose measures differ by world. What comes
in by world is NumPy's, what is read is PyTorch's, on the device. The loop shows what a batch means; it
is exact, and no faster than its worlds one after the other.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..objects import Kind, Shape
from ..state import Array
from . import Scene, SimulationError
from .mujoco import MujocoSimulator

MAX_CONTACTS = 32  # of hand and object in a world


class BatchContacts(NamedTuple):
    """Contacts at which hands press on objects, k a world; where there are fewer, forces are 0."""

    points: Tensor
    """Places (n, k, 3), m."""
    forces: Tensor
    """Normal forces (n, k), N."""
    normals: Tensor
    """Unit normals (n, k, 3), from the hand into the object."""


class BatchState(NamedTuple):
    """`State` with a leading axis of worlds; its fields mean the same."""

    half_size: Tensor
    """Half extents (n, 3) of the objects, m."""
    object_position: Tensor
    object_rotation: Tensor
    object_orientation: Tensor
    link_positions: Tensor
    link_rotations: Tensor
    palm: Tensor
    fingertips: Tensor
    joint_positions: Tensor
    joint_velocities: Tensor
    contacts: BatchContacts | None
    """None unless they were asked for."""


class BatchSimulator(ABC):
    """Many running scenes (n of them). `which` are always the indices (k,) of some worlds."""

    n: int
    device: torch.device
    dtype: torch.dtype
    links: tuple[str, ...]
    """Names of the hand's bodies."""
    kind: Kind
    """Kind of all objects."""
    diverged: Array
    """Bool (n,): whose state has not been finite since the last reset."""
    overflowed: Array
    """Bool (n,): which have had more contacts or constraints than there is room for, since the last
    reset."""

    @abstractmethod
    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Put objects of these half extents (k, 3), masses and frictions (k,) into worlds.

        A reset must follow.
        """

    @abstractmethod
    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Put worlds at rest at these joint positions and object poses, (k, ...) each; nobody carries.

        ``diverged`` says where that failed.
        """

    @abstractmethod
    def step(self, targets: Array, n_substeps: Array) -> None:
        """Advance each world by a number (n,) of timesteps towards joint targets (n, n_actuators).

        It may return before that is done; ``diverged`` and ``overflowed`` are known after `check`.
        """

    @abstractmethod
    def check(self) -> None:
        """Find which worlds diverged or overflowed in the last step."""

    @abstractmethod
    def state(self, with_contacts: bool = False) -> BatchState:
        """Return what is true now; valid until the next step or reset."""

    @abstractmethod
    def carry(self, which: Array, goal: Array) -> None:
        """Make givers carry objects towards goals (k, 3), m, from where they are."""

    @abstractmethod
    def let_go(self, which: Array) -> None:
        """Carry these objects no longer."""

    @abstractmethod
    def set_creep(self, factor: Array) -> None:
        """Make what sticks creep `factor` (n,) times as fast as in the scene as it is built."""

    def tensor(self, values: Any) -> Tensor:
        """Return numbers on the device, in the simulator's precision."""
        return torch.as_tensor(np.asarray(values), dtype=self.dtype, device=self.device)

    def close(self) -> None:
        """Release what is held outside Python."""


class LoopSimulator(BatchSimulator):
    """MuJoCo's own simulators, one after the other, in float64 on the CPU."""

    def __init__(self, scene: Scene, n: int) -> None:
        """Build n scenes."""
        self.n, self.kind = n, scene.shape.kind
        self.device, self.dtype = torch.device("cpu"), torch.float64
        self.worlds = [MujocoSimulator(scene) for _ in range(n)]
        self.links = self.worlds[0].state().links
        self.diverged, self.overflowed = np.zeros(n, bool), np.zeros(n, bool)

    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Change the worlds' models."""
        figures = (values.tolist() for values in (half_size, mass, friction))
        for i, half, *rest in zip(which, *figures, strict=True):
            self.worlds[i].change_object(Shape(self.kind, tuple(half)), *rest)

    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Reset each world."""
        for i, *start in zip(which, joints, position, yaw, targets, strict=True):
            self._guard(i, self.worlds[i].reset, *start)

    def _guard(self, i: int, act: Any, *arguments: Any) -> None:
        self.diverged[i] = False
        try:
            act(*arguments)
        except SimulationError:
            self.diverged[i] = True

    def step(self, targets: Array, n_substeps: Array) -> None:
        """Step each world."""
        for i, *where in zip(range(self.n), targets, n_substeps.tolist(), strict=True):
            if not self.diverged[i]:
                self._guard(i, self.worlds[i].step, *where)

    def check(self) -> None:
        """Do nothing: it is known."""

    def carry(self, which: Array, goal: Array) -> None:
        """Let each world's giver carry."""
        for i, place in zip(which, goal, strict=True):
            self.worlds[i].carry(place)

    def let_go(self, which: Array) -> None:
        """Let each world's giver let go."""
        for i in which:
            self.worlds[i].let_go()

    def set_creep(self, factor: Array) -> None:
        """Set each world's creep."""
        for world, value in zip(self.worlds, factor.tolist(), strict=True):
            world.set_creep(value)

    def state(self, with_contacts: bool = False) -> BatchState:
        """Stack the worlds' states."""
        states = [world.state() for world in self.worlds]
        fields = set(BatchState._fields) - {"half_size", "contacts"}
        stacked = {
            name: self.tensor([getattr(state, name) for state in states])
            for name in fields
        }
        half_size = self.tensor([state.shape.half_size for state in states])
        contacts = None
        if with_contacts:
            padded = [
                [
                    np.zeros((MAX_CONTACTS, *value.shape[1:]))
                    for value in states[0].contacts
                ]
                for _ in states
            ]
            for state, rows in zip(states, padded, strict=True):
                for row, value in zip(rows, state.contacts, strict=True):
                    row[: len(value)] = value[:MAX_CONTACTS]
            points, _, forces, normals = map(self.tensor, zip(*padded, strict=True))
            contacts = BatchContacts(points, forces, normals)
        return BatchState(half_size=half_size, contacts=contacts, **stacked)

    def close(self) -> None:
        """Close each world."""
        for world in self.worlds:
            world.close()


def make(scene: Scene, n: int, device: str, **options: Any) -> BatchSimulator:
    """Return n running scenes: MuJoCo's in a loop ("loop"), or MuJoCo Warp's on a PyTorch device.

    `options` are those of `warp.WarpSimulator`.

    Raise ValueError where there is no such device, ImportError where MuJoCo Warp is not installed.
    """
    if device == "loop":
        return LoopSimulator(scene, n, **options)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError("device: found no GPU, allowed without one: 'loop' (slow)")
    try:
        warp: Any = importlib.import_module(f"{__package__}.warp")
    except ModuleNotFoundError as error:
        raise ImportError(
            "found no MuJoCo Warp; install the extra: pip install 'tactilerl[gpu]'"
        ) from error
    return warp.WarpSimulator(scene, n, device, **options)
