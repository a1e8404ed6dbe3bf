"""Where do a hand's few taxels go? Which of two criteria applies follows from the scene's task."""

from __future__ import annotations

from collections.abc import Callable

from ..envs import validation
from ..errors import extra
from . import timing
from .candidates import Design, DesignFlags, Pool


def design(
    flags: DesignFlags,
    workers: int,
    show: Callable[[int, int], None] = lambda done, of: None,
) -> Design:
    """Where an object is handed over, when to close is the question: taxels by which a hand succeeds
    that closes at the first touch. Elsewhere it is whether a grasp will hold: taxels that tell most of
    that. `show` is told how many starts are played, of how many. ValueError where it cannot be."""
    pool = Pool.of(flags)
    if pool.is_timing:
        return timing.design(pool, workers, show)
    if len(pool.scenes) > 1:
        raise ValueError(
            f"scene: found {len(pool.scenes)}, allowed one, or several handovers"
        )
    faults = "redundancy", "taxel_dead", "taxel_false_on"
    validation.allow_only_with(
        "a handover", flags, *faults, "test_starts", "weights", "start_closing"
    )
    with extra("probe"):
        from . import information
    return information.design(pool, workers, show)
