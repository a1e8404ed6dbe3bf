"""A scripted grasp for a hand that has none: a small search over the palm's place and the closing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ..envs import scripted, vector
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import SLIDES, Hand, ScriptedGrasp
from ..envs.simulators import SimulationError
from ..envs.state import Array

SEED = 30_000  # apart from the starts of the check of taxels and from those of training
SECONDS = 1.0  # of a hold
STARTS, OTHERS = 4, 8  # from which each candidate is tried, and the best once more
ROUNDS = 48, 16, 16, 16  # candidates; the first are spread over all that is allowed
GOOD = (
    0.9  # share of the time that an object is held, below which there is another search
)
BEST = 6  # candidates from which the next are drawn around
BESIDE = 0.025  # m that the palm may be beside its place at the start
GROUNDS = 0.004, -0.03, -0.03
"""Height of the lowest fingertip over the ground in each search, m: as the hand closes, tips rise."""
UP = 0.05  # m above its place at the start
CLOSINGS = (0.3, 1.2)
TOUCHING = CENTRED = (
    0.1  # what all digits touching, and the object in the middle, count
)
NARROWEST = 2e-3, 2e-3, 2e-3, 0.03  # m and share: what the draws differ by at least


class Found(NamedTuple):
    """A grasp, and how good it was."""

    grasp: ScriptedGrasp
    closing: float
    """Share of the way to the closed hand that the fingers close; 1 is the closed hand."""
    share: float
    """Share of the steps of its holds in which the object was up."""
    digits: float
    """Digits that touched the object, on average."""

    def toml(self) -> str:
        """Return the grasp as text for the hand's file."""
        slides = ", ".join(f"{self.grasp.targets[name]:.4g}" for name in SLIDES)
        return (
            f"[[grasp]]\nobject_size = {self.grasp.object_size:g}\n"
            f"slides = [{slides}]\nclosing = {self.closing:.4g}"
        )


def find(
    hand: str,
    config: GraspConfig,
    workers: int,
    tick: Callable[[], None] = lambda: None,
) -> Found:
    """Find the best grasp of the scene's object.

    Of grasps that hold it as long, the best is the one that most digits touch and that has it best in
    the middle. This is a cross-entropy search over the palm's place and how far the hand closes, again,
    and lower, where what it finds is not good. `tick` is called after every candidate. ValueError when
    the hand's file does not say what its closed hand is.
    """
    make = partial(GraspEnv, hand, config)
    with closing(make()) as example:
        built, size = example.hand, example.shape.width
        tip = float(example.simulator.state().fingertips[:, 2].min())
    if not built.closed:
        missing = "has no [closed], the joint angles of the closed hand"
        raise ValueError(f"hand {hand}: {missing}")
    highest = np.array([BESIDE, BESIDE, UP, CLOSINGS[1]])
    best = np.zeros(4), highest
    with closing(vector.start(make, workers)) as played_in:

        def tested(figures: Array, starts: range) -> Array:
            """Return how good a candidate is on the mean, as `_hold` says."""
            tick()
            held = played_in.play(partial(_hold, _grasp(built, size, figures)), starts)
            return np.asarray(np.mean(list(held), axis=0))

        for attempt, ground in enumerate(GROUNDS):
            lowest = np.array([-BESIDE, -BESIDE, min(ground - tip, 0.0), CLOSINGS[0]])
            rng = np.random.default_rng(SEED + attempt)
            last = _search(tested, lowest, highest, rng)
            best = max(last, best, key=_goodness)
            if last[0][1] >= GOOD:
                break
    (_, share, digits), figures = best
    figures = np.round(figures, 4)
    return Found(
        grasp=_grasp(built, size, figures),
        closing=float(figures[-1]),
        share=float(share),
        digits=float(digits),
    )


Candidate = tuple[Array, Array]
"""Result of a candidate, (3,) as `_hold` says, and its figures (4,)."""


def _goodness(candidate: Candidate) -> float:
    return float(candidate[0][0])


def _search(
    tested: Callable[[Array, range], Array],
    lowest: Array,
    highest: Array,
    rng: np.random.Generator,
) -> Candidate:
    """Return the best candidate."""
    tried: list[Candidate] = []
    for n in ROUNDS:
        if not tried:
            candidates = rng.uniform(lowest, highest, (n, len(lowest)))
        else:
            best = np.array([figures for _, figures in tried[:BEST]])
            spread = np.maximum(best.std(axis=0), NARROWEST)
            drawn = rng.normal(best.mean(axis=0), spread, (n, len(lowest)))
            candidates = np.clip(drawn, lowest, highest)
        tried += [(tested(figures, range(STARTS)), figures) for figures in candidates]
        tried.sort(key=_goodness, reverse=True)
    others = range(STARTS, STARTS + OTHERS)  # where those that were lucky are not
    last = [(tested(figures, others), figures) for _, figures in tried[:BEST]]
    return max(last, key=_goodness)


def _grasp(hand: Hand, size: float, figures: Array) -> ScriptedGrasp:
    """Return the grasp that four figures describe.

    They are the palm's offset (x, y, z) from its place at the start, m, and the share of the way to
    the closed hand that the fingers close.
    """
    *place, share = figures.tolist()
    targets = dict(zip(SLIDES, place, strict=True))
    closed = {n: o + share * (hand.closed[n] - o) for n, o in hand.opened.items()}
    return ScriptedGrasp(size, {**targets, **closed})


def _hold(
    grasp: ScriptedGrasp,
    env: gym.Env[Any, Any],
    number: int,
    is_wanted: vector.IsWanted,
) -> Array:
    """Hold the object from the start of a number, and return how that went, (3,).

    The entries are how good it is, the share of the steps in which the object was up, and the number
    of digits that touched it.
    """
    base: Any = env.unwrapped
    rng = np.random.default_rng([SEED, number])
    start = scripted.perturbed_start(rng, len(base.hand.joints))
    ups, last = [], None
    try:
        for is_up in scripted.hold_steps(base, grasp, start, SECONDS):
            ups.append(is_up)
            last = base.simulator.state() if is_up else last
    except SimulationError:
        ups, last = [False], None
    share = float(np.mean(ups))
    if last is None:
        return np.array([share, share, 0.0])
    links = {last.links[index] for index in last.contacts.links}
    touching = {
        surface.digit
        for surface in base.hand.surfaces
        if surface.link in links and surface.segment != "palm"
    }
    middle = _middle(base.hand, last.fingertips)
    beside = float(np.linalg.norm(last.object_position - middle))
    gained = TOUCHING * len(touching) / len(base.hand.digits)
    good = share * (1 + gained - CENTRED * min(1, beside / UP))
    return np.array([good, share, len(touching)])


def _middle(hand: Hand, tips: Array) -> Array:
    """Return the place between the thumb, where there is one, and the fingers (3,), m."""
    names = list(hand.digits)
    if "thumb" not in names:
        return np.asarray(tips.mean(axis=0))
    thumb = names.index("thumb")
    return np.asarray((tips[thumb] + np.delete(tips, thumb, axis=0).mean(axis=0)) / 2)
