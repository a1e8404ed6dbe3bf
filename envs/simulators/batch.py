"""Many simulated scenes side by side: the interface, and its plain form, MuJoCo in a loop.

All worlds have the same hand and the same kind of object, whose measures differ by
world. What comes in by world is NumPy's, what is read is PyTorch's, on the device. The
loop is exact, and no faster than its worlds one after the other; `warp.WarpSimulator`
does the same on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from ..objects import Shape
from ..state import Array, Contacts, State
from . import Scene, SimulationError
from .mujoco import MujocoSimulator


class BatchSimulator:
    """Many running scenes (n of them). `which` are always the indices (k,) of some worlds."""

    diverged: Array
    """Bool (n,): where the last step or reset failed, or had no room for its
    contacts."""
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, scene: Scene, n: int) -> None:
        """Build n scenes."""
        self.n, self.kind = n, scene.shape.kind
        self.worlds = [MujocoSimulator(scene) for _ in range(n)]
        self.diverged = np.zeros(n, bool)

    def _each(
        self, which: Array, act: Callable[..., Any], *by_world: Iterable[Any]
    ) -> None:
        """Let some worlds act, with what is each one's own."""
        for i, *own in zip(which, *by_world, strict=True):
            try:
                act(self.worlds[i], *own)
            except SimulationError:
                self.diverged[i] = True

    def change_object(
        self, which: Array, half_size: Array, mass: Array, friction: Array
    ) -> None:
        """Put objects of these half extents (k, 3), masses and frictions (k,) into worlds.

        A reset must follow.
        """
        shapes = [Shape(self.kind, tuple(half)) for half in half_size.tolist()]
        figures = shapes, mass.tolist(), friction.tolist()
        self._each(which, MujocoSimulator.change_object, *figures)

    def reset(
        self, which: Array, joints: Array, position: Array, yaw: Array, targets: Array
    ) -> None:
        """Put worlds at rest at joint positions and object poses, (k, ...) each; nobody carries."""
        self.diverged[which] = False
        self._each(which, MujocoSimulator.reset, joints, position, yaw, targets)

    def step(self, targets: Array, n_substeps: Array) -> None:
        """Advance each world by a number (n,) of timesteps towards joint targets (n, n_actuators)."""
        which = np.flatnonzero(~self.diverged)
        own = targets[which], n_substeps[which].tolist()
        self._each(which, MujocoSimulator.step, *own)

    def carry(self, which: Array, goal: Array) -> None:
        """Make givers carry objects towards goals (k, 3), m, from where they are."""
        self._each(which, MujocoSimulator.carry, goal)

    def let_go(self, which: Array) -> None:
        """Carry these objects no longer."""
        self._each(which, MujocoSimulator.let_go)

    def set_creep(self, factor: Array) -> None:
        """Make what sticks creep `factor` (n,) times as fast as in the scene as it is built."""
        every = np.arange(self.n)
        self._each(every, MujocoSimulator.set_creep, factor.tolist())

    def state(self) -> State:
        """Return what is true now, in tensors (n, ...); valid until the next step or reset."""
        states = [world.state() for world in self.worlds]
        each_contacts = zip(*(state.contacts for state in states), strict=True)
        padded = [
            pad_sequence([*map(self.tensor, part)], True) for part in each_contacts
        ]
        half_size: Any = self.tensor([state.shape.half_size for state in states])
        parts: dict[str, Any] = {
            name: self.tensor([getattr(state, name) for state in states])
            for name in vars(states[0])
            if name not in ("shape", "links", "contacts")
        }
        return State(
            shape=Shape(self.kind, tuple(half_size.T)),
            links=states[0].links,
            contacts=Contacts(*padded),  # type: ignore[arg-type]
            **parts,
        )

    def tensor(self, values: Any) -> Tensor:
        """Return an array on the device; numbers that are not whole have the simulator's precision."""
        values = np.asarray(values)
        dtype = self.dtype if values.dtype.kind == "f" else None
        return torch.as_tensor(values, dtype=dtype, device=self.device)
