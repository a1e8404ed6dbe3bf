"""The interface of many simulated scenes side by side, and its plain form: MuJoCo in a loop.

All worlds have the same hand and the same kind of object, whose measures differ by world. What comes
in by world is NumPy's, what is read is PyTorch's, on the device. The loop shows what a batch means; it
is exact, and no faster than its worlds one after the other.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..objects import Kind, Shape
from ..state import Array, Contacts, State
from . import Scene, SimulationError
from .mujoco import MujocoSimulator

MAX_CONTACTS = 32  # of hand and object in a world


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
    def state(self, with_contacts: bool = False) -> State:
        """Return what is true now, in tensors (n, ...); valid until the next step or reset.

        Targets and sensors are empty, and contacts too unless they are asked for.
        """

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
        """Return an array on the device; numbers that are not whole have the simulator's precision."""
        values = np.asarray(values)
        dtype = self.dtype if values.dtype.kind == "f" else None
        return torch.as_tensor(values, dtype=dtype, device=self.device)

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

    def state(self, with_contacts: bool = False) -> State:
        """Stack the worlds' states."""
        states, room = (
            [world.state() for world in self.worlds],
            MAX_CONTACTS if with_contacts else 0,
        )
        parts = states[0].contacts
        contacts = [
            np.zeros((self.n, room, *part.shape[1:]), part.dtype) for part in parts
        ]
        for i, state in enumerate(states):
            for whole, part in zip(contacts, state.contacts, strict=True):
                whole[i, : len(part)] = part[:room]
        apart = "shape", "links", "contacts", "targets", "sensors"
        stacked: dict[str, Any] = {
            name: self.tensor([getattr(state, name) for state in states])
            for name in vars(states[0])
            if name not in apart
        }
        stacked["targets"] = stacked["sensors"] = self.tensor(np.zeros((self.n, 0)))
        half_size = self.tensor([state.shape.half_size for state in states])
        stacked["shape"] = Shape(self.kind, tuple(half_size.T))  # type: ignore[arg-type]
        stacked["contacts"] = Contacts(*map(self.tensor, contacts))  # type: ignore[arg-type]
        return State(links=self.links, **stacked)

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
