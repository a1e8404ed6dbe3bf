"""`tactilerl render`: a picture of a scripted grasp, or a film of a trained run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..envs.simulators import Camera
from ..errors import InputError, input_errors
from ..files import require_new
from ..pictures import render
from ..terminal import flags
from ..terminal.console import console
from .scene import SceneFlag, layout_notes, read_scene, require_grasp

ABOUT = """\
Draw a scripted grasp with its taxels, or film a trained run (extra: render).

examples:
  tactilerl render --env shadow --layout 1
  tactilerl render runs/X --video film.mp4
  tactilerl render runs/X --episode 17"""
RUN_FLAGS = "video", "episodes", "episode"
VERDICTS = {True: "success", False: "no success"}


@dataclass(frozen=True)
class RenderFlags:
    """Flags of `tactilerl render`, besides the scene's."""

    run: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folder whose policy plays in the run's own scene. Several are filmed side by
    side, from the same initial states. Without a run, a scripted grasp is drawn."""
    video: Path = Path("episodes.mp4")
    """File of the film."""
    episodes: Annotated[int, "[1, inf)"] = 3
    """Number of episodes: the first ones that `evaluate` plays, with hold tests
    of 2 s."""
    episode: Annotated[int, "[0, inf)"] | None = None
    """Only this episode, by its number in `evaluate RUN --json`, as that plays it: with
    the whole hold test."""
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


def main(args: list[str]) -> int:
    """Run `tactilerl render` (a scripted grasp with its taxels) or `tactilerl render RUN` (a run)."""
    read, scene = read_scene(RenderFlags, args, "tactilerl render", ABOUT)
    camera = Camera(read.azimuth, read.elevation)
    given = flags.given(read, args)
    for flag in ("env", "out", "pose") if read.run else RUN_FLAGS:
        if flag in given:
            needed = "without" if read.run else "with"
            raise InputError(f"{flag}: allowed only {needed} a run folder")
    if {"episode", "episodes"} <= given.keys():
        raise InputError("episode and episodes: found both, allowed one of them")
    if read.run:
        if flags.given(scene, args) or flags.given(SceneFlag(), args):
            raise InputError("render RUN: found scene flags, but a run keeps its scene")
        with input_errors():
            _film(read, camera)
        return 0
    require_new(read.out, read.overwrite, ".png")
    with input_errors():
        notes = layout_notes(read.env, scene.layout)
        if read.pose == "grasp":
            require_grasp(read.env, scene)
        lit = render.picture(read.env, scene, read.pose, camera, read.out)
    console.print(f"{read.out}: {lit} taxels fire")
    for note in notes:
        console.print(note)
    return 0


def _film(read: RenderFlags, camera: Camera) -> None:
    """Film the runs' first episodes with short hold tests, or one episode as it is."""
    require_new(read.video, read.overwrite, ".mp4")
    seconds = render.HOLD_SECONDS if read.episode is None else None
    numbers = range(read.episodes) if read.episode is None else [read.episode]
    tests = f" (hold tests of {seconds:g} s)" if seconds else ""
    for each in render.film(read.run, numbers, seconds, camera, read.video):
        verdicts = ", ".join(VERDICTS[success] for success in each)
        console.print(f"{read.video}: {verdicts}{tests}")
