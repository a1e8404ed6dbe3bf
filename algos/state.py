"""What a learner's checkpoint holds: the states of its parts and its counters. Random numbers follow
from the seed and the counters.

Files of states have checksums, so what is in them was written by a learner, and may only be another's
or of another version.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

NAMES_OF_0_3 = {"spread": "gaussian", "log": "log_std", "truth_stats": "privileged_stats"}


class Saved:
    """What a learner is, by the names of its attributes."""

    saved: ClassVar[Sequence[str]]
    """Those that have states of their own."""
    counters: ClassVar[Sequence[str]]

    def state_dict(self) -> dict[str, Any]:
        states = {name: getattr(self, name).state_dict() for name in self.saved}
        return states | {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        saved = with_current_names(saved)
        require_keys(saved, {*self.saved, *self.counters})
        for name in self.saved:
            getattr(self, name).load_state_dict(saved[name])
        for name in self.counters:
            setattr(self, name, saved[name])


def restore_parts(parts: Mapping[str, Any], state: dict[str, Any]) -> None:
    """Put back only some parts, by name, of a learner's state; ValueError as of `load_state_dict`."""
    state = with_current_names(state)
    require_keys({name: state[name] for name in parts if name in state}, {*parts})
    for name, part in parts.items():
        part.load_state_dict(state[name])


def with_current_names(state: Any) -> Any:
    """A state that 0.3.0 may have written, all the way down."""
    if not isinstance(state, dict):
        return state
    return {NAMES_OF_0_3.get(name, name): with_current_names(part) for name, part in state.items()}


def require_keys(state: dict[str, Any], expected: set[str]) -> None:
    """ValueError where a state has other parts than a learner of this version."""
    if state.keys() != expected:
        different = ", ".join(sorted(state.keys() ^ expected))
        raise ValueError(f"state: {different}: missing, or unknown; a run is finished with its version")
