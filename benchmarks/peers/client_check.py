"""A check of another library: what it is, and how one runs in a process of its own.

    python -m benchmarks.peers.client_check NAME

It returns when everything worked; else it ends with one line about what its client raised.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

STEPS = 100  # more than an episode of a handover


class Check(NamedTuple):
    """What is tried with a client."""

    package: str
    """As it is installed."""
    tried: str
    run: Callable[[], None]


CHECKS: dict[str, Check] = {}
"""By the names of their functions, whose docstrings say what is tried."""


def check(package: str) -> Callable[[Callable[[], None]], Callable[[], None]]:
    """Marks a function as one of a package."""

    def noted(run: Callable[[], None]) -> Callable[[], None]:
        CHECKS[run.__name__] = Check(package, (run.__doc__ or "").removesuffix("."), run)
        return run

    return noted


def play(env: Any, steps: int = STEPS) -> None:
    """Random actions, a reset where an episode ends."""
    obs, _ = env.reset(seed=0)
    for _ in range(steps):
        assert env.observation_space.contains(obs)
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert np.isfinite(reward)
        if terminated or truncated:
            obs, _ = env.reset()
    env.close()


def one_line(error: Exception) -> str:
    """What went wrong; an assertion says nothing, but where it stands does."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    said = str(error).strip().splitlines() or [f"{Path(at.filename).name}: {at.line}"]
    return f"{type(error).__name__}: {said[0]}"[:200]


if __name__ == "__main__":
    from benchmarks.peers import client_checks  # which imports this file by its name

    try:
        client_checks.CHECKS[sys.argv[1]].run()
    except Exception as error:
        sys.exit(one_line(error))
