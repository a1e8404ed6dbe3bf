"""The interface of a simulator: one scene with a hand, one object and the ground."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from .. import plugins
from ..hands import Hand
from ..objects import Shape, like
from ..skin import Skin
from ..state import Array, State, places

if TYPE_CHECKING:
    import mujoco


class SimulationError(FloatingPointError):
    """The physics produced NaN or infinity, or ran out of memory; the scene must be reset."""


@dataclass(frozen=True)
class Giver:
    """Bring the object to the hand: hold it by a damped spring and carry its weight.

    The spring's rest point moves at `speed`, so what stands in the way is pressed on
    harder and harder, but never with more than `force`.
    """

    stiffness: float = 80.0
    """Stiffness of the spring, N/m."""
    damping: float = 4.0
    """Damping of the spring, N s/m; about critical for 50 g."""
    force: float = 1.0
    """Largest force along each axis, N."""
    speed: float = 0.6
    """Speed of the rest point, m/s."""

    def pull(self, rest: Array, position: Array, velocity: Array) -> Array:
        """Return the spring's force (3,) on an object at `position`, N; `rest` is its rest point."""
        force = self.stiffness * (rest - position) - self.damping * velocity
        return np.clip(force, -self.force, self.force)


class Sensor(NamedTuple):
    """A sphere on a link, in which the simulator itself feels contacts; m."""

    link: str
    centre: Array
    """Centre (3,) in the link's frame."""
    radius: float


class Sphere(NamedTuple):
    """A sphere that a picture shows besides the scene; m."""

    centre: Array
    """Centre (3,) in the world's frame."""
    radius: float
    colour: tuple[float, float, float, float]
    """Red, green, blue and opacity, 0 to 1."""


@dataclass(frozen=True)
class Scene:
    """A hand, an object and what else is simulated, in SI units."""

    hand: Hand
    shape: Shape
    mass: float
    friction: float
    """Sliding friction of the object against everything."""
    timestep: float
    finger_gain: float
    rise: float = 0.0
    """Height by which the hand hangs higher than usual."""
    sensors: tuple[Sensor, ...] = ()
    giver: Giver | None = None
    """Giver that may carry the object."""
    skin: Skin | None = None
    """Soft covering of the hand."""
    visual: bool = False
    """True to keep the meshes that only pictures need."""

    def with_object(self, shape: Shape, mass: float, friction: float) -> Scene:
        """Return the scene with another object; itself where it is the same."""
        if (shape, mass, friction) == (self.shape, self.mass, self.friction):
            return self
        return replace(self, shape=shape, mass=mass, friction=friction)

    def build_hand(self, visual: bool) -> mujoco.MjSpec:
        """Return the hand alone, where it starts."""
        spec = self.hand.build(visual, self.finger_gain)
        root = spec.worldbody.first_body()
        root.pos = root.pos + np.array([0.0, 0.0, self.rise])
        return spec

    @cached_property
    def points(self) -> tuple[tuple[str, ...], Array]:
        """Links of palm point and fingertips, and these (1 + n_digits, 3, 1) in their frames, m."""
        palm = self.hand.palm, self.hand.palm_point
        links, points = zip(palm, *self.hand.fingertips, strict=True)
        return links, np.array(points)[:, :, None]

    def state(
        self,
        links: tuple[str, ...],
        positions: Array,
        rotations: Array,
        **measured: Any,
    ) -> State:
        """Return a state with these poses of links, and the palm point and fingertips on them."""
        on_links, points = self.points
        at = places(links, on_links)
        offsets = rotations[..., at, :, :] @ like(points, rotations)
        placed = positions[..., at, :] + offsets[..., 0]
        return State(
            shape=self.shape,
            links=links,
            link_positions=positions,
            link_rotations=rotations,
            palm=placed[..., 0, :],
            fingertips=placed[..., 1:, :],
            **measured,
        )


@dataclass(frozen=True)
class Camera:
    """A camera on a circle around the palm and the object."""

    azimuth: float = 120.0
    """Direction, degrees."""
    elevation: float = 35.0
    """Elevation, degrees; positive looks up from below, where the palmar side is."""
    distance: float = 0.32
    """Distance, m."""
    lookat: tuple[float, float, float] | None = None
    """Point it looks at, m; None: between the palm and the object, wherever they
    are."""
    width: int = 720
    height: int = 540
    shadows: bool = True
    """True for shadows: without a graphics card they take five sixths of the time."""


class Simulator(ABC):
    """One running scene. Everything is in SI units, the world's frame, z up, ground at 0."""

    holds_gil: ClassVar[bool]
    """True where `step` keeps other threads of Python waiting."""
    joint_limits: Array
    """Lowest and highest positions (n_joints, 2) of ``hand.joints``, rad or m, ±inf
    without one."""

    warnings: int = 0
    """Number of times that the engine has warned since it was made, resets included."""

    def __init__(self, scene: Scene) -> None:
        """Build a scene, with the hand's targets at its start."""
        self.scene, self._targets = scene, scene.hand.start_targets()

    def change_object(self, shape: Shape, mass: float, friction: float) -> None:
        """Put another object into the scene; a reset must follow."""
        self.scene = self.scene.with_object(shape, mass, friction)

    def reset(
        self,
        joint_positions: Array,
        object_position: Array,
        yaw: float,
        targets: Array | None = None,
    ) -> None:
        """Put everything at rest; afterwards the past has no influence.

        Raise SimulationError when the physics cannot begin there. `targets`
        (n_actuators,) are the state's until the next step; usually the hand's at its
        start.
        """
        self._targets = self.scene.hand.start_targets() if targets is None else targets
        with self._checked():
            self._begin(joint_positions, object_position, yaw)

    def step(self, joint_targets: Array, n_substeps: int) -> None:
        """Advance by `n_substeps` timesteps. Raise SimulationError when that broke the state."""
        self._targets = np.array(joint_targets)
        with self._checked():
            self._advance(n_substeps)

    @abstractmethod
    def _begin(
        self, joint_positions: Array, object_position: Array, yaw: float
    ) -> None:
        """Put everything at rest."""

    @abstractmethod
    def _advance(self, n_substeps: int) -> None:
        """Advance towards the targets."""

    @abstractmethod
    def _checked(self) -> AbstractContextManager[None]:
        """Raise SimulationError where the engine fails inside, or the state is broken after it."""

    @abstractmethod
    def carry(self, goal: Array) -> None:
        """Make the scene's giver carry the object towards `goal` (3,), m, from where it is.

        After a reset nobody carries it.
        """

    @abstractmethod
    def let_go(self) -> None:
        """Carry the object no longer."""

    def set_creep(self, factor: float) -> None:
        """Make what sticks creep `factor` times as fast as in the scene as it is built.

        It does nothing where dry friction does not creep.
        """

    @abstractmethod
    def state(self) -> State:
        """Return what is true now; contacts are those of the last timestep."""

    @abstractmethod
    def render(self, camera: Camera, spheres: Sequence[Sphere] = ()) -> Array:
        """Return an RGB picture (height, width, 3) uint8 of the scene with some spheres."""

    @abstractmethod
    def close(self) -> None:
        """Release what is held outside Python."""


def joint_limits(model: mujoco.MjModel, hand: Hand) -> Array:
    """Return the limits (n_joints, 2) of a hand's joints in a compiled model, ±inf without one."""
    joints = [model.joint(name).id for name in hand.joints]
    limited = model.jnt_limited[joints].astype(bool)
    return np.where(limited[:, None], model.jnt_range[joints], (-np.inf, np.inf))


SIMULATORS = {
    "mujoco": f"{__name__}.mujoco:MujocoSimulator",
    "pybullet": f"{__name__}.pybullet:PyBulletSimulator",
}
"""Place of a simulator's class, "module:class", by the name that one asks for it by."""
MISSING = {
    "pybullet": "simulator pybullet: found no PyBullet; install the extra: pip install "
    "'tactilerl[pybullet]' (wheels for Python up to 3.11), or choose --simulator mujoco",
}
"""Message where a simulator's module cannot be imported."""


def make(name: str, scene: Scene) -> Simulator:
    """Return a running scene; the simulator's package is imported here and not before."""
    module, _, kind = SIMULATORS[name].partition(":")
    try:
        known = {name: getattr(importlib.import_module(module), kind, None)}
    except ModuleNotFoundError as error:
        raise ImportError(MISSING.get(name, str(error))) from error
    simulator: type[Simulator] = plugins.require_class(
        known, name, "simulator", Simulator
    )
    return simulator(scene)
