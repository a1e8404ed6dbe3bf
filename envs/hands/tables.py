"""The content of a hand's TOML file (docs/guides/own_hand.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from ..validation import Fraction

CLOSING_STEP = 0.5  # how far an action of 1 closes fingers that go from open to closed
Number = Annotated[float, "[-1e9, 1e9]"]
Positive = Annotated[float, "[0, 1e9]"]
Vector = tuple[Number, Number, Number]
Span = tuple[Number, Number]
Names = tuple[str, ...]


@dataclass(frozen=True)
class Slides:
    """The slides of the whole hand, and how actions move them."""

    gain: Positive = 1000.0
    """Position gain, N/m."""
    damping: Positive = 79.0
    """Damping, N s/m."""
    force: Positive = 30.0
    """Largest force, N. Without a limit on it the hand would be pressed into the
    ground."""
    centre: Vector | None = None
    """Position at action 0, m; default: the height of the last grasp."""
    half_range: tuple[Fraction, Fraction, Fraction] = (0.03, 0.03, 0.20)
    """Distances that actions of 1 move them from there, m."""
    step: Vector = (0.01, 0.01, 0.2)
    """Distances that actions of 1 move them where actions are increments, m."""
    limits: tuple[Span, Span, Span] = ((-0.02, 0.02), (-0.02, 0.02), (-0.03, 0.06))
    """Limits around the grasping height where actions are increments, m."""


@dataclass(frozen=True)
class HingeServo:
    """The servo of a hinge whose model has none."""

    gain: Positive = 10.0
    """Position gain, N m/rad."""
    damping: Positive = 0.5
    """Damping of the joint, N m s/rad."""
    armature: Positive = 0.01
    """Inertia of the motor, kg m²."""
    limit: Positive = 1.0
    """Largest torque, N m."""


@dataclass(frozen=True)
class SlideServo(HingeServo):
    """The servo of a finger's slide whose model has none, in N/m and so on."""

    gain: Positive = 1000.0
    damping: Positive = 50.0
    armature: Positive = 0.1
    limit: Positive = 20.0


@dataclass(frozen=True)
class Servos:
    """The library's servos, by the kind of joint."""

    hinge: HingeServo = HingeServo()
    slide: SlideServo = SlideServo()


@dataclass(frozen=True)
class DigitTable:
    """One digit of [digits]."""

    links: Names
    """Links from knuckle to tip."""
    tip: Vector
    """Fingertip in the frame of the last link, m."""
    palmar: Vector | tuple[Vector, ...] | None = None
    """Palmar direction of all links, or of each."""
    base: Vector | None = None
    """Point on the palm where the digit begins, m."""
    base_link: str | None = None
    """Body in whose frame `base` is; default: the palm."""


@dataclass(frozen=True)
class Follows:
    """One joint of [couplings], which is offset + ratio times its driver."""

    follows: str
    ratio: Number
    offset: Number = 0.0


@dataclass(frozen=True)
class Place:
    """The place of a point of the palm at the start, m."""

    of: Vector | None = None
    at: Vector | None = None


@dataclass(frozen=True)
class PitchTable:
    """[pitch]: distances between taxels and their radii, m."""

    rows: dict[str, Positive] = field(default_factory=dict)
    column: Positive | None = None
    radius: Positive = 2e-3
    large_radius: Positive = 3.8e-3
    distal_shift: Number = 0.0


@dataclass(frozen=True)
class Actions:
    """[actions]: of joints, or increments of slides and of groups of digits that close."""

    kind: Literal["joints", "closing"] = "joints"
    step: Positive = CLOSING_STEP
    groups: tuple[Names, ...] = ()


@dataclass(frozen=True)
class GraspTable:
    """One [[grasp]]: where the palm's point or the slides are, and the joints."""

    object_size: Positive
    at: Vector | None = None
    slides: Vector | None = None
    joints: dict[str, Number] = field(default_factory=dict)
    closing: Number | None = None


@dataclass(frozen=True)
class HandFile:
    """All that a hand's file may say (docs/guides/own_hand.md)."""

    model: str
    palm: str
    palmar: Vector
    fingers: Vector
    palm_point: Vector
    digits: dict[str, DigitTable]
    root: str = ""
    drop: Names = ()
    masses: dict[str, Positive] = field(default_factory=dict)
    contacts: Literal["others", "model"] = "others"
    palm_is_flat: bool = False
    added_inertia: Positive = 1e-4
    """Rotational inertia that every link gets in Bullet, kg m²: the solver needs it,
    and the value is the one that comes nearest to small timesteps
    (docs/accuracy_and_speed.md)."""
    observation: Names = (
        "joint_positions",
        "joint_velocities",
        "object_position",
        "object_orientation",
    )
    first_joints: Names = ()
    handed_beside: Names = ()
    environment: dict[str, Any] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)
    place: Place = Place()
    slides: Slides = field(default_factory=Slides)
    servos: Servos = field(default_factory=Servos)
    ranges: dict[str, Span] = field(default_factory=dict)
    passive: Names = ()
    pitch: PitchTable = PitchTable()
    couplings: dict[str, Follows] = field(default_factory=dict)
    start: dict[str, Number] | None = None
    start_closing: dict[str, Number] = field(default_factory=dict)
    opened: dict[str, Number] = field(default_factory=dict)
    closed: dict[str, Number] = field(default_factory=dict)
    actions: Actions = Actions()
    grasp: tuple[GraspTable, ...] = ()
