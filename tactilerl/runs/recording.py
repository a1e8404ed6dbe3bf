"""Record episodes step by step, one named column for each entry of the observation and the action."""

from __future__ import annotations

import codecs
import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..algos.policy import Policy
from ..algos.rollout import Episode
from ..envs.grasp import GraspEnv
from ..errors import InputError
from ..files import replacing, require_new


def sensed(env: Any) -> dict[str, int]:
    """Return the names of an observation's newest entries, with their indices.

    InputError where the environment is not one of a hand, whose sensors have names.
    """
    if not isinstance(env, GraspEnv):
        raise InputError(
            f"env: found {env}, allowed runs of hands: no sensor has a name here"
        )
    named = enumerate(env.observation_names())
    return {name: index for index, name in named if "(t-" not in name}


@contextmanager
def recorder(
    path: Path | None, overwrite: bool, env: Any, policy: Policy
) -> Iterator[Callable[[int, Episode[Any]], None]]:
    """Give a function that adds an episode, with its number, to a new CSV file, if there is one.

    A row has what the policy was told, what it did, and what came of it. The first three columns and
    the last have LeRobot's names. Nothing is written where an error occurs inside.
    """
    if path is None:
        yield lambda *_: None
        return
    require_new(path, overwrite, ".csv")
    names = sensed(env)
    header = ["episode_index", "frame_index", "timestamp", *names]
    header += [f"action {name}" for name in env.hand.action_names]
    with replacing(path) as file:
        writer = csv.writer(codecs.getwriter("utf-8")(file), lineterminator="\n")
        writer.writerow([*header, "next.reward", "next.done", "next.success"])

        def add(number: int, episode: Episode[Any]) -> None:
            for step, reward in enumerate(episode.rewards):
                view = episode.obs[step]
                told = getattr(view, "observation", view)[[*names.values()]]
                done = policy.to_env(episode.actions[step])
                is_last = step + 1 == len(episode)
                time = round(step * env.config.control_dt, 6)
                success = int(is_last and episode.success)
                row = number, step, time, *told, *done, reward, int(is_last), success
                writer.writerow(row)

        yield add
