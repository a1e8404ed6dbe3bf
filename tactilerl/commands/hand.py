"""`tactilerl hand MODEL`: a hand's file from its model, with a grasp, ready to train."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from .. import import_hand
from ..envs import hands
from ..envs.grasp import setup
from ..envs.simulators import Camera
from ..errors import InputError, input_errors
from ..files import kept, pasted, replacing, require_new
from ..pictures import render
from ..terminal import flags
from ..terminal.console import console
from .scene import find_grasp

ABOUT = """\
Write the file of a hand from its model, MJCF or URDF: what its parts are, its open and closed
pose, and a grasp. Everything can be changed in the file afterwards.

examples:
  tactilerl hand robot.urdf --out my_hand.toml
  tactilerl hand leap_hand/right_hand.xml --out leap.toml"""
HEADER = "# Written by `tactilerl hand`: change what is wrong; docs/guides/own_hand.md has all keys.\n"


@dataclass(frozen=True)
class HandFlags:
    """Flags of `tactilerl hand`."""

    model: tyro.conf.Positional[str]
    """Path of an MJCF or URDF file, or package:path in an installed package."""
    out: Path = Path("my_hand.toml")
    """The file to write. A picture of the hand is written beside it (extra: render)."""
    overwrite: bool = False
    """Replace the file and the picture where they are there."""
    palm: str = ""
    """The palm's body; default: the one from which most digits branch."""
    drop: tuple[str, ...] = ()
    """Name patterns of bodies, geoms, tendons, actuators and sites to leave out."""


def main(args: list[str]) -> int:
    """Run `tactilerl hand MODEL`; exit 1 when no grasp was found."""
    choices = flags.parse(HandFlags, args, "tactilerl hand", ABOUT)
    out, name = choices.out, str(choices.out)
    require_new(out, choices.overwrite, hands.SUFFIX)
    with input_errors(), kept(out):
        _write(choices, {})
        if complaint := _servo_complaint(name):
            console.print(f"note: {complaint}: all joints get the library's servos")
            _write(choices, {"servos": "library"})
        hand = hands.get(name)
        n_actuators = len(hand.actuators) - len(hands.SLIDES)
        console.print(f"  closing: {len(hand.closed)} of {n_actuators} actuators")
        for note in hand.notes:
            console.print(f"  note: {note}")
        scene = setup(name, layout="1")
        grasp = find_grasp(name, scene)
        if grasp is not None:
            with out.open("a", encoding="utf-8") as file:
                file.write(f"\n{grasp.toml()}\n")
    pose: render.Pose = "start" if grasp is None else "grasp"
    picture = out.with_suffix(".png")
    try:
        require_new(picture, choices.overwrite)
        render.picture(name, scene, pose, Camera(azimuth=300.0), picture)
        console.print(f"{picture}: the {pose}, and the hand unrolled")
    except (ImportError, OSError, InputError) as error:
        console.print(f"no picture: {error}")
    if grasp is None:
        return 1
    named = f"--env {pasted(out)}"
    console.print(
        f"next: tactilerl design {named} --sensor fsr --budget 100 --out my_layout.toml    "
        f"tactilerl gate --scene handover_anywhere {named} --layout my_layout.toml"
    )
    return 0


def _write(choices: HandFlags, known: dict[str, Any]) -> None:
    """Write the file, and print what was guessed."""
    model, folder = choices.model, choices.out.parent.resolve()
    if ":" not in model:
        path = Path(model).parent.resolve() / Path(model).name
        model = os.path.relpath(path, folder)
    known = {"palm": choices.palm, "drop": list(choices.drop), **known}
    text = import_hand.Guess(model, folder, known).toml()
    with replacing(choices.out) as file:
        file.write((HEADER + text).encode())
    console.print(f"{choices.out}: guessed; correct it in the file:")
    console.print(text.partition("\n\n[opened]")[0])


def _servo_complaint(name: str) -> str:
    """Return how the model's own servos fail, "" where they do not."""
    try:
        texts = hands.get(name).notes
    except ValueError as error:
        texts = (str(error),)
        if "hang still" not in texts[0]:
            raise
    failing = [text for text in texts if "hang still" in text or "weak or slow" in text]
    return failing[0].partition(";")[0] if failing else ""
