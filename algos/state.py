"""What a learner's checkpoint holds: the states of its parts and its counters. Random numbers follow
from the seed and the counters.

A state that comes from a file is compared with the learner's own before any of it is used: a
tensor of another shape would make PyTorch write where nothing of it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch

LARGEST = 2**63  # counters stay below


class Saved:
    """What a learner is, by the names of its attributes."""

    saved: ClassVar[Sequence[str]]
    """Those that have states of their own."""
    counters: ClassVar[Sequence[str]]

    def state_dict(self) -> dict[str, Any]:
        states = {name: getattr(self, name).state_dict() for name in self.saved}
        return states | {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        require_like(saved, self.state_dict())
        for name in self.saved:
            getattr(self, name).load_state_dict(saved[name])
        for name in self.counters:
            setattr(self, name, saved[name])


def restore_parts(parts: Mapping[str, Any], state: dict[str, Any]) -> None:
    """Put back only some parts, by name, of a learner's state; ValueError as of `load_state_dict`."""
    own = {name: part.state_dict() for name, part in parts.items()}
    is_dict = isinstance(state, dict)
    require_like({k: v for k, v in state.items() if k in parts} if is_dict else state, own)
    for name, part in parts.items():
        part.load_state_dict(state[name])


def require_like(found: Any, own: Any, name: str = "state") -> None:
    """ValueError naming the first place where `found` is not of the kind that `own` is.

    The same keys, lengths and types all the way down; tensors of the same shape and dtype, whole and
    on the CPU or the same device; texts of any content; numbers finite and not negative, for they
    count something. Only what `own` has is looked at, so a state that is nested without end costs
    nothing.
    """
    if not _is_like(found, own):
        raise ValueError(f"{name}: found {_short(found)}, expected {_short(own)}")
    if isinstance(own, dict):
        for key, value in own.items():
            require_like(found[key], value, f"{name}.{key}")
    elif isinstance(own, list | tuple):
        for i, value in enumerate(own):
            require_like(found[i], value, f"{name}[{i}]")
    elif isinstance(own, int | float) and not 0 <= found < (math.inf, LARGEST)[isinstance(own, int)]:
        raise ValueError(f"{name}: found a number out of range, allowed from 0 to below 2**63")


def _is_like(found: Any, own: Any) -> bool:
    """Leaving aside what they hold."""
    if isinstance(own, torch.Tensor):
        return (
            isinstance(found, torch.Tensor)
            and (found.dtype, found.shape) == (own.dtype, own.shape)
            and found.device in (torch.device("cpu"), own.device)
            and found.layout == torch.strided
            and found.is_contiguous()
        )
    if isinstance(own, dict):
        return isinstance(found, dict) and found.keys() == own.keys()
    is_sequence = isinstance(own, list | tuple)
    return type(found) is type(own) and not (is_sequence and len(found) != len(own))


def _short(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, torch.Tensor):
        return f"{value.dtype} {tuple(value.shape)}".removeprefix("torch.")
    if isinstance(value, dict):
        names = ", ".join(str(key)[:30] for key in list(value)[:8])
        return f"a dict of {len(value)} ({names})"
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    return type(value).__name__
