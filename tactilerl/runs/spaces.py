"""Write and read what a saved policy has to know of its environment's spaces, as JSON."""

from __future__ import annotations

import json
import math

import gymnasium as gym
import numpy as np

from ..algos.policy import Spaces, action_bounds

MAX_ENTRIES = 10**6  # of an observation: more is a damaged file


def to_json(spaces: Spaces) -> str:
    """Return shapes of observations and bounds of actions."""
    low, high = action_bounds(spaces.action)
    action = {"shape": low.shape, "dtype": str(low.dtype)}
    action |= {"low": low.ravel().tolist(), "high": high.ravel().tolist()}
    return json.dumps({"observation": spaces.shapes, "action": action})


def from_json(text: str) -> Spaces:
    """Return spaces of which `to_json` would say the same; observations have no bounds.

    Raises an error of any kind when this is not such a text.
    """
    known = json.loads(text)
    action, shapes = known["action"], known["observation"]
    n = sum(math.prod(shape) for shape in shapes.values())
    if n > MAX_ENTRIES:
        raise ValueError(f"spaces: found {len(shapes)} parts with {n} entries")
    boxes = {
        key: gym.spaces.Box(-np.inf, np.inf, tuple(shape))
        for key, shape in shapes.items()
    }
    low, high = (
        np.array(action[name], action["dtype"]).reshape(action["shape"])
        for name in ("low", "high")
    )
    bounds = gym.spaces.Box(low, high, dtype=low.dtype.type)
    return Spaces(boxes.get("") or gym.spaces.Dict(boxes), bounds)  # type: ignore[arg-type]
