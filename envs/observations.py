"""What the policy is told: terms, sight of the object, joint angles, taxels with their faults, history.

One small object a concern. Each is a `Stage` that a reading passes on its way: it is begun with every
episode and a generator of its own, so that what one draws moves nothing that another draws. Goals
and rewards never pass here: they keep the truth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from . import objects
from .hands import SLIDES, Array, Hand
from .snapshot import Snapshot
from .typed import NotNegative, Share

SIGHT_NOISE = (0.01, 0.1)  # m and rad, where noise is asked for without saying how much


@dataclass(frozen=True)
class TaxelFaults:
    """Broken taxels and false readings. None, by default."""

    taxel_false_on: Share = 0.0
    """Probability per step that a taxel that is off reads on."""
    taxel_false_off: Share = 0.0
    """Probability per step that a taxel that is on reads off."""
    taxel_dead: Share = 0.0
    """Share of taxels that never fire; --hand-seed decides which."""
    taxel_stuck: Share = 0.0
    """Share of taxels that always fire; --hand-seed decides which."""


@dataclass(frozen=True)
class SensorConfig(TaxelFaults):
    """How well the hand senses its joints, the object and touch. Perfectly, by default."""

    object_seen: Literal["exact", "noisy", "start", "hidden"] = "exact"
    """How the policy sees the object's pose: exact (paper), noisy (--sight-noise), start (where it was
    at the start of the episode), or hidden (zeros)."""
    sight_noise: tuple[NotNegative, NotNegative] | None = None
    """With --object-seen noisy: standard deviations of the noise on each coordinate, m, and about each
    axis, rad; default: 0.01 0.1."""
    sight_noise_kind: Literal["white", "held"] = "white"
    """white: drawn at every step; held: drawn once per episode."""
    joint_noise: NotNegative = 0.0
    """Standard deviation of the noise on each observed joint angle, rad, drawn at every step.
    Velocities get the matching error."""
    joint_noise_held: NotNegative = 0.0
    """Standard deviation of a constant offset on each observed joint angle, rad, drawn once per
    episode."""
    slide_noise: NotNegative = 0.0
    """Like --joint-noise, for the slides, which carry the hand, m."""
    slide_noise_held: NotNegative = 0.0
    """Like --joint-noise-held, for the slides, m."""
    taxel_delay: Annotated[int, "[0, 100]"] = 0
    """Delay of the taxel readings, in control steps."""
    hand_seed: Annotated[int, "[0, 4294967295]"] | None = None
    """Random seed that decides which taxels are broken; default: the run's seed."""


@dataclass(frozen=True)
class ObservationConfig(SensorConfig):
    """What the policy observes."""

    history: Annotated[int, "[1, 100]"] = 1
    """Number of latest observations that the policy sees, stacked."""
    observe_targets: bool = False
    """Include the current joint targets in the observation, or how far groups of fingers are to close.
    The paper leaves them out."""
    critic_sees: Literal["observation", "truth"] = "observation"
    """truth: the critic, but not the policy, also sees the object's pose, exact joint angles and
    contacts."""


SHARES = tuple(field.name for field in fields(TaxelFaults))


def validate(config: ObservationConfig, run_type: str, is_boolean: bool) -> None:
    """ValueError naming the first field that does nothing in a run of this type."""
    validate_faults(config)
    if config.object_seen != "noisy":
        _require_defaults(config, ("sight_noise", "sight_noise_kind"), "object_seen noisy")
    if run_type != "main":
        only_with = "run_type main (in others no taxel is read)"
        _require_defaults(config, (*SHARES, "taxel_delay"), only_with)
    if not is_boolean:
        only_with = "Boolean taxels (touch skin or contact)"
        _require_defaults(config, ("taxel_false_on", "taxel_stuck"), only_with)


def validate_faults(faults: TaxelFaults) -> None:
    """ValueError where there are more broken taxels than taxels."""
    if (together := faults.taxel_dead + faults.taxel_stuck) > 1:
        raise ValueError(f"taxel_stuck: found {together:g} with taxel_dead, allowed together up to 1")


def _require_defaults(config: ObservationConfig, names: tuple[str, ...], only_with: str) -> None:
    """ValueError for a field that was set where it does nothing."""
    defaults = {field.name: field.default for field in fields(config)}
    for name in names:
        if (found := getattr(config, name)) != defaults[name]:
            raise ValueError(f"{name}: found {found}, allowed only with {only_with}")


# -- terms -----------------------------------------------------------------------------------


class Term(NamedTuple):
    """A few entries of the observation; a hand's ``observation`` says which terms it has."""

    what: str
    """All entries are."""
    each: Callable[[Hand], Sequence[str]]
    """Which of that each one is."""
    read: Callable[[Hand, Snapshot], Array]
    """(n,) from what the policy may know."""


def term_names(terms: Sequence[str], hand: Hand) -> list[str]:
    """What each entry of some terms is."""
    return [f"{TERMS[term].what} {each}" for term in terms for each in TERMS[term].each(hand)]


def _of_first_joints(hand: Hand, now: Snapshot) -> Array:
    return now.joint_positions.take([hand.joints.index(joint) for joint in hand.first_joints])


TERMS = {
    "object_id": Term(
        "object kind:",
        lambda hand: [", ".join(objects.KINDS)],
        lambda hand, now: np.array([float(objects.KINDS.index(now.shape.kind))]),
    ),
    "hand_position": Term("hand", lambda hand: "xyz", lambda hand, now: now.hand),
    "finger_joints": Term("position of", lambda hand: hand.first_joints, _of_first_joints),
    "joint_positions": Term(
        "position of", lambda hand: hand.joints, lambda hand, now: now.joint_positions
    ),
    "joint_velocities": Term(
        "velocity of", lambda hand: hand.joints, lambda hand, now: now.joint_velocities
    ),
    "object_position": Term("object", lambda hand: "xyz", lambda hand, now: now.object.position),
    "object_orientation": Term(
        "object quaternion", lambda hand: "wxyz", lambda hand, now: now.object.orientation
    ),
    "asked": Term(
        "asked for:",
        lambda hand: hand.action_names,
        lambda hand, now: hand.action_map.asked(now.targets),
    ),
}
TRUE = ("joint_positions", "joint_velocities", "object_position", "object_orientation")


# -- stages ----------------------------------------------------------------------------------


class Stage(Protocol):
    """What happens to a reading (..., n) on its way to the policy."""

    def begin(self, rng: np.random.Generator) -> None:
        """A new episode, whose draws come from `rng`."""

    def __call__(self, reading: Array) -> Array:
        """What comes out of one control step's reading; the first is the episode's start."""


class JointErrors:
    """Errors of joint sensors: at every step, and for an episode.

    Velocities are taken for differences of angles, so that what is held does not show in them.
    """

    def __init__(self, white: Array, held: Array, control_dt: float) -> None:
        """Standard deviations (n,) of both, rad or m."""
        self.white, self.held, self.control_dt = white, held, control_dt

    def begin(self, rng: np.random.Generator) -> None:
        (held,) = rng.spawn(1)  # draws nothing from `rng`
        self._rng, self._error = rng, self.held * held.standard_normal(self.held.shape)
        self._noise: Array | None = None

    def __call__(self, truth: Snapshot) -> Snapshot:
        """What is sensed of joints and hand; once a control step."""
        noise, before = self.white * self._rng.standard_normal(self.white.shape), self._noise
        self._noise = noise
        error = self._error + noise
        speed = 0.0 if before is None else (noise - before) / self.control_dt
        return replace(
            truth,
            joint_positions=truth.joint_positions + error,
            joint_velocities=truth.joint_velocities + speed,
            hand=truth.hand + error[: len(SLIDES)],  # carried by the slides, along the world's axes
        )


class FalseReadings:
    """Bits that flip at random."""

    def __init__(self, false_on: float, false_off: float) -> None:
        self.false_on, self.false_off = false_on, false_off

    def begin(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __call__(self, reading: Array) -> Array:
        draws = self._rng.random(reading.shape)
        off = draws < self.false_on
        return np.where(reading > 0, np.where(draws < self.false_off, 0, reading), off)


class Broken:
    """Sensors that always read the same: some are dead and read 0, some are stuck and read 1.

    Which ones follows from `seed` alone, and those of a smaller share are among those of a larger.
    """

    def __init__(self, n: int, dead: float, stuck: float, seed: int) -> None:
        order = np.random.default_rng(seed).permutation(n)
        n_dead = round(dead * n)
        self.dead = order[:n_dead]
        self.stuck = order[max(n_dead, n - round(stuck * n)) :]

    def begin(self, rng: np.random.Generator) -> None:
        """A hand's life is longer than an episode."""

    def __call__(self, reading: Array) -> Array:
        reading = reading.copy()
        reading[..., self.dead], reading[..., self.stuck] = 0, 1
        return reading


class Past:
    """The readings of the last `n` control steps; before an episode, all was as at its start."""

    def __init__(self, n: int) -> None:
        self._readings: deque[Array] = deque(maxlen=n)

    def begin(self, rng: np.random.Generator) -> None:
        self._readings.clear()

    def add(self, reading: Array) -> deque[Array]:
        """With this one, the oldest first."""
        n_missing = 1 if self._readings else (self._readings.maxlen or 1)
        self._readings.extend([reading] * n_missing)
        return self._readings


class Delay(Past):
    """What was read `steps` control steps ago."""

    def __init__(self, steps: int) -> None:
        super().__init__(steps + 1)

    def __call__(self, reading: Array) -> Array:
        return self.add(reading)[0]


class History(Past):
    """The last `n` readings side by side, the newest first."""

    def __call__(self, reading: Array) -> Array:
        return np.concatenate(list(reversed(self.add(reading))))


# -- sight -----------------------------------------------------------------------------------


class Sight:
    """How the object's pose is seen: as it is, off by a random offset and a turn about a random axis
    (at every step or for an episode), as it was when the episode began, or not at all."""

    def __init__(self, config: SensorConfig) -> None:
        self._seen, self._is_held = config.object_seen, config.sight_noise_kind == "held"
        self._scale = np.repeat(config.sight_noise or SIGHT_NOISE, 3)

    def begin(self, rng: np.random.Generator) -> None:
        """A new episode."""
        self._rng = rng
        self._first: objects.ObjectState | None = None
        self._error = self._draw()

    def _draw(self) -> Array:
        return self._scale * self._rng.standard_normal(6)

    def __call__(self, obj: objects.ObjectState) -> objects.ObjectState:
        """What is seen of it; only position and orientation count."""
        if self._seen == "exact":
            return obj
        if self._seen == "hidden":
            return objects.ObjectState(np.zeros(3), np.zeros(4), obj.rotation)
        self._first = self._first or obj
        if self._seen == "start":
            return self._first
        error = self._error if self._is_held else self._draw()
        truth = Rotation.from_quat(obj.orientation, scalar_first=True)
        orientation = (Rotation.from_rotvec(error[3:]) * truth).as_quat(scalar_first=True)
        return objects.ObjectState(obj.position + error[:3], orientation, obj.rotation)


# -- all of it -------------------------------------------------------------------------------


class Observer:
    """Turns snapshots into the observation of one hand with its sensors.

    The taxels, of the oldest to be remembered too, stand at the end.
    """

    def __init__(
        self,
        config: ObservationConfig,
        hand: Hand,
        taxel_names: tuple[str, ...],
        is_boolean: bool,
        control_dt: float,
    ) -> None:
        """`taxel_names` are those in the observation; `is_boolean` says whether they read 0 or 1."""
        terms = (*hand.observation, *(["asked"] if config.observe_targets else []))
        self.hand, self._terms = hand, terms
        self._sight = Sight(config)
        is_slide = np.isin(hand.joints, SLIDES)
        white = np.where(is_slide, config.slide_noise, config.joint_noise)
        held = np.where(is_slide, config.slide_noise_held, config.joint_noise_held)
        self._joints: JointErrors | None = None
        if white.any() or held.any():
            self._joints = JointErrors(white, held, control_dt)
        self._taxels = taxel_stages(config, len(taxel_names))
        self._history = [History(config.history), History(config.history)]
        names = term_names(terms, hand)
        taxels = [f"taxel {name}" for name in taxel_names]
        self.names = _remembered(names, config.history) + _remembered(taxels, config.history)
        n_taxels, size = config.history * len(taxels), len(self.names)
        self.low, self.high = np.full(size, -np.inf, np.float32), np.full(size, np.inf, np.float32)
        self.low[size - n_taxels :] = 0.0
        if is_boolean:
            self.high[size - n_taxels :] = 1.0
        whose = [term for term in terms for _ in TERMS[term].each(hand)]
        whose += [""] * (size - n_taxels - len(whose)) + ["taxels"] * len(taxels)
        self._whose = np.array(whose)

    def entries(self, *terms: str) -> Array:
        """Indices of the newest entries of these terms, as far as the hand has them, or "taxels"."""
        return np.flatnonzero(np.isin(self._whose, terms))

    def begin(self, rng: np.random.Generator) -> None:
        """A new episode, which the next snapshot starts."""
        sight, joints, taxels, history = rng.spawn(4)
        self._sight.begin(sight)
        if self._joints is not None:
            self._joints.begin(joints)
        for stage in self._taxels:
            stage.begin(taxels)
        for past in self._history:
            past.begin(history)

    def observe(self, truth: Snapshot, taxels: Array) -> Array:
        """(n,) float32 from what is true and what the taxels feel; once a control step."""
        sensed = replace(truth, object=self._sight(truth.object))
        if self._joints is not None:
            sensed = self._joints(sensed)
        terms = np.concatenate([TERMS[term].read(self.hand, sensed) for term in self._terms])
        for stage in self._taxels:
            taxels = stage(taxels)
        told = [past(part) for past, part in zip(self._history, (terms, taxels), strict=True)]
        return np.concatenate(told, dtype=np.float32, casting="same_kind")


def truth(hand: Hand, now: Snapshot, taxels: Array) -> Array:
    """(n,) float32: what a critic may see of an episode, whatever the policy is told."""
    parts = [TERMS[name].read(hand, now) for name in TRUE]
    return np.concatenate([*parts, taxels], dtype=np.float32, casting="same_kind")


def truth_names(hand: Hand, taxel_names: Sequence[str]) -> list[str]:
    """What the entries of `truth` are."""
    return [*term_names(TRUE, hand), *(f"taxel {name}" for name in taxel_names)]


STAGES: list[Callable[[SensorConfig, int], Stage | None]] = [
    lambda config, n: (
        FalseReadings(config.taxel_false_on, config.taxel_false_off)
        if config.taxel_false_on or config.taxel_false_off
        else None
    ),
    lambda config, n: (
        Broken(n, config.taxel_dead, config.taxel_stuck, config.hand_seed or 0)
        if config.taxel_dead or config.taxel_stuck
        else None
    ),
    lambda config, n: Delay(config.taxel_delay) if config.taxel_delay else None,
]
"""What happens to the readings (n,) of taxels, where it is asked for: they flip at random, a sensor
that is broken says the same whatever it feels, and all of it is late."""


def taxel_stages(config: SensorConfig, n: int) -> list[Stage]:
    """Those of STAGES that a configuration asks for."""
    return [stage for made in STAGES if (stage := made(config, n)) is not None]


def _remembered(names: list[str], history: int) -> list[str]:
    """Names of the entries of the last `history` observations, the newest first."""
    older = [f"{name} (t-{age})" for age in range(1, history) for name in names]
    return [*names, *older]
