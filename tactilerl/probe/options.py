"""What can be asked of `tactilerl probe`: a field a flag."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ..envs import hands, objects, scenes, tasks, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.hold import Verdict
from ..envs.observations import TaxelFaults, validate_faults
from ..envs.state import Kind
from ..machine import WorkerCount

LOST = {
    "object_density",
    "finger_gain",
    "timestep",
}  # of a scene: probed grasps keep the hand's
RULE = "skin"
"""By which taxels are read of the recorded poses."""


def _validate(flags: Any, *lists: str) -> None:
    """ValueError naming the first flag that is out of its range, and the first of the `lists` that is
    empty or has something twice."""
    validation.require(type(flags), vars(flags))
    for name in lists:
        values = getattr(flags, name)
        if not values or len(set(values)) < len(values):
            raise ValueError(
                f"{name}: found {list(values)}, allowed one or more, each once"
            )


@dataclass(frozen=True)
class GraspFlags:
    """Which grasps are simulated, and how they differ from each other: drawn evenly for each."""

    scene: str = ""
    """Take hand, simulator and objects from a named scene or a scene's .toml file; other flags override
    it."""
    env: str = "shadow"
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file."""
    simulator: str | None = None
    """Physics engine: mujoco or pybullet; default: the hand's."""
    grasps: Annotated[int, "[1, inf)"] = 2_000
    """Number of grasps to simulate."""
    seed: Annotated[int, "[0, 4294967295]"] = 0
    """Random seed of grasps, folds, noise and bootstrap samples."""
    object: tuple[Kind, ...] = ("box",)
    """Kinds of object: box, sphere, cylinder."""
    object_size: tuple[float, ...] = (0.04, 0.045, 0.05)
    """Edges of cubes, diameters (and heights) of spheres and cylinders, m."""
    friction: tuple[float, ...] = (0.5, 1.0)
    """Coefficients of sliding friction of the object."""
    start_offset: Annotated[float, "[0, 0.05]"] = 0.025
    """Largest random offset of the object along x and y, m."""
    start_yaw: Annotated[float, "[0, 3.2]"] = 0.6
    """Largest random turn of the object, rad."""
    closing: tuple[float, float] | None = None
    """How far the fingers close, from and to; 1: fully, as in the scripted grasp. Default: a range
    in which 30 to 70 % of the grasps hold (mpl 0.8 1.1, others 0.5 0.9)."""
    joint_jitter: validation.Fraction = 0.1
    """Largest random offset of a finger joint at the start, rad."""
    hold_verdict: Verdict = "settled"
    """full: is the object up 2 s after the lift?; settled: the same, but PyBullet stops early when
    the object has come to rest in the hand."""

    @classmethod
    def of_scene(cls, scene: str) -> GraspFlags:
        """What a named scene says of the grasps; ValueError and FileNotFoundError as `scenes.load`, and
        where its objects do not lie on the ground."""
        named = scenes.load(scene)
        config = setup(named.env, **named.scene)
        if tasks.TASKS[config.task].giver is not None:
            raise ValueError(f"scene: found {scene!r}, whose task is {config.task}, allowed scenes "
                             "whose object lies on the ground")  # fmt: skip
        if len(config.object_size) > 1 or LOST & named.scene.keys():
            raise ValueError(f"scene: found {scene!r}, which has several measures of an object or sets "
                             f"{', '.join(sorted(LOST))}, allowed scenes that do not")  # fmt: skip
        copied = ("start_offset", "start_yaw", "hold_verdict")
        said: dict[str, Any] = {
            name: named.scene[name] for name in copied if name in named.scene
        }
        for name, values in (
            ("object_size", config.object_size),
            ("friction", (config.friction,)),
        ):
            if name in named.scene:  # of a range, both ends
                ends = {end for value in values for end in objects.bounds(name, value)}
                said[name] = tuple(sorted(ends))
        if "object" in named.scene:
            said["object"] = tuple(config.object.split(","))
        return cls(scene=scene, env=named.env, simulator=config.simulator, **said)

    @property
    def closes(self) -> tuple[float, float]:
        """How far the fingers close, from and to."""
        return self.closing or hands.usage(self.env).closing

    @property
    def config(self) -> GraspConfig:
        """The hand's scene."""
        return setup(
            self.env, **({"simulator": self.simulator} if self.simulator else {})
        )

    def scenes(self) -> list[GraspConfig]:
        """One for each object."""
        usual, every = (
            self.config,
            itertools.product(self.object, self.object_size, self.friction),
        )
        return [
            replace(usual, object=k, object_size=(s,), friction=f) for k, s, f in every
        ]

    def settings(self) -> dict[str, Any]:
        """What a grasp follows from, besides its number: as the file of grasps has it."""
        digest = hands.digest(self.env)  # of a hand of one's own, which may change
        return {
            "env": self.env, "simulator": self.config.simulator, "touch_rule": RULE,
            "seed": self.seed, "hold_verdict": self.hold_verdict,
            "perturbation": {
                "kinds": self.object, "sizes": self.object_size, "frictions": self.friction,
                "offset": self.start_offset, "yaw": self.start_yaw, "closing": self.closes,
                "joint_jitter": self.joint_jitter,
            },
        } | ({"hand": digest} if digest else {})  # fmt: skip

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        if not hands.is_hand(self.env):
            raise ValueError(f"env: found {self.env!r}, allowed: {hands.allowed()}")
        _validate(self, "object", "object_size", "friction")
        low, high = self.closes
        if not 0 <= low <= high <= 2:
            raise ValueError(
                f"closing: found {low} {high}, allowed from 0 to 2, the smaller first"
            )
        for scene in self.scenes():
            validation.validate(scene)


@dataclass(frozen=True)
class AnalysisFlags:
    """How the grasps are analysed."""

    layout: tuple[str, ...] = tuple("123456")
    """Layouts to compare: 1 to 6, named designs, or .toml files."""
    joint_noise: tuple[Annotated[float, "[0, 10]"], ...] = (0.0, 0.05)
    """Standard deviations of noise on the joint angles, rad; each is reported."""
    folds: Annotated[int, "[2, inf)"] = 5
    """Folds of the cross-validation."""
    hold_out: Literal["grasps", "objects"] = "grasps"
    """What a fold holds out: some grasps, or all grasps of some objects, to test on unseen objects."""
    resamples: Annotated[int, "[100, inf)"] = 2_000
    """Number of bootstrap samples per interval."""
    shuffles: Annotated[int, "[2, inf)"] = 10
    """How often the outcomes are shuffled, to check that touch then gains nothing."""

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        _validate(self, "layout", "joint_noise")


@dataclass(frozen=True)
class OutputFlags:
    """Where results go and how they are shown."""

    out: Path | None = None
    """Folder for grasps.npz, probe.json and figures; default: probes/ENV_SIMULATOR, or with --from the
    folder of that file. Repeating the command continues an unfinished probe."""
    grasps_file: Annotated[Path | None, tyro.conf.arg(name="from", metavar="FILE")] = (
        None
    )
    """Read the grasps from this file instead of simulating them."""
    workers: WorkerCount = None
    """Grasps simulated side by side; default: one per free core. Results do not depend on it."""
    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Options:
    """All flags of `tactilerl probe`."""

    grasp: GraspFlags = GraspFlags()
    analysis: AnalysisFlags = AnalysisFlags()
    fault: TaxelFaults = field(default_factory=TaxelFaults)
    output: OutputFlags = OutputFlags()

    def validate(self) -> None:
        """Raise ValueError naming the first invalid flag."""
        self.grasp.validate()
        self.analysis.validate()
        validation.require(TaxelFaults, vars(self.fault))
        validate_faults(self.fault)
        validation.require(OutputFlags, vars(self.output))
