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
from .cover import NEVER, Starts
from .gate import NO_FAULTS
from .reflexes import Reflex


@dataclass(frozen=True)
class Skin:
    """Every taxel that anything is asked of, each place once, and which of them are those of a set."""

    taxels: Taxels
    index: dict[places.Place, int]

    @classmethod
    def of(cls, sets: Iterable[Taxels]) -> Skin:
        """In the order of places."""
        rows: dict[places.Place, Any] = {}
        for some in sets:
            for place, *row in zip(
                places.of(some), some.points, some.surfaces, some.offsets, strict=True
            ):
                rows.setdefault(place, row)
        index = {place: number for number, place in enumerate(sorted(rows))}
        points, surfaces, offsets = zip(*(rows[place] for place in index), strict=True)
        return cls(Taxels(points, np.array(surfaces), np.array(offsets)), index)

    def columns(self, taxels: Taxels) -> list[int]:
        return [self.index[place] for place in places.of(taxels)]


class SkinnedEnv(GraspEnv):
    """An environment that reads more taxels than one layout may have: of some that lie in the same
    place, and differ in size."""

    def __init__(self, hand: str, config: GraspConfig, taxels: Taxels) -> None:
        if config.touch_rule == "contact":
            raise ValueError(
                "touch: found contact, allowed rules that any taxel can be read by later"
            )
        super().__init__(hand, config)
        self.taxels, self._touch = taxels, RULES[config.touch_rule](taxels, self.hand)


def record(
    hand: str,
    scene: GraspConfig,
    skin: Skin,
    numbers: Sequence[int],
    workers: int,
    every_moment: bool = False,
    tick: Callable[[], None] = lambda: None,
    weight: float = 1.0,
) -> Starts:
    """The starts that the seeds `numbers` draw in a scene, which together weigh `weight`. Closing is
    asked for where a taxel fires first, or with `every_moment` after every number of actions. `tick` is
    called after every start."""
    blind: dict[str, Any] = {**NO_FAULTS, "touch": "absent", "history": 1}
    make = partial(SkinnedEnv, hand, replace(scene, **blind), skin.taxels)
    found = []
    with closing(vector.start(make, workers)) as played_in:
        for row in played_in.play(partial(_play, every_moment), numbers):
            found.append(row)
            tick()
    fires, succeeds, sets_off, lets_go = map(np.array, zip(*found, strict=True))
    return Starts(
        fires, succeeds, sets_off, lets_go, np.full(len(found), weight / len(found))
    )


def _play(
    every_moment: bool, env: gym.Env[Any, Any], number: int, is_wanted: vector.IsWanted
) -> tuple[Array, Array, int, int]:
    """A row of each array of `Starts`. A start in which the physics breaks is felt by nobody."""
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
    for moment in (
        range(step) if every_moment else np.unique(fires[fires < NEVER]).tolist()
    ):
        if not is_wanted():
            break
        succeeds[moment] = Reflex("time", moment, 1.0).play(env, number)
    return fires, succeeds, sets_off, sets_off + base.task.stays
