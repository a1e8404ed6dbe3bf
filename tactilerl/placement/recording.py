"""Handovers played while the hand waits: nothing before it closes depends on its taxels, so one
recording serves every layout. Each start is then played again for each moment at which the hand could
close."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import vector
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.layouts import Taxels
from ..envs.simulators import SimulationError
from ..envs.state import Array
from ..envs.touch import RULES, ForceRule
from ..pictures import places
from ..scripted.gate import NO_FAULTS
from ..scripted.reflexes import Reflex
from .cover import NEVER, Starts


@dataclass(frozen=True)
class Skin:
    """Every taxel that anything is asked of, each place once, and which of them are those of a set."""

    taxels: Taxels
    index: dict[places.Place, int]

    @classmethod
    def of(cls, sets: Iterable[Taxels]) -> Skin:
        """Join sets of taxels, in the order of places."""
        rows: dict[places.Place, Any] = {}
        for taxels in sets:
            parts = taxels.points, taxels.surfaces, taxels.offsets
            for place, *row in zip(places.of(taxels), *parts, strict=True):
                rows.setdefault(place, row)
        index = {place: number for number, place in enumerate(sorted(rows))}
        points, surfaces, offsets = zip(*(rows[place] for place in index), strict=True)
        return cls(Taxels(points, np.array(surfaces), np.array(offsets)), index)

    def columns(self, taxels: Taxels) -> list[int]:
        """Return the index in the skin of each taxel."""
        return [self.index[place] for place in places.of(taxels)]


class SkinnedEnv(GraspEnv):
    """An environment that reads more taxels than one layout may have: of some that lie in the same
    place, and differ in size; and each with several thresholds."""

    def __init__(
        self, hand: str, config: GraspConfig, taxels: Taxels, thresholds: Array
    ) -> None:
        """Take the thresholds (t, n) in N at which each taxel fires."""
        allowed = {"skin"} if thresholds.any() else set(RULES) - {"contact"}
        if config.touch_rule not in allowed:
            found = f"found {config.touch_rule}, allowed {' or '.join(sorted(allowed))}"
            raise ValueError(f"touch_rule: {found}")
        super().__init__(hand, config)
        self.taxels, self._thresholds = taxels, thresholds
        rule = ForceRule if thresholds.any() else RULES[config.touch_rule]
        self._touch = rule(taxels, self.hand)

    def firing(self) -> Array:
        """Tell which taxels fire with each threshold, bool (t, n)."""
        if not isinstance(self._touch, ForceRule) or not self._thresholds.any():
            return self.taxel_readings()[None] > 0
        is_on, forces = self._touch.feel(self.simulator.state())
        return np.asarray(is_on & (forces >= self._thresholds))


def record(
    hand: str,
    scene: GraspConfig,
    skin: Skin,
    numbers: Sequence[int],
    workers: int,
    tick: Callable[[], None] = lambda: None,
    thresholds: Sequence[float | None] = (None,),
) -> list[Starts]:
    """Play the starts that the seeds `numbers` draw in a scene, and return them for each threshold in N
    (None: the scene's, or each taxel's own).

    `tick` is called after every start.
    """
    blind: dict[str, Any] = {**NO_FAULTS, "touch": "absent", "history": 1}
    usual = scene.taxel_threshold
    forces = [usual if threshold is None else threshold for threshold in thresholds]
    own = skin.taxels.thresholds
    needed = np.array([own if f is None else np.full(len(own), f) for f in forces])
    make = partial(SkinnedEnv, hand, replace(scene, **blind), skin.taxels, needed)
    play = partial(_play, delay=scene.taxel_delay, n_thresholds=len(needed))
    rows = []
    with closing(vector.start(make, workers)) as played_in:
        for row in played_in.play(play, numbers):
            rows.append(row)
            tick()
    fires, succeeds, sets_off, lets_go = map(np.array, zip(*rows, strict=True))
    return [
        Starts(fires[:, i], succeeds, sets_off, lets_go) for i in range(len(needed))
    ]


def _play(
    env: gym.Env[Any, Any],
    number: int,
    is_wanted: vector.IsWanted,
    delay: int,
    n_thresholds: int,
) -> tuple[Array, Array, int, int]:
    """Return a row of each array of `Starts`, of taxels whose readings come `delay` actions late, with
    a row of first firings for each threshold. A start in which the physics breaks is felt by nobody."""
    base: Any = env.unwrapped
    fires = np.full((n_thresholds, len(base.taxels)), NEVER, np.uint8)
    succeeds = np.zeros(NEVER + 1, bool)
    try:
        env.reset(seed=number)
    except SimulationError:
        return fires, succeeds, 0, 0
    waiting, step, is_over = base.hand.start_targets(), 0, False
    while not is_over and is_wanted():
        # The first reading is there from the beginning, however late the others are.
        moment = min(step + delay, NEVER) if step else 0
        fires[(fires == NEVER) & base.firing()] = moment
        *_, terminated, truncated, _ = base.step_to(waiting)
        step, is_over = step + 1, terminated or truncated
    sets_off = base.task.sets_off
    for moment in np.unique(fires[fires < NEVER]).tolist():
        if not is_wanted():
            break
        succeeds[moment] = Reflex("time", moment, 1.0).play(env, number)
    return fires, succeeds, sets_off + delay, sets_off + base.task.stays
