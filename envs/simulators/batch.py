"""Many simulated scenes side by side: the interface, and its plain form, MuJoCo in a loop.

All worlds have the same hand and the same kind of object, whose measures differ by world. What comes
in by world is NumPy's, what is read is PyTorch's, on the device. The loop is exact, and no faster than
its worlds one after the other; `warp.WarpSimulator` does the same on a GPU.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from importlib.util import find_spec
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
    """Bool (n,): where the last step or reset failed, or had no room for its contacts."""
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
        states = [vars(world.state()) for world in self.worlds]
        parts: dict[str, Any] = {k: [state[k] for state in states] for k in states[0]}
        links, contacts = (
            parts.pop("links")[0],
            zip(*parts.pop("contacts"), strict=True),
        )
        half_size: Any = self.tensor([one.half_size for one in parts.pop("shape")])
        padded = [pad_sequence([*map(self.tensor, part)], True) for part in contacts]
        stacked: Any = {name: self.tensor(part) for name, part in parts.items()}
        return State(
            shape=Shape(self.kind, tuple(half_size.T)),
            links=links,
            contacts=Contacts(*padded),  # type: ignore[arg-type]
            **stacked,
        )

    def tensor(self, values: Any) -> Tensor:
        """Return an array on the device; numbers that are not whole have the simulator's precision."""
        values = np.asarray(values)
        dtype = self.dtype if values.dtype.kind == "f" else None
        return torch.as_tensor(values, dtype=dtype, device=self.device)


def require(device: str) -> None:
    """Raise ValueError where there is no such device, ImportError without MuJoCo Warp."""
    if device != "loop" and find_spec("mujoco_warp") is None:  # which needs warp itself
        raise ImportError(
            "found no MuJoCo Warp, which a GPU needs: pip install 'tactilerl[gpu]'"
        )
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            f"device: found no GPU that PyTorch {torch.__version__} can use here; it takes an NVIDIA "
            "GPU, its driver, and PyTorch for CUDA (https://pytorch.org/get-started)"
        )


def make(scene: Scene, n: int, device: str) -> BatchSimulator:
    """Return n running scenes: MuJoCo's in a loop ("loop"), or MuJoCo Warp's on a PyTorch device."""
    require(device)
    if device == "loop":
        return BatchSimulator(scene, n)
    warp: Any = importlib.import_module(f"{__package__}.warp")
    return warp.WarpSimulator(scene, n, device)  # type: ignore[no-any-return]
