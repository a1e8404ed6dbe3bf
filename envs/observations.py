"""Make the policy's observation: terms, sight, joint angles, taxels with their faults, history.

There is one small class for each, reset with every episode. Sight, joints and taxels
each have a generator of their own, so that what one draws moves nothing that another
draws; a taxel's reading passes one `Stage` after another. Goals and rewards never pass
here: they keep the state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np

from .hands import ARM, SLIDES, Hand
from .objects import KINDS, Shape, host, like, namespace
from .sensors import OF_FORCE
from .state import Array, State
from .validation import Fraction, Newtons, require_one_of

Metres = Annotated[float, "[0, 1]"]
Radians = Annotated[float, "[0, 3.142]"]
SIGHT_NOISE = (0.01, 0.1)  # m and rad, where noise is asked for without saying how much
OF_HAND = (
    "taxel_dead", "taxel_stuck", "taxel_threshold_spread", "taxel_gain_spread", "taxel_drift",
)  # fmt: skip
"""Faults in which hands differ, by their seed."""


@dataclass(frozen=True)
class TaxelFaults:
    """Errors of taxels: faults, and how real ones differ from each other; by default, none."""

    taxel_false_on: Fraction = 0.0
    """Probability per step that a taxel that is off reads on."""
    taxel_false_off: Fraction = 0.0
    """Probability per step that a taxel that is on reads off."""
    taxel_dead: Fraction = 0.0
    """Fraction of taxels that never fire; --hand-seed decides which."""
    taxel_stuck: Fraction = 0.0
    """Fraction of taxels that always fire; --hand-seed decides which."""
    taxel_threshold_spread: Fraction = 0.0
    """Standard deviation of the threshold between taxels, relative; drawn from
    --hand-seed."""
    taxel_saturates: Annotated[float, "(0, 1000]"] | None = None
    """Largest force that a taxel reads, N; default: no limit. Only with
    --touch-rule force."""
    taxel_noise: Newtons = 0.0
    """Standard deviation of the noise of a reading, N, drawn at every step. Only
    with --touch-rule force."""
    taxel_gain_spread: Fraction = 0.0
    """Standard deviation of the gain between taxels, around 1; drawn from --hand-seed.
    Only with --touch-rule force."""
    taxel_drift: Newtons = 0.0
    """Drift of a taxel's zero from the start of an episode, N/min; --hand-seed decides
    whether up or down. Only with --touch-rule force."""


@dataclass(frozen=True)
class SensorConfig(TaxelFaults):
    """Errors with which the hand senses its joints, the object and touch."""

    object_seen: Literal["exact", "noisy", "start", "hidden"] = "exact"
    """Object's pose as the policy sees it: exact (paper), noisy (--sight-noise), start
    (where it was at the start of the episode), or hidden (zeros, and the kind of the
    scene's first object).
    """
    sight_noise: tuple[Metres, Radians] | None = None
    """Standard deviations of the noise with --object-seen noisy: on each coordinate, m,
    and about each axis, rad; default: 0.01 0.1.
    """
    sight_noise_kind: Literal["white", "held"] = "white"
    """white: drawn at every step; held: drawn once per episode."""
    joint_noise: Radians = 0.0
    """Standard deviation of the noise on each observed joint angle, rad, drawn at every
    step. Velocities get the matching error."""
    joint_noise_held: Radians = 0.0
    """Standard deviation of a constant offset on each observed joint angle, rad, drawn
    once per episode."""
    slide_noise: Metres = 0.0
    """Like --joint-noise, for the slides that carry the hand, m."""
    slide_noise_held: Metres = 0.0
    """Like --joint-noise-held, for the slides, m."""
    sensor: str = ""
    """Sensor by name (`tactilerl env` lists them) or .toml file: its numbers are the defaults of the
    --taxel flags. Default: ideal taxels."""
    taxel_radius: Annotated[float, "[0.0001, 0.02]"] | None = None
    """Radius of the taxels, m; default: what the layout says."""
    taxel_delay: Annotated[int, "[0, 10000]"] = 0
    """Delay of the taxel readings, in control steps. If it is longer than the episode,
    the reading at its start is repeated throughout."""
    taxel_threshold: Newtons | None = None
    """Force from which a taxel fires, N; 0: any touch. Default: what the layout says,
    else 0."""
    taxel_release: Newtons | None = None
    """Force below which a taxel that fires stops, N; default: four fifths of its
    threshold."""
    hand_seed: Annotated[int, "[0, 4294967295]"] | None = None
    """Random seed of the hand: which taxels are broken, and how they differ from each
    other; default: the run's seed, or 0 without a run."""


TAXELS = [name for name in vars(SensorConfig()) if name.startswith("taxel_")]
"""Fields of taxels."""


@dataclass(frozen=True)
class ObservationConfig(SensorConfig):
    """Observation of the policy."""

    history: Annotated[int, "[1, 100]"] = 1
    """Number of latest observations that the policy sees, stacked."""
    observe_targets: bool = False
    """Include the current joint targets in the observation; with --actions fingers or
    grip, how far the fingers are to close. The paper leaves them out."""


def validate(config: ObservationConfig) -> None:
    """Raise ValueError for a taxel that stops firing before it may begin."""
    release, highest = config.taxel_release, config.taxel_threshold or 0.0
    if release is not None and release > highest:
        allowed = f"up to taxel_threshold, {highest:g} N"
        raise ValueError(f"taxel_release: found {release} N, allowed {allowed}")


# -- terms -----------------------------------------------------------------------------------


class Term(NamedTuple):
    """A few entries of the observation; a hand's ``observation`` says which terms it has."""

    what: str
    """Quantity that all the entries are."""
    entries: Callable[[Hand], Sequence[str]]
    """Names that tell the entries apart."""
    read: Callable[[Hand, State], Array]
    """Function that returns the entries (..., n) from the state as it is sensed."""


def _first_joints(hand: Hand, state: State) -> Array:
    first = [hand.joints.index(joint) for joint in hand.file.first_joints]
    return state.joint_positions[..., first]


def _upper_quaternion(hand: Hand, state: State) -> Array:
    """Return, of the two quaternions of the object's orientation, that with w from 0 up."""
    return (
        1.0 - 2.0 * (state.object_orientation[..., :1] < 0)
    ) * state.object_orientation


TERMS = {
    "object_id": Term(
        "object kind:",
        lambda _: [", ".join(KINDS)],
        lambda _, state: 0.0 * state.palm[..., :1] + KINDS.index(state.shape.kind),
    ),
    "hand_position": Term("hand", lambda _: "xyz", lambda _, state: state.palm),
    "finger_joints": Term(
        "position of", attrgetter("file.first_joints"), _first_joints
    ),
    "joint_positions": Term(
        "position of", attrgetter("joints"), lambda _, state: state.joint_positions
    ),
    "joint_velocities": Term(
        "velocity of", attrgetter("joints"), lambda _, state: state.joint_velocities
    ),
    "object_position": Term(
        "object", lambda _: "xyz", lambda _, state: state.object_position
    ),
    "object_orientation": Term(
        "object quaternion", lambda _: "wxyz", _upper_quaternion
    ),
    "targets": Term(
        "asked for:",
        attrgetter("action_names"),
        lambda hand, state: hand.action_map.commands(host(state.targets)),
    ),
}

# -- stages ----------------------------------------------------------------------------------

# What stages, joints and sight remember of an episode are attributes that `reset` sets,
# as all the episodes of a batch may have them: numbers, or arrays with the leading axes
# of what they are told. Random numbers are drawn with the keyword `size`, which leaves
# leading axes out (`batch.Draws`). A batch draws ahead what is asked for step after
# step: that generator then gives nothing else.


_NOTHING_YET: Any = np.nan


def _or_at_start(remembered: Any, value: Array) -> Any:
    """Return what is remembered (..., n), and `value` where that is NaN: nothing yet."""
    if isinstance(remembered, float):
        return value
    return namespace(value).where(remembered == remembered, remembered, value)


class Stage(ABC):
    """Change readings (..., n) on their way to the policy."""

    def reset(self, rng: Any) -> None:
        """Begin a new episode, whose draws come from `rng`."""
        self._rng = rng

    @abstractmethod
    def __call__(self, reading: Array) -> Array:
        """Return what comes out of a control step's reading; the first is the episode's start."""


class FalseReadings(Stage):
    """Bits that flip at random."""

    def __init__(self, false_on: float, false_off: float) -> None:
        """Take the probabilities per step that a 0 reads 1, and that a 1 reads 0."""
        self.false_on, self.false_off = false_on, false_off

    def __call__(self, reading: Array) -> Array:
        """Return the reading with some bits flipped."""
        where, is_on = namespace(reading).where, reading > 0
        chances = where(is_on, self.false_off, self.false_on)
        flips = self._rng.random(size=reading.shape[-1]) < chances
        flipped: Array = where(flips, 1.0 * ~is_on, reading)
        return flipped


class Broken(Stage):
    """Sensors that always read the same: some are dead and read 0, some are stuck and read 1.

    Which ones follows from `seed` alone, and those of a smaller share are among those
    of a larger.
    """

    def __init__(self, n: int, dead: float, stuck: float, seed: int) -> None:
        """Break shares of `n` sensors."""
        rank = np.random.default_rng(seed).permutation(n).argsort()
        n_dead = round(dead * n)
        self.dead, self.stuck = rank < n_dead, rank >= max(n_dead, n - round(stuck * n))

    def __call__(self, reading: Array) -> Array:
        """Return the reading with 0 and 1 where sensors are dead and stuck."""
        return reading * ~(self.dead | self.stuck) + 1.0 * self.stuck


class ForceErrors(Stage):
    """Errors of sensors that read a force: gain, drift of the zero, noise, and a largest reading.

    Gains and the sign of the drift are the hand's.
    """

    def __init__(self, config: Any, n: int) -> None:
        """Draw the hand with `n` sensors."""
        self._gains = spread(config, "gain", n)
        signs = np.sign(hand_draws(config, "drift", n))
        # N a control step
        self._drift = config.taxel_drift * config.control_dt / 60 * signs
        self._noise = config.taxel_noise
        self._highest = config.taxel_saturates or np.inf

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a new episode, at whose start the zero is right."""
        super().reset(rng)
        self._zero: Any = 0.0

    def __call__(self, reading: Array) -> Array:
        """Return what sensors say of forces, N, from 0 up."""
        noise = self._noise * self._rng.standard_normal(size=reading.shape[-1])
        felt = (self._gains * reading + self._zero + noise).clip(0.0)
        self._zero = self._zero + self._drift + 0.0 * reading  # as many as are told
        said: Array = namespace(felt).where(felt < self._highest, felt, self._highest)
        return said


def spread(config: SensorConfig, what: str, n: int) -> Array:
    """Return factors (n,) from 0 up, by which a hand's sensors differ in "threshold" or "gain"."""
    share: float = getattr(config, f"taxel_{what}_spread")
    return (1.0 + share * hand_draws(config, what, n)).clip(0.0)


def hand_draws(config: SensorConfig, what: str, n: int) -> Array:
    """Return normal numbers (n,) that are a hand's for good."""
    seed = config.hand_seed or 0, ("threshold", "gain", "drift").index(what)
    return np.random.default_rng(seed).standard_normal(n)


class Past(Stage):
    """Give the readings of the last `n` control steps, the newest first.

    Before an episode, all was as at its start.
    """

    def __init__(self, n: int) -> None:
        """Remember `n` readings."""
        self._n, self._readings = n, _NOTHING_YET

    def reset(self, rng: Any) -> None:
        """Forget the last episode."""
        self._readings = _NOTHING_YET

    def __call__(self, reading: Array) -> Array:
        """Return the readings, n times as many entries."""
        if self._n == 1:
            return reading
        latest = self._remember(reading)
        return latest.reshape(*latest.shape[:-2], -1)

    def _remember(self, reading: Array) -> Any:
        """Return the readings (..., n, m) with a new one."""
        xp, now = namespace(reading), reading[..., None, :]
        before = [now] * (self._n - 1)
        if not isinstance(self._readings, float):
            before = [_or_at_start(self._readings[..., :-1, :], now)]
        self._readings = xp.concatenate([now, *before], axis=-2)
        return self._readings


class Delay(Past):
    """Give what was read `steps` control steps ago."""

    def __init__(self, steps: int) -> None:
        """Remember the reading of now, and of `steps` steps."""
        super().__init__(steps + 1)

    def __call__(self, reading: Array) -> Array:
        """Return the oldest reading that is remembered."""
        return self._remember(reading)[..., -1, :]


class JointErrors:
    """Errors of joint sensors: at every step, and for an episode.

    Velocities are taken for differences of angles, so that what is held does not show
    in them.
    """

    def __init__(self, white: Array, held: Array, control_dt: float) -> None:
        """Take the standard deviations (n_joints,) of both, rad or m."""
        self.white, self.held, self.control_dt = white, held, control_dt

    def reset(self, rng: Any) -> None:
        """Begin a new episode, and draw its constant offsets."""
        (held,) = rng.spawn(1)  # draws nothing from `rng`
        self._rng, self._noise = rng, _NOTHING_YET
        self._error = self.held * held.standard_normal(size=len(self.held))

    def __call__(self, state: State) -> State:
        """Return the state with joints and hand as they are sensed; once a control step."""
        noise = self.white * self._rng.standard_normal(size=len(self.white))
        before, self._noise = _or_at_start(self._noise, noise), noise
        error = self._error + noise
        return replace(
            state,
            joint_positions=state.joint_positions + error,
            joint_velocities=state.joint_velocities
            + (noise - before) / self.control_dt,
            # The slides, along the world's axes, carry the palm.
            palm=state.palm + error[..., ARM],
        )


# -- sight -----------------------------------------------------------------------------------


class Sight:
    """See the object, with the errors of a configuration.

    It is seen as it is, off by a random offset and a turn about a random axis (at every
    step or for an episode), as it was when the episode began, or not at all: it is then
    said to have the shape of the scene's first object.
    """

    def __init__(self, config: SensorConfig, first: Shape) -> None:
        """Take the configuration and the shape of the scene's first object."""
        self._mode = config.object_seen
        self._is_held = config.sight_noise_kind == "held"
        self._scale = np.repeat(config.sight_noise or SIGHT_NOISE, 3)
        self._first = first

    def reset(self, rng: Any) -> None:
        """Begin a new episode, and draw its error."""
        self._rng = rng
        self._start = _NOTHING_YET
        self._error = self._draw()

    def _draw(self) -> Array:
        return self._scale * self._rng.standard_normal(size=6)

    def __call__(self, state: State) -> State:
        """Return the state as it is seen; of the object's pose only position and quaternion count."""
        if self._mode == "exact":
            return state
        position, orientation = state.object_position, state.object_orientation
        xp = namespace(position)
        if self._mode == "hidden":
            state = replace(state, shape=self._first)
            position, orientation = xp.zeros_like(position), xp.zeros_like(orientation)
        elif self._mode == "noisy":
            error = self._error if self._is_held else self._draw()
            position = position + error[..., :3]
            orientation = _turned(error[..., 3:], orientation)
        else:
            pose = xp.concatenate([position, orientation], axis=-1)
            self._start = _or_at_start(self._start, pose)
            position, orientation = self._start[..., :3], self._start[..., 3:]
        return replace(state, object_position=position, object_orientation=orientation)


def _turned(vector: Array, quaternion: Array) -> Array:
    """Return orientations (..., 4), wxyz, turned by rotation vectors (..., 3)."""
    xp = namespace(vector)
    half = xp.linalg.norm(vector, axis=-1)[..., None] / 2
    v, w = vector * xp.sinc(half / np.pi) / 2, xp.cos(half)
    real, u = quaternion[..., :1], quaternion[..., 1:]
    turned = w * u + real * v + xp.cross(v, u, axis=-1)
    both: Array = xp.concatenate(
        [w * real - (v * u).sum(-1)[..., None], turned], axis=-1
    )
    return both


# -- all of it -------------------------------------------------------------------------------


class Observer:
    """Turn states into the observation of one hand with its sensors.

    The taxels, of the oldest to be remembered too, stand at the end.
    """

    def __init__(
        self,
        config: Any,
        hand: Hand,
        terms: Mapping[str, Term],
        taxel_names: tuple[str, ...],
        rule: Any,
        first: Shape,
    ) -> None:
        """Prepare the observation of a hand by a `grasp.GraspConfig`.

        `terms` are the task's own, `taxel_names` those of the hand, `rule` their
        `touch.Rule`, `first` is the shape of the scene's first object.
        """
        where = f"hand {hand.name}: observation"
        for term in hand.file.observation:
            require_one_of(TERMS, term, where)
        if not hand.file.observation:
            raise ValueError(f"{where}: found none, allowed: {', '.join(TERMS)}")
        self.hand = hand
        named = [*hand.file.observation, *["targets"] * config.observe_targets]
        self._terms = {name: TERMS[name] for name in named} | dict(terms)
        is_slide = np.isin(hand.joints, SLIDES)
        white = np.where(is_slide, config.slide_noise, config.joint_noise)
        held = np.where(is_slide, config.slide_noise_held, config.joint_noise_held)
        self._senses: list[Any] = [Sight(config, first)]
        if white.any() or held.any():
            self._senses.append(JointErrors(white, held, config.control_dt))
        self._past = Past(config.history)
        taxel_names = () if config.touch == "absent" else taxel_names
        self._n_taxels = n = len(taxel_names)
        self._rule = rule if config.touch == "on" else None
        stages = [make(config, n) for make in STAGES]
        self._stages = [*filter(None, stages), Past(config.history)]
        entries = [  # term and name of each
            (name, f"{term.what} {entry}")
            for name, term in self._terms.items()
            for entry in term.entries(hand)
        ]
        taxels = [("taxels", f"taxel {name}") for name in taxel_names]
        self.names: list[str] = []
        """Says of each entry what it is."""
        self._term_of_entry: list[str] = []
        for part in (entries, taxels):
            for age in range(config.history):
                for term, name in part:
                    self.names.append(f"{name} (t-{age})" if age else name)
                    self._term_of_entry.append("" if age else term)
        high = np.full(len(self.names), np.inf, np.float32)
        low, readings = -high, slice(len(high) - config.history * n, None)
        low[readings] = 0.0
        if rule.is_boolean:
            high[readings] = 1.0
        self.space = gym.spaces.Box(low, high)

    @property
    def parts(self) -> list[Any]:
        """Senses, stages and the touch rule that remember something of an episode."""
        parts = *self._senses, self._past, self._rule, *self._stages
        return [part for part in parts if part]

    def entries(self, *terms: str) -> Array:
        """Return indices of the newest entries of these terms, if the hand has them, or "taxels"."""
        return np.flatnonzero(np.isin(self._term_of_entry, terms))

    def reset(self, rng: Any) -> None:
        """Begin a new episode, which the next state starts."""
        sight, joints, taxels = rng.spawn(3)
        for sense, own in zip(self._senses, (sight, joints), strict=False):
            sense.reset(own)
        self._past.reset(joints)
        if self._rule:
            self._rule.reset()
        for stage in self._stages:
            stage.reset(taxels)

    def observe(self, state: State) -> Array:
        """Return the observation (..., n) of a state; once a control step."""
        xp, seen = namespace(state.palm), state
        for sense in self._senses:
            seen = sense(seen)
        terms = [
            like(term.read(self.hand, seen), state.palm)
            for term in self._terms.values()
        ]
        sensed = self._past(xp.concatenate(terms, axis=-1))
        if self._rule:
            told = self._rule.read(state)
        else:
            told = like(np.zeros((*state.palm.shape[:-1], self._n_taxels)), state.palm)
        for stage in self._stages:
            told = stage(told)
        obs: Array = xp.concatenate([sensed, told], axis=-1)
        return obs


STAGES: list[Callable[[Any, int], Stage | None]] = [
    lambda config, n: (
        ForceErrors(config, n)
        if any(getattr(config, name) for name in OF_FORCE)
        else None
    ),
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
"""Makers of the stages that the readings (n,) of taxels pass, one after another, each
None where it would change nothing: forces have errors, bits flip at random, a broken
sensor says the same whatever it feels, and all of it is late. They take the scene's
configuration (`grasp.GraspConfig`) and n.
"""
