"""A scripted grasp for a hand that has none: a small search over the palm's place and the closing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import scripted, vector
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import SLIDES, Hand, ScriptedGrasp
from ..envs.simulators import SimulationError
from ..envs.state import Array

SEED = 30_000  # apart from the doctor's starts and from those of training
SECONDS = 1.0  # of a hold
STARTS = 4  # from which each candidate is tried
ROUNDS = (48, 16, 16, 16)  # candidates; the first are spread over all that is allowed
BEST = 6  # candidates from which the next are drawn around
BESIDE = 0.025  # m that the palm may be beside its place at the start
GROUND, UP = 0.004, 0.05  # m: of the lowest fingertip over the ground, and above its place at the start
CLOSINGS = (0.3, 1.2)
NARROWEST = np.array([2e-3, 2e-3, 2e-3, 0.03])  # m and share: what the draws differ by at least


def find(
    hand: str, config: GraspConfig, workers: int, tick: Callable[[], None] = lambda: None
) -> tuple[ScriptedGrasp, float]:
    """The best grasp of the scene's object, and the share of its holds' steps in which that was up.

    Cross-entropy search over the palm's place and how far the hand closes. `tick` is called after
    every candidate. ValueError when the hand's file does not say what its closed hand is.
    """
    make = partial(GraspEnv, hand, config)
    with closing(make()) as example:
        if not example.hand.closed:
            raise ValueError(f"hand {hand}: has no [closed], the joint angles of the closed hand")
        own, size = example.hand, example.shape.width
        down = float(example.simulator.state().fingertips[:, 2].min()) - GROUND
    lowest = np.array([-BESIDE, -BESIDE, -max(down, 0.0), CLOSINGS[0]])
    highest = np.array([BESIDE, BESIDE, UP, CLOSINGS[1]])
    rng = np.random.default_rng(SEED)
    tried: list[tuple[float, Array]] = []
    with closing(vector.start(make, workers)) as played_in:
        for n in ROUNDS:
            if not tried:
                candidates = rng.uniform(lowest, highest, (n, len(lowest)))
            else:
                best = np.array([figures for _, figures in tried[:BEST]])
                spread = np.maximum(best.std(axis=0), NARROWEST)
                drawn = rng.normal(best.mean(axis=0), spread, (n, len(lowest)))
                candidates = np.clip(drawn, lowest, highest)
            for figures in candidates:
                task = partial(_hold, _grasp(own, size, figures))
                tried.append((float(np.mean(list(played_in.play(task, range(STARTS))))), figures))
                tick()
            tried.sort(key=lambda each: -each[0])
    score, figures = tried[0]
    return _grasp(own, size, np.round(figures, 4)), score


def _grasp(hand: Hand, size: float, figures: Array) -> ScriptedGrasp:
    """The palm (x, y, z) m beside its place at the start, fingers closed by the last of the figures."""
    *place, share = figures.tolist()
    targets = dict(zip(SLIDES, place, strict=True))
    closed = {n: o + share * (hand.closed[n] - o) for n, o in hand.opened.items()}
    return ScriptedGrasp(size, {**targets, **closed})


def _hold(
    grasp: ScriptedGrasp, env: gym.Env[Any, Any], number: int, is_wanted: vector.IsWanted
) -> float:
    """The share of a hold's steps in which the object was up."""
    base: Any = env.unwrapped
    rng = np.random.default_rng([SEED, number])
    start = scripted.perturbed_start(rng, len(base.hand.joints))
    try:
        return float(np.mean(list(scripted.hold_steps(base, grasp, start, SECONDS))))
    except SimulationError:
        return 0.0


def toml(hand: Hand, grasp: ScriptedGrasp) -> str:
    """The grasp as text to paste into the hand's file."""
    moving = next(name for name, angle in hand.closed.items() if angle != hand.opened[name])
    opened, closed = hand.opened[moving], hand.closed[moving]
    share = (grasp.targets[moving] - opened) / (closed - opened)
    slides = ", ".join(f"{grasp.targets[name]:.4g}" for name in SLIDES)
    figures = f"slides = [{slides}]\nclosing = {share:.4g}"
    return f"[[grasp]]\nobject_size = {grasp.object_size:g}\n{figures}"
