"""Many simulated scenes side by side: the interface, and its plain form, MuJoCo in a loop.

All worlds have the same hand and the same kind of object, whose measures differ by world. What comes
in by world is NumPy's, what is read is PyTorch's, on the device. The loop is exact, and no faster than
its worlds one after the other; `warp.WarpSimulator` does the same on a GPU.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..objects import Shape
from ..state import Array, Contacts, State
from . import Scene, SimulationError
from .mujoco import MujocoSimulator

MAX_CONTACTS = 32  # of hand and object in a world


class BatchSimulator:
    """Many running scenes (n of them). `which` are always the indices (k,) of some worlds."""

    diverged: Array
    """Bool (n,): where the last step or reset failed, or had no room for its contacts."""
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, scene: Scene, n: int) -> None:
        """Build n scenes."""
        self.n, self.kind = n, scene.shape.kind
        self.worlds = [MujocoSimulator(scene) for _ in range(n)]
        self.diverged = np.zeros(n, bool)

    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Put objects of these half extents (k, 3), masses and frictions (k,) into worlds.

        A reset must follow.
        """
        figures = (values.tolist() for values in (half_size, mass, friction))
        for i, half, *rest in zip(which, *figures, strict=True):
            self.worlds[i].change_object(Shape(self.kind, tuple(half)), *rest)

    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Put worlds at rest at joint positions and object poses, (k, ...) each; nobody carries."""
        for i, *start in zip(which, joints, position, yaw, targets, strict=True):
            self._guard(i, self.worlds[i].reset, *start)

    def _guard(self, i: int, act: Any, *arguments: Any) -> None:
        self.diverged[i] = False
        try:
            act(*arguments)
        except SimulationError:
            self.diverged[i] = True

    def step(self, targets: Array, n_substeps: Array) -> None:
        """Advance each world by a number (n,) of timesteps towards joint targets (n, n_actuators)."""
        for i, *where in zip(range(self.n), targets, n_substeps.tolist(), strict=True):
            if not self.diverged[i]:
                self._guard(i, self.worlds[i].step, *where)

    def carry(self, which: Array, goal: Array) -> None:
        """Make givers carry objects towards goals (k, 3), m, from where they are."""
        for i, place in zip(which, goal, strict=True):
            self.worlds[i].carry(place)

    def let_go(self, which: Array) -> None:
        """Carry these objects no longer."""
        for i in which:
            self.worlds[i].let_go()

    def set_creep(self, factor: Array) -> None:
        """Make what sticks creep `factor` (n,) times as fast as in the scene as it is built."""
        for world, value in zip(self.worlds, factor.tolist(), strict=True):
            world.set_creep(value)

    def state(self) -> State:
        """Return what is true now, in tensors (n, ...); valid until the next step or reset."""
        states = [world.state() for world in self.worlds]
        contacts = [
            np.zeros((self.n, MAX_CONTACTS, *part.shape[1:]), part.dtype)
            for part in states[0].contacts
        ]
        for i, state in enumerate(states):
            for whole, part in zip(contacts, state.contacts, strict=True):
                whole[i, : len(part)] = part[:MAX_CONTACTS]
        stacked: Any = {
            name: self.tensor([getattr(state, name) for state in states])
            for name in vars(states[0])
            if name not in ("shape", "links", "contacts")
        }
        half_size: Any = self.tensor([state.shape.half_size for state in states])
        return State(
            shape=Shape(self.kind, tuple(half_size.T)),
            links=states[0].links,
            contacts=Contacts(*map(self.tensor, contacts)),  # type: ignore[arg-type]
            **stacked,
        )

    def tensor(self, values: Any) -> Tensor:
        """Return an array on the device; numbers that are not whole have the simulator's precision."""
        values = np.asarray(values)
        dtype = self.dtype if values.dtype.kind == "f" else None
        return torch.as_tensor(values, dtype=dtype, device=self.device)

    def close(self) -> None:
        """Release what is held outside Python."""


def make(scene: Scene, n: int, device: str) -> BatchSimulator:
    """Return n running scenes: MuJoCo's in a loop ("loop"), or MuJoCo Warp's on a PyTorch device.

    Raise ValueError where there is no such device, ImportError where MuJoCo Warp is not installed.
    """
    if device == "loop":
        return BatchSimulator(scene, n)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError("device: found no GPU, allowed without one: 'loop' (slow)")
    try:
        warp: Any = importlib.import_module(f"{__package__}.warp")
    except ModuleNotFoundError as error:
        raise ImportError(
            "found no MuJoCo Warp; install the extra: pip install 'tactilerl[gpu]'"
        ) from error
    return warp.WarpSimulator(scene, n, device)  # type: ignore[no-any-return]
