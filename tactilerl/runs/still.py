"""Find goals that a hand reaches without a move."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

N_STILL = 4  # episodes


def ends_at_goal_standing_still(
    env: Any, number: int, is_wanted: Callable[[], bool]
) -> bool:
    """Play an episode of a grasp in which no joint is told to move; return whether it succeeds."""
    grasp, is_over, info = env.unwrapped, False, {}
    grasp.reset(seed=number)
    while not is_over:
        *_, terminated, truncated, info = grasp.step_to(grasp.state.targets)
        is_over = terminated or truncated
    return bool(info.get("is_success", False))


def note_of_standing_still(play: Callable[..., Iterator[bool]]) -> list[str]:
    """Return a sentence where standing still already reaches the goal, from a few starts."""
    reached = sum(play(ends_at_goal_standing_still, range(N_STILL)))
    if not reached:
        return []
    return [
        f"a hand that stands still reaches the goal in {reached} of {N_STILL} episodes: success says "
        "little about what is learned (see --goal-height, --goal-tolerance)"
    ]
