"""`tactilerl env`: what an environment consists of."""

from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from .. import envs
from ..envs import scenes
from ..envs.layouts import Taxels
from ..envs.taxel_files import WRITERS
from ..errors import InputError, input_errors
from ..runs.files import replacing
from ..terminal.help import About
from .scene import layout_notes, read_scene

ABOUT = About(
    "Describe an environment: what it is, its actions, observations and taxels. Without flags it also "
    "lists the named scenes.",
    first=("layout", "run_type", "simulator", "task"),
    examples=("tactilerl env --scene handover", "tactilerl env --env shadow --layout 4 --describe"),
)


@dataclass(frozen=True)
class EnvFlags:
    """Flags of `tactilerl env`, besides the scene's."""

    env: str = "shadow"
    """A hand, a toy (lqr, point-reach) or a Gymnasium id."""
    describe: bool = False
    """List every entry of the observation and the action."""
    export: Path | None = None
    """Write the layout as points on the hand's links: .toml, .json (Genesis), .npz (DEX-01), .csv."""
    json: bool = False
    """Print JSON instead of text."""


def _export(path: Path, taxels: Taxels | None) -> None:
    """Write taxels as points on links, in the format that the name says."""
    if taxels is None:
        raise InputError("--export: found an environment without taxels, allowed those of hands")
    if path.suffix not in WRITERS:
        allowed = ", ".join(WRITERS)
        raise InputError(f"--export: found {path.name!r}, allowed names that end in {allowed}")
    files = {path: taxels.points()}
    if path.suffix == ".npz" and len(taxels.links) > 1:  # a pattern is of one link
        files = {
            path.with_stem(f"{path.stem}_{re.sub('[^a-zA-Z0-9_.-]', '_', link)}"): [
                point for point in taxels.points() if point.link == link
            ]
            for link in taxels.links
        }
    for name, points in files.items():
        with replacing(name) as file:
            file.write(WRITERS[path.suffix](points))


def main(args: list[str]) -> int:
    """`tactilerl env --describe`"""
    read, scene = read_scene(EnvFlags, args, "tactilerl env", ABOUT)
    name = read.env
    with input_errors():
        made = envs.make(name, **(dataclasses.asdict(scene) if scene else {}))
    try:
        base: Any = made.unwrapped
        described: dict[str, Any] = {
            "env": name,
            "action_space": str(made.action_space),
            "observation_space": str(made.observation_space),
        }
        if scene:
            described |= {"observation": base.observation_names(), "action": base.hand.action_names}
            described["taxels"] = len(base.taxels)
            described["notes"] = layout_notes(name, scene.layout)
        if read.export is not None:
            _export(read.export, getattr(base, "taxels", None))
    finally:
        made.close()
    if read.json:
        print(json.dumps(described))
        return 0
    print(f"env: {name}")
    print(f"action_space: {_short(made.action_space)}")
    print(f"observation_space: {_short(made.observation_space)}")
    if scene:
        print(f"taxels: {described['taxels']}")
    for note in described.get("notes", ()):
        print(f"note: {note}")
    if not args:
        print("named scenes (--scene NAME):")
        for scene_name in scenes.names():
            print(f"  {scene_name:18} {scenes.load(scene_name).about}")
    if read.describe:
        for key in ("action", "observation"):
            for index, entry in enumerate(described.get(key, ())):
                print(f"{key}[{index}] {entry}")
    return 0


def _short(space: gym.Space[Any]) -> str:
    """Of one line: bounds that differ between entries are left out."""
    if isinstance(space, gym.spaces.Dict):
        return f"Dict({', '.join(f'{key}: {_short(part)}' for key, part in space.spaces.items())})"
    whole = str(space)
    return whole if "[" not in whole else f"{type(space).__name__}{space.shape}"
