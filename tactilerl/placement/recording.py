"""Play handovers while the hand waits.

Nothing before it closes depends on its taxels, so one recording serves every layout. Each start is then
played again for each moment at which the hand could close.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
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
from ..envs.validation import require_one_of
from ..scripted.gate import NO_FAULTS
from ..scripted.reflexes import Reflex
from .cover import NEVER, Starts


class SkinnedEnv(GraspEnv):
    """Read a whole skin beside the taxels of the layout, each with several thresholds.

    More taxels than one layout may have; some lie in the same place and differ in size.
    """

    def __init__(
        self, hand: str, config: GraspConfig, skin: Taxels, thresholds: Array
    ) -> None:
        """Take the thresholds (t, n) in N at which each taxel fires."""
        is_force = thresholds.any()
        allowed = ["skin"] if is_force else sorted(set(RULES) - {"contact"})
        require_one_of(allowed, config.touch_rule, "touch_rule")
        super().__init__(hand, config)
        self.skin, self._thresholds = skin, thresholds
        self._rule = (ForceRule if is_force else RULES[config.touch_rule])(
            skin, self.hand
        )

    def firing(self) -> Array:
        """Tell which taxels fire with each threshold, bool (t, n)."""
        state = self.simulator.state()
        if not (isinstance(self._rule, ForceRule) and self._thresholds.any()):
            return self._rule.read(state)[None] > 0
        is_on, forces = self._rule.feel(state)
        return np.asarray(is_on & (forces >= self._thresholds))


def record(
    hand: str,
    scenes: Sequence[GraspConfig],
    taxels: Taxels,
    numbers: Sequence[int],
    workers: int,
    tick: Callable[[], None] = lambda: None,
    thresholds: Sequence[float | None] = (None,),
) -> list[Starts]:
    """Play the starts that the seeds `numbers` draw in each scene; return all for each threshold in N.

    None stands for the scene's threshold, or each taxel's own. `tick` is called after every start.
    """
    blind: dict[str, Any] = {**NO_FAULTS, "touch": "absent", "history": 1}
    rows: list[Any] = []
    for scene in scenes:
        forces = np.tile(taxels.thresholds, (len(thresholds), 1))
        for row, threshold in zip(forces, thresholds, strict=True):
            force = scene.taxel_threshold if threshold is None else threshold
            if force is not None:
                row[:] = force
        make = partial(SkinnedEnv, hand, replace(scene, **blind), taxels, forces)
        play = partial(_play, delay=scene.taxel_delay, n_thresholds=len(forces))
        with closing(vector.start(make, workers)) as played_in:
            for played in played_in.play(play, numbers):
                rows.append(played)
                tick()
    fires, succeeds, sets_off, lets_go = map(np.array, zip(*rows, strict=True))
    return [
        Starts(fires[:, i], succeeds, sets_off, lets_go) for i in range(len(thresholds))
    ]


def _play(
    env: gym.Env[Any, Any],
    number: int,
    is_wanted: vector.IsWanted,
    delay: int,
    n_thresholds: int,
) -> tuple[Array, Array, int, int]:
    """Return a row of each array of `Starts`, with a row of first firings for each threshold.

    Readings come `delay` actions late. A start in which the physics breaks is felt by nobody.
    """
    base: Any = env.unwrapped
    fires = np.full((n_thresholds, len(base.skin)), NEVER, np.uint8)
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
