"""A task of your own: hold a paper cup without crushing it.

The command line imports it:

cd examples
tactilerl gate --import own_task --scene own_task.toml
tactilerl train --import own_task --scene own_task.toml --out runs/cup
tactilerl evaluate --import own_task runs/cup
"""

from typing import ClassVar

import numpy as np
from tactilerl.envs.state import Array, State
from tactilerl.envs.tasks import OUTCOMES, TASKS, Handover


class HoldCup(Handover):
    """A handover that fails as soon as the hand presses too hard."""

    limit: ClassVar[float] = 20.0
    """Sum of the normal forces on the cup, N."""

    def after_step(self, state: State, is_last: bool) -> tuple[Array, bool]:
        """As in a handover, unless the cup is crushed."""
        if state.contacts.forces.sum() > self.limit:
            return np.array([OUTCOMES["missed"]]), True
        return super().after_step(state, is_last)


TASKS["hold-cup"] = HoldCup
