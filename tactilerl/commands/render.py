"""`tactilerl render`: a picture of a scripted grasp, or a film of a run."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..envs.grasp import GraspConfig, setup
from ..envs.simulators import Camera
from ..errors import InputError, input_errors
from ..pictures import render
from ..terminal import flags
from ..terminal.console import console, progress
from ..terminal.help import About
from .grasps import require_grasp
from .scene import layout_notes, read_scene

ABOUT = About(
    "Draw a scripted grasp with its taxels, or film a trained run (extra: render).",
    first=("layout", "simulator"),
    examples=(
        "tactilerl render --env shadow --layout 1",
        "tactilerl render runs/X --video film.mp4",
    ),
)


@dataclass(frozen=True)
class RenderFlags:
    """Flags of `tactilerl render`, besides the scene's."""

    run: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folder whose policy is filmed in the run's own scene. Several runs are filmed side by side,
    from the same initial states. Without a run, a scripted grasp is drawn."""
    video: Path = Path("episodes.mp4")
    """File of the film."""
    episodes: Annotated[int, "[1, inf)"] = 3
    """Number of episodes in the film: the first ones that `evaluate` plays. Hold tests last 2 s
    unless --hold-seconds is given."""
    env: str = "shadow"
    """The hand in the picture."""
    out: Path = Path("grasp.png")
    """File of the picture."""
    pose: Literal["start", "grasp"] = "grasp"
    """What the picture shows: the start of an episode, or a scripted grasp."""
    azimuth: float = Camera.azimuth
    """Direction of the camera, degrees; 300 looks at the palm."""
    elevation: float = Camera.elevation
    """Elevation of the camera, degrees; positive looks up from below."""
    distance: Annotated[float, "[0.05, 10]"] = Camera.distance
    """Distance of the camera, m."""

    @property
    def camera(self) -> Camera:
        """The camera there."""
        return Camera(self.azimuth, self.elevation, self.distance)


def main(args: list[str]) -> int:
    """`tactilerl render`: a scripted grasp with its taxels; `tactilerl render RUN`: a film."""
    read, scene = read_scene(RenderFlags, args, "tactilerl render", ABOUT)
    name = read.env
    for flag in ("env", "out", "pose") if read.run else ("video", "episodes"):
        if getattr(read, flag) != getattr(RenderFlags, flag):
            found, needed = ("with", "without") if read.run else ("without", "with")
            raise InputError(
                f"--{flag}: found {found} a run folder, allowed only {needed} one"
            )
    if read.run:
        return _film(args, read, scene)
    with input_errors():
        if read.pose == "grasp":
            require_grasp(name, scene)
        lit = render.picture(name, scene, read.pose, read.camera, read.out)
    console.print(f"{read.out}: {lit} taxels fire")
    for note in layout_notes(name, scene.layout):
        console.print(note)
    return 0


def _film(args: list[str], read: RenderFlags, scene: GraspConfig) -> int:
    """The film of a run: of a scene's flags, only the length of the hold test has a meaning."""
    hold_seconds = render.HOLD_SECONDS
    if flags.peek(args, "--hold-seconds", ""):
        hold_seconds = scene.hold_seconds
        scene = dataclasses.replace(scene, hold_seconds=setup(read.env).hold_seconds)
    if scene != setup(read.env):
        raise InputError(
            "render RUN: found scene flags, allowed only --hold-seconds: a run keeps its scene"
        )
    with input_errors(), progress("pictures") as tick:
        for shown in render.film(
            read.run, read.episodes, hold_seconds, read.camera, read.video, tick
        ):
            verdicts = ", ".join(
                "success" if success else "no success" for success in shown
            )
            console.print(
                f"{read.video}: {verdicts} (hold tests of {hold_seconds:g} s)"
            )
    return 0
