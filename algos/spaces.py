"""The spaces of an environment: what a learner reads of them, and what a saved policy keeps."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

Array = np.ndarray
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
GOAL_DICT = "Dict with observation, achieved_goal and desired_goal"
PRIVILEGED = "truth"  # key of a Dict: what a critic may see besides, and no policy
MAX_ENTRIES = 10**7  # of an observation or an action: more is a damaged file


class Spaces(NamedTuple):
    """An environment's, as Gymnasium has them."""

    observation: gym.Space[Any]
    action: gym.Space[Any]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of a goal environment's observations by their names; of others, one, named ""."""
        space = self.observation
        if isinstance(space, gym.spaces.Dict):
            return {
                key: tuple(space[key].shape or ())
                for key in GOAL_KEYS
                if key in space.spaces
            }
        return {"": tuple(space.shape or ())}

    @property
    def privileged(self) -> gym.spaces.Box:
        """What critics see besides observation and goal; of no size where there is nothing."""
        nothing = gym.spaces.Box(0.0, 0.0, (0,))
        is_dict = isinstance(self.observation, gym.spaces.Dict)
        found = self.observation.get(PRIVILEGED, nothing) if is_dict else nothing  # type: ignore[attr-defined]
        if not isinstance(found, gym.spaces.Box):
            raise ValueError(
                f"observation space: found {found} for {PRIVILEGED!r}, allowed a Box"
            )
        return found

    def inputs(self, *more: str) -> list[str] | None:
        """Names of the entries of a flat observation, then of `more` (`PRIVILEGED`, "action").

        A Box has them in its attribute `names`; entries of others go by their numbers. None where
        none has any.
        """
        parts: dict[str, Any] = flat_parts(self.observation)
        parts |= {
            key: {PRIVILEGED: self.privileged, "action": self.action}[key]
            for key in more
        }
        if not any(hasattr(box, "names") for box in parts.values()):
            return None
        return [
            f"{key} {name}"
            for key, box in parts.items()
            for name in getattr(box, "names", range(math.prod(box.shape)))
        ]

    def to_json(self) -> str:
        """What a policy has to know of them: the shapes of observations, the bounds of actions."""
        low, high = (np.ravel(bound) for bound in (self.action.low, self.action.high))  # type: ignore[attr-defined]
        action = {"shape": self.action.shape, "dtype": str(self.action.dtype)}
        action |= {"low": low.tolist(), "high": high.tolist()}
        return json.dumps({"observation": self.shapes, "action": action})

    @classmethod
    def from_json(cls, text: str) -> Spaces:
        """Spaces of which `to_json` would say the same; observations have no bounds in them.

        ValueError when this is not such a text.
        """
        try:
            known = json.loads(text)
            shapes, action = known["observation"], known["action"]
            boxes: dict[str, gym.Space[Any]] = {
                key: _box(-np.inf, np.inf, shape, np.float32)
                for key, shape in shapes.items()
            }
            if np.dtype(action["dtype"]).kind not in "fiub":
                raise ValueError(
                    f"spaces: found actions of type {action['dtype']!r}"[:100]
                )
            bounds = (
                np.array(action[name], action["dtype"]) for name in ("low", "high")
            )
            low, high = (bound.reshape(action["shape"]) for bound in bounds)
            space = boxes[""] if "" in boxes else gym.spaces.Dict(boxes)
            return cls(
                space, _box(low, high, action["shape"], np.dtype(action["dtype"]))
            )
        except (
            LookupError,
            AttributeError,
            TypeError,
            AssertionError,
            RecursionError,
        ) as error:
            raise ValueError(f"spaces: found none ({error})") from error


def _box(low: Any, high: Any, shape: Any, dtype: Any) -> gym.spaces.Box:
    if (
        not all(isinstance(n, int) and n >= 0 for n in shape)
        or math.prod(shape) > MAX_ENTRIES
    ):
        raise ValueError(f"spaces: found the shape {str(shape)[:50]}")
    return gym.spaces.Box(low, high, tuple(shape), dtype)


def action_bounds(space: gym.Space[Any]) -> tuple[Array, Array]:
    """(low, high) of an action space; ValueError when it is not a bounded Box."""
    if (
        isinstance(space, gym.spaces.Box)
        and space.is_bounded()
        and space.dtype.kind == "f"
    ):
        with np.errstate(over="ignore"):
            if np.isfinite(space.high - space.low).all():
                return space.low, space.high
    raise ValueError(
        f"action space: found {space}, allowed Box of floats with finite bounds"
    )


def action_size(space: gym.Space[Any]) -> int:
    """Number of entries of an action; ValueError when the space is not a bounded Box."""
    return int(action_bounds(space)[0].size)


def flat_parts(space: gym.Space[Any]) -> dict[str, gym.spaces.Box]:
    """What a flat observation is made of, by name; ValueError for spaces no algorithm here can read."""
    parts: dict[str, Any] = {"observation": space}
    if isinstance(space, gym.spaces.Dict) and {"observation", "desired_goal"} <= set(
        space.spaces
    ):
        parts = {key: space[key] for key in ("observation", "desired_goal")}
    for part in parts.values():
        if not isinstance(part, gym.spaces.Box):
            hint = "; gymnasium.wrappers.FlattenObservation makes a Box"
            raise ValueError(
                f"observation space: found {part}, allowed Box, or {GOAL_DICT}{hint}"
            )
        if part.dtype == np.uint8 and len(part.shape) == 3:
            found = f"found images {part.shape}"
            raise ValueError(
                f"observation space: {found}, allowed vectors; no learner here sees"
            )
    return parts


def flat_size(space: gym.Space[Any]) -> int:
    """Length of a flat observation; ValueError as of `flat_parts`."""
    return sum(math.prod(part.shape) for part in flat_parts(space).values())


def goal_size(space: gym.Space[Any]) -> int:
    """Length of a goal environment's goals; ValueError when it is not one."""
    if isinstance(space, gym.spaces.Dict) and set(GOAL_KEYS) <= set(space.spaces):
        _, achieved, desired = (flat_size(space[key]) for key in GOAL_KEYS)
        if achieved == desired:
            return desired
    raise ValueError(
        f"observation space: found {space}, allowed a goal environment's: {GOAL_DICT}"
    )


def may_be_boolean(space: gym.Space[Any]) -> Array:
    """Which entries (n,) of a flat observation lie between 0 and 1, and so may be Boolean?"""
    parts = flat_parts(space).values()
    return np.concatenate(
        [np.ravel((part.low == 0.0) & (part.high == 1.0)) for part in parts]
    )


def n_boolean(space: Any) -> int:
    """How many entries at the end of a goal environment's observation may be Boolean."""
    within = may_be_boolean(space["observation"])
    return len(within) - 1 - int(np.max(np.flatnonzero(~within), initial=-1))
