"""A task of your own: hold a paper cup without crushing it.

The command line imports it:

cd examples
tactilerl gate --import own_task --scene own_task.toml
tactilerl train --import own_task --scene own_task.toml --out runs/cup
tactilerl evaluate --import own_task runs/cup
"""

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from tactilerl.envs.objects import Items, ObjectConfig
from tactilerl.envs.observations import Term
from tactilerl.envs.state import Array, State
from tactilerl.envs.tasks import OUTCOMES, TASKS, Handover


def pressure(state: State) -> Array:
    """Return the sum of the normal forces on the cup, N (...)."""
    return state.contacts.forces.sum(-1)


class HoldCup(Handover):
    """A handover that fails as soon as the hand presses too hard, which it feels."""

    limit: ClassVar[float] = 20.0
    """Largest pressure on the cup, N."""
    is_batched = True  # any leading axes are welcome: `[..., i]`, `sum(-1)`
    observation_terms = {
        "pressure": Term(
            "pressure on", lambda hand: ["cup"], lambda _, s: pressure(s)[..., None]
        )
    }

    @classmethod
    def items(cls, config: ObjectConfig) -> Items:
        """Return cups, 4.5 cm in diameter and height and of 7 g, whatever the scene says."""
        size = 0.045, 0.045
        return Items(
            replace(config, object="cylinder", object_size=size, object_density=100.0)
        )

    def after_step(self, state: State, is_last: Any) -> tuple[Array, Any]:
        """Do as in a handover, unless the cup is crushed."""
        achieved, ended = super().after_step(state, is_last)
        is_crushed = pressure(state) > self.limit
        achieved = np.where(is_crushed[..., None], OUTCOMES["missed"], achieved)
        return achieved, ended | is_crushed


TASKS["hold-cup"] = HoldCup
