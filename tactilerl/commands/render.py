"""`tactilerl render`: a picture of a scripted grasp, or a film of a run."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from .. import flags, render
from ..envs.grasp import GraspConfig, setup
from ..envs.simulators import Camera
from ..errors import InputError, input_errors
from ..terminal import console
from .scene import layout_notes, read_scene, require_scene


@dataclass(frozen=True)
class RenderFlags:
    """Flags of `tactilerl render`, besides the scene's."""

    run: tyro.conf.Positional[Path | None] = None
    """Run folder: film its policy in its own scene. Without one: picture of a scripted grasp."""
    video: Path = Path("episodes.mp4")
    """The film of a run's policy to write."""
    episodes: int = 1
    """Episodes in the film: the first that `evaluate` would play. Hold tests last 2 s unless
    --hold-seconds is given."""
    env: str = "shadow"
    """Environment of the picture."""
    out: Path = Path("grasp.png")
    """The picture to write."""
    pose: Literal["start", "grasp"] = "grasp"
    """The start of an episode, or a scripted grasp (picture)."""
    azimuth: float = Camera.azimuth
    """Direction of the camera, degrees; 300 looks at the palm."""
    elevation: float = Camera.elevation
    """Elevation of the camera, degrees; positive looks up from below."""
    distance: float = Camera.distance
    """Distance of the camera, m."""

    @property
    def camera(self) -> Camera:
        """The camera there."""
        return Camera(self.azimuth, self.elevation, self.distance)


def main(args: list[str]) -> int:
    """`tactilerl render`: a scripted grasp with its taxels; `tactilerl render RUN`: a film."""
    read, scene = read_scene(RenderFlags, args, "tactilerl render")
    name = read.env
    if not 0.05 <= read.distance <= 10:
        raise InputError(f"--distance: found {read.distance}, allowed from 0.05 to 10")
    for flag in ("video", "episodes") if read.run is None else ("env", "out", "pose"):
        if getattr(read, flag) != getattr(RenderFlags, flag):
            needed = "with" if read.run is None else "without"
            raise InputError(f"--{flag}: found it, allowed only {needed} RUN; see --help")
    if read.run is not None:
        return _film(args, read, scene)
    scene = require_scene(scene, name)
    with input_errors():
        lit = render.picture(name, scene, read.pose, read.camera, read.out)
    console.print(f"{read.out}: {lit} taxels fire")
    for note in layout_notes(name, scene.layout):
        console.print(note)
    return 0


def _film(args: list[str], read: RenderFlags, scene: GraspConfig | None) -> int:
    """The film of a run: of a scene's flags, only the length of the hold test has a meaning."""
    assert read.run is not None
    hold_seconds = render.HOLD_SECONDS
    if scene is not None and flags.peek(args, "--hold-seconds", ""):
        hold_seconds = scene.hold_seconds
        scene = dataclasses.replace(scene, hold_seconds=setup(read.env).hold_seconds)
    if scene != setup(read.env):
        raise InputError(
            "render RUN: found scene flags, allowed only --hold-seconds: a run keeps its scene"
        )
    flags.at_least("--episodes", read.episodes, 1)
    columns = SpinnerColumn(), TextColumn("{task.completed:.0f} pictures"), TimeElapsedColumn()
    bar = Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())
    with input_errors(), bar:
        drawn = bar.add_task("")
        film = render.film(
            *(read.run, read.episodes, hold_seconds, read.camera, read.video),
            tick=lambda: bar.advance(drawn),
        )
        for success in film:
            verdict = "success" if success else "no success"
            console.print(f"{read.video}: {verdict} (hold tests of {hold_seconds:g} s)")
    return 0
