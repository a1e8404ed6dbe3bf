"""Find a scripted grasp for a hand that has none, by a small search over palm place and closing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from operator import attrgetter
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
MAX_OFFSET = 0.025  # m that the palm may be beside its place at the start
GROUNDS = 0.004, -0.03, -0.03
"""Height of the lowest fingertip over the ground in each search, m: as the hand closes,
tips rise."""
UP = 0.05  # m above its place at the start
CLOSINGS = (0.3, 1.2)
BONUS = 0.1  # of all digits touching, and as much is lost where the object is `UP` off the middle
NARROWEST = 2e-3, 2e-3, 2e-3, 0.03  # m and share: what the draws differ by at least


class FoundGrasp(NamedTuple):
    """A grasp, and how good it was."""

    grasp: ScriptedGrasp
    closing: float
    """Share of the way to the closed hand that the fingers close; 1 is the closed
    hand."""
    share: float
    """Share of the steps of its holds in which the object was up."""

    def toml(self) -> str:
        """Return the grasp as text for the hand's file."""
        slides = ", ".join(f"{self.grasp.targets[name]:.4g}" for name in SLIDES)
        return (
            f"[[grasp]]\nobject_size = {self.grasp.object_size:g}\n"
            f"slides = [{slides}]\nclosing = {self.closing:.4g}"
        )


class Candidate(NamedTuple):
    """A grasp that was tried."""

    goodness: float
    share: float
    """Share of the steps in which the object was up, like its goodness the mean over
    the starts."""
    figures: Array
    """Palm's offset (x, y, z) from its place at the start, m, and the share that the
    fingers close."""


def find(
    hand: str,
    config: GraspConfig,
    workers: int,
    tick: Callable[[], None] = lambda: None,
) -> FoundGrasp:
    """Find the best grasp of the scene's object.

    Of grasps that hold it as long, the best is the one that most digits touch and that
    has it best in the middle. This is a cross-entropy search over the palm's place and
    how far the hand closes, again, and lower, where its best is not good. `tick` is
    called after every candidate. Raise ValueError when the hand's file does not say
    what its closed hand is.
    """
    make = partial(GraspEnv, hand, config)
    with closing(vector.start(make, workers)) as played_in:
        env: Any = played_in.env.unwrapped
        tip = float(env.state.fingertips[:, 2].min())
        if not env.hand.closed:
            raise ValueError(
                f"hand {hand}: has no [closed], the joint angles of the closed hand"
            )
        grasp_of = partial(_grasp, env.hand, env.shape.width)

        def test(figures: Array, starts: range) -> Candidate:
            tick()
            held = played_in.play(partial(_hold, grasp_of(figures)), starts)
            goodness, share = np.mean(list(held), axis=0).tolist()
            return Candidate(goodness, share, figures)

        searches = []
        for attempt, ground in enumerate(GROUNDS):
            lowest = np.array(
                [-MAX_OFFSET, -MAX_OFFSET, min(ground - tip, 0.0), CLOSINGS[0]]
            )
            rng = np.random.default_rng(SEED + attempt)
            searches.append(_search(test, lowest, rng))
            if searches[-1].share >= GOOD:
                break
    best = max(reversed(searches), key=attrgetter("goodness"))
    figures = np.round(best.figures, 4)
    return FoundGrasp(grasp_of(figures), float(figures[-1]), best.share)


def _search(
    test: Callable[[Array, range], Candidate], lowest: Array, rng: np.random.Generator
) -> Candidate:
    """Return the best candidate whose figures are `lowest` (4,) or more."""
    highest = np.array([MAX_OFFSET, MAX_OFFSET, UP, CLOSINGS[1]])
    tried: list[Candidate] = []
    for n in ROUNDS:
        if not tried:
            draws = rng.uniform(lowest, highest, (n, len(lowest)))
        else:
            best = np.array([candidate.figures for candidate in tried[:BEST]])
            spread = np.maximum(best.std(axis=0), NARROWEST)
            draws = rng.normal(best.mean(axis=0), spread, (n, len(lowest)))
            draws = np.clip(draws, lowest, highest)
        tried += [test(figures, range(STARTS)) for figures in draws]
        tried.sort(key=attrgetter("goodness"), reverse=True)
    others = range(STARTS, STARTS + OTHERS)  # where those that were lucky are not
    again = [test(candidate.figures, others) for candidate in tried[:BEST]]
    return max(again, key=attrgetter("goodness"))


def _grasp(hand: Hand, size: float, figures: Array) -> ScriptedGrasp:
    """Return the grasp of an object of `size` m that the figures of a candidate describe."""
    *place, share = figures.tolist()
    targets = dict(zip(SLIDES, place, strict=True))
    for name, opened in hand.opened.items():
        targets[name] = opened + share * (hand.closed[name] - opened)
    return ScriptedGrasp(size, targets)


def _hold(
    grasp: ScriptedGrasp,
    env: gym.Env[Any, Any],
    number: int,
    is_wanted: vector.IsWanted,
) -> tuple[float, float]:
    """Hold the object from the start of a number.

    Return how good that is, and the share of the steps in which the object was up.
    """
    base: Any = env.unwrapped
    start = scripted.perturbed_start(base, SEED, number)
    ups, last = [], None
    try:
        for is_up in scripted.hold_steps(base, grasp, start, SECONDS):
            ups.append(is_up)
            last = base.simulator.state() if is_up else last
    except SimulationError:
        last = None
    if last is None:
        return 0.0, 0.0
    share = float(np.mean(ups))
    links = {last.links[index] for index in last.contacts.links}
    touching = {
        surface.digit
        for surface in base.hand.surfaces
        if surface.link in links and surface.segment != "palm"
    }
    middle = _middle(base.hand, last.fingertips)
    off_middle = float(np.linalg.norm(last.object_position - middle))
    gained = BONUS * len(touching) / len(base.hand.digits)
    return share * (1 + gained - BONUS * min(1, off_middle / UP)), share


def _middle(hand: Hand, tips: Array) -> Array:
    """Return the place between the thumb, where there is one, and the fingers (3,), m."""
    is_thumb = np.array([digit == "thumb" for digit in hand.digits])
    parts = [tips[which] for which in (is_thumb, ~is_thumb) if which.any()]
    return np.mean([part.mean(axis=0) for part in parts], axis=0)
