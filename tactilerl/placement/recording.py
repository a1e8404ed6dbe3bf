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
from ..envs.touch import RULES
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
    place, and differ in size."""

    def __init__(self, hand: str, config: GraspConfig, taxels: Taxels) -> None:
        if config.touch_rule == "contact":
            allowed = "rules that any taxel can be read by later"
            raise ValueError(f"touch: found contact, allowed {allowed}")
        super().__init__(hand, config)
        self.taxels, self._touch = taxels, RULES[config.touch_rule](taxels, self.hand)


def record(
    hand: str,
    scene: GraspConfig,
    skin: Skin,
    numbers: Sequence[int],
    workers: int,
    tick: Callable[[], None] = lambda: None,
    weight: float = 1.0,
) -> Starts:
    """Play the starts that the seeds `numbers` draw in a scene, which together weigh `weight`. `tick`
    is called after every start."""
    blind: dict[str, Any] = {**NO_FAULTS, "touch": "absent", "history": 1}
    make = partial(SkinnedEnv, hand, replace(scene, **blind), skin.taxels)
    rows = []
    with closing(vector.start(make, workers)) as played_in:
        for row in played_in.play(_play, numbers):
            rows.append(row)
            tick()
    fires, succeeds, sets_off, lets_go = map(np.array, zip(*rows, strict=True))
    weights = np.full(len(rows), weight / len(rows))
    return Starts(fires, succeeds, sets_off, lets_go, weights)


def _play(
    env: gym.Env[Any, Any], number: int, is_wanted: vector.IsWanted
) -> tuple[Array, Array, int, int]:
    """Return a row of each array of `Starts`. A start in which the physics breaks is felt by nobody."""
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
    for moment in np.unique(fires[fires < NEVER]).tolist():
        if not is_wanted():
            break
        succeeds[moment] = Reflex("time", moment, 1.0).play(env, number)
    return fires, succeeds, sets_off, sets_off + base.task.stays
