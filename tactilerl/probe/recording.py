"""Handovers played while the hand waits: nothing before it closes depends on its taxels, so one
recording serves every layout. Each start is then played again for each moment at which the hand could
close."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import vector
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import Hand
from ..envs.layouts import Taxels, of_taxels
from ..envs.simulators import SimulationError
from ..envs.state import Array
from ..envs.touch import RULES
from ..pictures import places
from .cover import NEVER, Starts
from .gate import NO_FAULTS
from .reflexes import Reflex


@dataclass(frozen=True)
class Skin:
    """Every taxel that anything is asked of, each place once, and which of them are those of a set."""

    taxels: Taxels
    index: dict[places.Place, int]

    @classmethod
    def of(cls, sets: Iterable[Taxels], hand: Hand) -> Skin:
        every = places.union([of_taxels(taxels, hand, "all") for taxels in sets], hand)
        return cls(every, {place: number for number, place in enumerate(places.of(every))})

    def columns(self, taxels: Taxels) -> list[int]:
        return [self.index[place] for place in places.of(taxels)]


class SkinnedEnv(GraspEnv):
    """An environment that reads more taxels than one layout may have: of some that lie in the same
    place, and differ in size."""

    def __init__(self, hand: str, config: GraspConfig, taxels: Taxels) -> None:
        if config.touch_rule == "contact":
            raise ValueError("touch: found contact, allowed rules that any taxel can be read by later")
        super().__init__(hand, config)
        self.taxels, self._touch = taxels, RULES[config.touch_rule](taxels, self.hand)


@dataclass(frozen=True)
class Recording:
    """What was recorded of some starts; closing is asked for at no more moments than are needed."""

    fires: Array
    """(n, m) uint8: after how many actions each taxel fires first, or NEVER."""
    succeeds: Array
    """(n, NEVER + 1) bool: does a hand succeed that closes after so many actions?"""
    sets_off: Array
    """(n,) before which action the object begins to come."""
    lets_go: Array
    """(n,) before which action it is let go."""

    def starts(self, taxels: list[int], weights: Array) -> Starts:
        return Starts(self.fires[:, taxels], self.succeeds, weights)

    def felt(self, taxels: list[int]) -> Array:
        """(n,) bool: does one of these taxels fire before the object is let go?"""
        return self.fires[:, taxels].min(axis=1, initial=NEVER) < self.lets_go

    def early(self) -> Array:
        """(m,) bool: taxels that fire in any start before the object has set off."""
        return np.asarray((self.fires < self.sets_off[:, None]).any(axis=0))


def record(
    hand: str,
    scene: GraspConfig,
    skin: Skin,
    numbers: Iterable[int],
    workers: int,
    every_moment: bool = False,
    tick: Callable[[], None] = lambda: None,
) -> Recording:
    """The starts that the seeds `numbers` draw in a scene. `every_moment`: closing is asked for after
    every number of actions, not only where a taxel fires first. `tick` is called after every start."""
    blind: dict[str, Any] = {**NO_FAULTS, "touch": "absent", "history": 1}
    make = partial(SkinnedEnv, hand, replace(scene, **blind), skin.taxels)
    found = []
    with closing(vector.start(make, workers)) as played_in:
        for row in played_in.play(partial(_play, every_moment), numbers):
            found.append(row)
            tick()
    return Recording(*(np.array(column) for column in zip(*found, strict=True)))


def _play(
    every_moment: bool, env: gym.Env[Any, Any], number: int, is_wanted: vector.IsWanted
) -> tuple[Array, Array, int, int]:
    """A row of each array of a `Recording`. A start in which the physics breaks is felt by nobody."""
    base: Any = env.unwrapped
    fires = np.full(len(base.taxels), NEVER, np.uint8)
    succeeds = np.zeros(NEVER + 1, bool)
    try:
        env.reset(seed=number)
    except SimulationError:
        return fires, succeeds, 0, 0
    waiting, step, is_over = base.hand.start_targets(), 0, False
    while not is_over and is_wanted():
        fires[(fires == NEVER) & (base.taxel_readings() > 0)] = step
        *_, terminated, truncated, _ = base.step_to(waiting)
        step, is_over = step + 1, terminated or truncated
    sets_off = base.task.sets_off
    for moment in range(step) if every_moment else np.unique(fires[fires < NEVER]).tolist():
        if not is_wanted():
            break
        succeeds[moment] = Reflex("time", moment, 1.0).play(env, number)
    return fires, succeeds, sets_off, sets_off + base.task.stays
