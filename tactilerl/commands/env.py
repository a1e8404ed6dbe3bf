"""`tactilerl env`: what an environment consists of."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from .. import envs
from ..envs import scenes
from ..envs.grasp import GraspEnv
from ..envs.hands import tactile
from ..envs.layouts import Taxels
from ..envs.taxel_formats import WRITERS
from ..errors import InputError, input_errors
from ..files import content, replacing
from ..terminal.help import About
from .scene import layout_notes, read_any

ABOUT = About(
    "Describe an environment: what it is, its actions, observations and taxels. Without flags it also "
    "lists the named scenes.",
    first=("layout", "touch", "simulator", "task"),
    examples=(
        "tactilerl env --scene handover",
        "tactilerl env --env shadow --layout 4 --describe",
    ),
)
MJCF = ".xml"


@dataclass(frozen=True)
class EnvFlags:
    """Flags of `tactilerl env`, besides the scene's."""

    env: str = "shadow"
    """A hand, a toy (lqr, point-reach) or a Gymnasium id."""
    describe: bool = False
    """List every entry of the observation and the action."""
    export: Path | None = None
    """Write the layout as points on the hand's links (.toml, .json: Genesis, .csv), or the hand with it
    as MuJoCo's tactile sensors (.xml)."""
    json: bool = False
    """Print JSON instead of text."""


def _export(path: Path, base: Any) -> None:
    """Write taxels as points on links, or as sensors of the hand's model, as the name says."""
    taxels: Taxels | None = getattr(base, "taxels", None)
    if taxels is None:
        raise InputError(
            "--export: found an environment without taxels, allowed those of hands"
        )
    if path.suffix not in (*WRITERS, MJCF):
        allowed = ", ".join((*WRITERS, MJCF))
        raise InputError(
            f"--export: found {path.name!r}, allowed names that end in {allowed}"
        )
    with input_errors("--export"):
        is_model = path.suffix == MJCF
        made = (
            tactile.xml(base.hand, taxels)
            if is_model
            else WRITERS[path.suffix](taxels.points)
        )
    with replacing(path, lambda there: content(there) == made) as file:
        file.write(made)


def main(args: list[str]) -> int:
    """`tactilerl env --describe`"""
    read, scene = read_any(EnvFlags, args, "tactilerl env", ABOUT)
    with (
        input_errors(),
        closing(GraspEnv(read.env, scene) if scene else envs.make(read.env)) as made,
    ):
        base: Any = made.unwrapped
        spaces = {
            "action_space": made.action_space,
            "observation_space": made.observation_space,
        }
        described: dict[str, Any] = {
            "env": read.env,
            **{name: str(space) for name, space in spaces.items()},
        }
        if scene:
            described |= {
                "observation": base.observation_names(),
                "action": base.hand.action_names,
            }
            described |= {
                "taxels": len(base.taxels),
                "notes": layout_notes(read.env, scene.layout),
            }
    if read.export is not None:
        _export(read.export, base)
    if read.json:
        print(json.dumps(described))
        return 0
    lines = [f"env: {read.env}"]
    if scene:
        length = f"up to {base.max_episode_steps} actions of {scene.control_dt:g} s"
        lines.append(f"task: {scene.task} in {scene.simulator}, {length}")
    lines += [f"{name}: {_short(space)}" for name, space in spaces.items()]
    if scene:
        lines += [
            f"taxels: {described['taxels']}",
            *(f"note: {it}" for it in described["notes"]),
        ]
    if not args:
        lines.append("named scenes (--scene NAME):")
        lines += [f"  {name:18} {scenes.load(name).about}" for name in scenes.names()]
    for key in ("action", "observation") if read.describe else ():
        lines += [
            f"{key}[{i}] {entry}" for i, entry in enumerate(described.get(key, ()))
        ]
    print("\n".join(lines))
    return 0


def _short(space: gym.Space[Any]) -> str:
    """Of one line: bounds that are infinite, or differ between entries, are left out."""
    if isinstance(space, gym.spaces.Dict):
        return f"Dict({', '.join(f'{key}: {_short(part)}' for key, part in space.spaces.items())})"
    whole = str(space)
    return (
        whole
        if "[" not in whole and "inf" not in whole
        else f"{type(space).__name__}{space.shape}"
    )
