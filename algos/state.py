"""What a learner's checkpoint holds: the states of its parts, its counters, its random state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def take(learner: Any, parts: Sequence[str], counters: Sequence[str]) -> dict[str, Any]:
    """`state_dict` of the attributes `parts`, the values of `counters`, and `learner.rng`'s state."""
    return {
        **{name: getattr(learner, name).state_dict() for name in parts},
        **{name: getattr(learner, name) for name in counters},
        "rng": learner.rng.bit_generator.state,
    }


def give(learner: Any, state: dict[str, Any], parts: Sequence[str], counters: Sequence[str]) -> None:
    """Put back what `take` returned; a state without "rng" leaves the learner its own, as a rank
    that is new needs it."""
    for name in parts:
        getattr(learner, name).load_state_dict(state[name])
    for name in counters:
        setattr(learner, name, state[name])
    if "rng" in state:
        learner.rng.bit_generator.state = state["rng"]
