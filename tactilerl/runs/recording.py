"""Record episodes step by step, one named column for each entry of the observation and the action."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..algos.policy import Policy, action_size, flat_parts
from ..algos.rollout import Episode
from ..errors import InputError
from ..files import replacing, require_new

ENDING = ".csv"


def require_record(path: Path, overwrite: bool) -> None:
    """Raise InputError where no record can be written to `path`."""
    if path.suffix.lower() != ENDING:
        raise InputError(
            f"--record: found {path.name!r}, allowed names that end in {ENDING}"
        )
    require_new(path, overwrite)


def sensed(env: Any) -> dict[str, int]:
    """Return the names of an observation's newest entries, with their indices.

    InputError where the environment does not name them all.
    """
    size = math.prod(flat_parts(env.observation_space)["observation"].shape)
    names: list[str] = []
    if env.has_wrapper_attr("observation_names"):
        names = env.get_wrapper_attr("observation_names")()
    if len(names) != size:
        raise InputError(
            f"observation_names of the environment: found {len(names) or 'none'}, allowed a name "
            f"for each of the {size} entries that it observes"
        )
    return {name: index for index, name in enumerate(names) if "(t-" not in name}


def action_names(env: Any) -> list[str]:
    """Return the names of an action's entries: a hand's, or their numbers."""
    if env.has_wrapper_attr("hand"):
        return [*env.get_wrapper_attr("hand").action_names]
    return [*map(str, range(action_size(env.action_space)))]


@contextmanager
def recorder(
    path: Path | None, env: Any, policy: Policy, control_dt: float
) -> Iterator[Callable[[int, Episode[Any]], None]]:
    """Give a function that adds an episode, with its number, to a new CSV file, if there is one.

    A row has what the policy was told, what it did, and what came of it. The first three columns and
    the last have LeRobot's names. Nothing is written where an error occurs inside.
    """
    if path is None:
        yield lambda *_: None
        return
    names = sensed(env)
    actions = [f"action {name}" for name in action_names(env)]
    last = ["next.reward", "next.done", "next.success"]
    with replacing(path) as file:
        text = io.TextIOWrapper(file, "utf-8", newline="", write_through=True)
        writer = csv.writer(text, lineterminator="\n")
        first = ["episode_index", "frame_index", "timestamp"]
        writer.writerow([*first, *names, *actions, *last])

        def add(number: int, episode: Episode[Any]) -> None:
            for step, reward in enumerate(episode.rewards):
                view = episode.obs[step]
                told = getattr(view, "observation", view)[[*names.values()]]
                action = policy.to_env(episode.actions[step]).ravel()
                time = round(step * control_dt, 6)
                is_done = step + 1 == len(episode)
                success = episode.success * is_done  # nan where nobody says
                outcome = reward, int(is_done), success
                writer.writerow([number, step, time, *told, *action, *outcome])

        yield add
