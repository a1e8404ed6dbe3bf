"""`tactilerl render`: a picture of a scripted grasp; a trained run on the screen or in a film."""

from __future__ import annotations

import os
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..envs.grasp import GraspConfig, setup
from ..envs.simulators import Camera
from ..errors import InputError, input_errors
from ..files import require_new
from ..pictures import render
from ..terminal import flags
from ..terminal.console import console, progress
from .grasps import require_grasp
from .scene import layout_notes, read_scene

ABOUT = """\
Draw a scripted grasp with its taxels, film a trained run, or watch it (extra: render).

examples:
  tactilerl render --env shadow --layout 1
  tactilerl render runs/X --video film.mp4
  tactilerl render runs/X"""
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")


@dataclass(frozen=True)
class RenderFlags:
    """Flags of `tactilerl render`, besides the scene's."""

    run: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folder whose policy plays in the run's own scene. Two runs are filmed side by side, from the
    same initial states. Without a run, a scripted grasp is drawn."""
    video: Path | None = None
    """File of the film; default: none where there is a display, which shows the run instead;
    episodes.mp4 elsewhere, and of two runs."""
    episodes: Annotated[int, "[1, inf)"] = 3
    """Number of episodes: the first ones that `evaluate` plays. Hold tests last 2 s unless
    --hold-seconds is given."""
    env: str = "shadow"
    """The hand in the picture."""
    out: Path = Path("grasp.png")
    """File of the picture."""
    overwrite: bool = False
    """Replace a picture or film that is there."""
    pose: Literal["start", "grasp"] = "grasp"
    """Pose in the picture: the start of an episode, or a scripted grasp."""
    azimuth: Annotated[float, "[-360, 360]"] = Camera.azimuth
    """Direction of the camera, degrees; 300 looks at the palm."""
    elevation: Annotated[float, "[-360, 360]"] = Camera.elevation
    """Elevation of the camera, degrees; positive looks up from below."""
    distance: Annotated[float, "[0.05, 10]"] = Camera.distance
    """Distance of the camera, m."""

    @property
    def camera(self) -> Camera:
        """The camera that these flags place."""
        return Camera(self.azimuth, self.elevation, self.distance)


def main(args: list[str]) -> int:
    """Run `tactilerl render` (a scripted grasp with its taxels) or `tactilerl render RUN` (a run)."""
    read, scene = read_scene(RenderFlags, args, "tactilerl render", ABOUT)
    for flag in ("env", "out", "pose") if read.run else ("video", "episodes"):
        if getattr(read, flag) != getattr(RenderFlags, flag):
            needed = "without" if read.run else "with"
            raise InputError(f"{flag}: allowed only {needed} a run folder")
    if len(read.run) > 2:
        raise InputError(
            f"render: found {len(read.run)} runs, allowed one, or two side by side"
        )
    if read.run:
        given = flags.peek(args, "hold-seconds", "hold_seconds")
        hold_seconds = _hold_seconds(read, scene, bool(given["hold_seconds"]))
        has_screen = sys.platform != "linux" or any(map(os.environ.get, SCREENS))
        if read.video is None and len(read.run) == 1 and has_screen:
            _watch(read.run[0], read.episodes, hold_seconds)
        else:
            _film(read, hold_seconds)
        return 0
    require_new(read.out, read.overwrite)
    with input_errors():
        notes = layout_notes(read.env, scene.layout)
        if read.pose == "grasp":
            require_grasp(read.env, scene)
        lit = render.picture(read.env, scene, read.pose, read.camera, read.out)
    console.print(f"{read.out}: {lit} taxels fire")
    for note in notes:
        console.print(note)
    return 0


def _hold_seconds(read: RenderFlags, scene: GraspConfig, is_given: bool) -> float:
    """Return the length of hold tests, s; a run keeps everything else of its scene."""
    usual = setup(read.env)
    if replace(scene, hold_seconds=usual.hold_seconds) != usual:
        raise InputError(
            "render RUN: found scene flags, allowed only --hold-seconds: a run keeps its scene"
        )
    return scene.hold_seconds if is_given else render.HOLD_SECONDS


def _watch(folder: Path, episodes: int, hold_seconds: float) -> None:
    """Play a run's policy in a window."""
    with input_errors():
        env, play = render.staged(folder, hold_seconds, "human")
        with closing(env):
            for number in range(episodes):
                verdict = "success" if play(number) else "no success"
                console.print(f"{folder}: {verdict}")


def _film(read: RenderFlags, hold_seconds: float) -> None:
    video = read.video or Path("episodes.mp4")
    require_new(video, read.overwrite)
    with input_errors(), progress("pictures") as tick:
        for successes in render.film(
            read.run, read.episodes, hold_seconds, read.camera, video, tick
        ):
            verdicts = ", ".join("success" if it else "no success" for it in successes)
            console.print(f"{video}: {verdicts} (hold tests of {hold_seconds:g} s)")
