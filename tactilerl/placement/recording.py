"""Play handovers while the hand waits.

Nothing before it closes depends on its taxels, so one recording serves every layout.
Each start is then played again for each moment at which the hand could close.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import sensors, touch, vector
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.layouts import Taxels
from ..envs.simulators import SimulationError
from ..envs.state import Array
from ..envs.touch import RULES
from ..envs.validation import require_one_of
from ..scripted.gate import NO_TOUCH
from ..scripted.reflexes import Reflex
from .cover import NEVER, Starts


class SkinnedEnv(GraspEnv):
    """Read a whole skin beside the taxels of the layout.

    More taxels than one layout may have; some lie in the same place and differ in size
    or threshold.
    """

    def __init__(self, hand: str, config: GraspConfig, skin: Taxels) -> None:
        """Take the taxels of the skin."""
        require_one_of(sorted({*RULES} - {"contact"}), config.touch_rule, "touch_rule")
        super().__init__(hand, config)
        self.skin = touch.make(config.touch_rule, skin, self.hand)
        self.skin_size = len(skin)


def record(
    hand: str,
    scenes: Sequence[GraspConfig],
    taxels: Taxels,
    numbers: Sequence[int],
    workers: int,
    tick: Callable[[], None] = lambda: None,
) -> Starts:
    """Play the starts that the seeds `numbers` draw in each scene.

    `tick` is called after every start.
    """
    blind = {**NO_TOUCH, "history": 1}
    rows: list[Any] = []
    for scene in scenes:
        make = partial(SkinnedEnv, hand, sensors.choose(scene, blind), taxels)
        play = partial(_play, late=scene.taxel_delay)
        with closing(vector.start(make, workers)) as played_in:
            for row in played_in.play(play, numbers):
                rows.append(row)
                tick()
    return Starts(*map(np.array, zip(*rows, strict=True)))


def _play(
    env: gym.Env[Any, Any], number: int, is_wanted: vector.IsWanted, late: int
) -> tuple[Array, Array, int, int]:
    """Return a row of each array of `Starts`.

    Readings come `late` actions late. A start in which the physics breaks is felt by
    nobody.
    """
    base: Any = env.unwrapped
    fires = np.full(base.skin_size, NEVER, np.uint8)
    succeeds = np.zeros(NEVER + 1, bool)
    base.skin.reset()
    try:
        env.reset(seed=number)
    except SimulationError:
        return fires, succeeds, 0, 0
    waiting, step, is_over = base.hand.start_targets(), 0, False
    while not is_over and is_wanted():
        is_first = (fires == NEVER) & (base.skin.read(base.simulator.state()) > 0)
        # The first reading is there from the beginning, however late the others are.
        fires[is_first] = min(step + late, NEVER) if step else 0
        *_, terminated, truncated, _ = base.step_to(waiting)
        step, is_over = step + 1, terminated or truncated
    sets_off = base.task.sets_off
    for moment in np.unique(fires[fires < NEVER]).tolist():
        if not is_wanted():
            break
        succeeds[moment] = Reflex("time", moment, 1.0).play(env, number)
    return fires, succeeds, sets_off + late, sets_off + base.task.stays
