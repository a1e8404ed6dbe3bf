"""Run `tactilerl env`, which says what an environment consists of."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym

from ..envs import scenes, scripted, sensors, vector
from ..envs.grasp import GraspEnv
from ..errors import input_errors
from ..scripted import taxels
from ..scripted.taxels import TaxelCheck
from .scene import layout_notes, read_scene, require_grasp, sensor_notes

ABOUT = """\
Describe an environment: what it is, its actions, observations and taxels. Without flags it also
lists the named scenes and the sensors.

examples:
  tactilerl env --scene handover
  tactilerl env --env shadow --layout 4 --describe
  tactilerl env --env mpl --layout my_layout.toml --check
  tactilerl env --fit-sensor log.csv"""


@dataclass(frozen=True)
class EnvFlags:
    """Flags of `tactilerl env`, besides the scene's."""

    env: str = "shadow"
    """A hand: shadow, mpl, allegro, or the path of a hand's .toml file."""
    describe: bool = False
    """List every entry of the observation and the action."""
    check: bool = False
    """Play scripted grasps and say which taxels fire while the object is held and which
    never do. The exit code is 1 where a grasp does not hold, or for more than half of
    the time no taxel fires."""
    fit_sensor: tuple[Path, ...] = ()
    """Print a sensor's file, fitted to logs in which it is pressed and released: CSV
    with time,force_N,reading, a log for each specimen."""
    json: bool = False
    """Print JSON instead of text."""


def main(args: list[str]) -> int:
    """Run `tactilerl env --describe`; return 1 where --check finds that touch tells too little."""
    read, scene = read_scene(EnvFlags, args, "tactilerl env", ABOUT)
    with input_errors():
        if read.fit_sensor:
            from ..scripted.fit_sensor import fit  # imports SciPy

            print(fit(read.fit_sensor), end="")
            return 0
        with closing(GraspEnv(read.env, scene)) as env:
            content = _content(read.env, env)
            content["notes"] += scripted.notes_of_standing_still(
                vector.Workers(env).play
            )
        check = None
        if read.check:
            require_grasp(read.env, scene)
            check = taxels.check(read.env, scene)
            content["check"] = asdict(check)
    if read.json:
        print(json.dumps(content))
    else:
        _print(content, read.describe, check)
        if not args:
            print("named scenes (--scene NAME):")
            for name in scenes.names():
                print(f"  {name:18} {scenes.load(name).about}")
            print("sensors (--sensor NAME):")
            for name in sensors.names():
                print(f"  {name:20} {sensors.load(name).about}")
    return int(check is not None and not check.is_useful)


def _content(name: str, env: GraspEnv) -> dict[str, Any]:
    """Return what there is to say about an environment, as JSON has it."""
    scene, spaces = env.config, cast(gym.spaces.Dict, env.observation_space)
    length = f"up to {env.max_episode_steps} actions of {scene.control_dt:g} s"
    return {
        "env": name,
        "task": f"{scene.task} in {scene.simulator}, {length}",
        "action_space": f"Box{env.action_space.shape}",
        "observation_space": ", ".join(
            f"{key} {part.shape}" for key, part in spaces.items()
        ),
        "taxels": len(env.taxels),
        "notes": layout_notes(name, scene.layout) + sensor_notes(name, scene),
        "action": env.hand.action_names,
        "observation": env.observation_names(),
    }


def _print(content: dict[str, Any], everything: bool, check: TaxelCheck | None) -> None:
    """Print the content in lines, all entries of action and observation if `everything`."""
    for key in ("env", "task", "action_space", "observation_space", "taxels"):
        print(f"{key}: {content[key]}")
    for note in content["notes"]:
        print(f"note: {note}")
    for key in ("action", "observation") if everything else ():
        for index, entry in enumerate(content[key]):
            print(f"{key}[{index}] {entry}")
    if check is not None:
        print(
            f"check: {check.held} of {check.grasps} scripted grasps hold; {len(check.fired)} of "
            f"{content['taxels']} taxels fire in them, {check.mean_fired:.1f} at a time, and some "
            f"taxel in {100 * check.share_any:.0f} % of the time"
        )
        print(f"never fired: {', '.join(check.silent()) or 'none'}")
