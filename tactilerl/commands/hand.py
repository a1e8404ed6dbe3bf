"""`tactilerl hand MODEL`: a hand's file from its model, with a grasp, ready to train."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from ..envs import hands
from ..envs.grasp import setup
from ..envs.hands import guess, sandbox
from ..errors import InputError, input_errors
from ..files import pasted, replacing, require_new
from ..terminal import flags
from ..terminal.console import console
from .grasps import draw, find_grasp

ABOUT = """\
Write the file of a hand from its model, MJCF or URDF: what its parts are, its open and closed
pose, and a grasp. Everything can be changed in the file afterwards.

examples:
  tactilerl hand robot.urdf --out my_hand.toml
  tactilerl hand leap_hand/right_hand.xml --out leap.toml"""
MARK = "# Written by `tactilerl hand`: change what is wrong; docs/guides/own_hand.md has all keys.\n"


@dataclass(frozen=True)
class HandFlags:
    """Flags of `tactilerl hand`."""

    model: tyro.conf.Positional[str] = ""
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
    """`tactilerl hand MODEL`: exit 1 when no grasp was found."""
    read = flags.parse(HandFlags, args, "tactilerl hand", ABOUT)
    if not read.model:
        raise InputError("MODEL: found none, expected the path of an MJCF or URDF file")
    if read.out.suffix != hands.SUFFIX:
        raise InputError(
            f"--out: found {read.out.name!r}, allowed names that end in {hands.SUFFIX}"
        )
    require_new(read.out, read.overwrite)
    with input_errors():
        _write(read)
        _say_what_was_guessed(read.out)
        hand = hands.get(str(read.out))
        n_actuators = len(hand.actuators) - len(hands.SLIDES)
        console.print(f"  closing: {len(hand.closed)} of {n_actuators} actuators")
        for note in hand.notes:
            console.print(f"  note: {note}")
        scene = setup(str(read.out), layout="1")
        found = find_grasp(str(read.out), scene, read.overwrite)
    if found is not None:
        text = f"\n{found.toml()}\n"
        _save(read.out, read.out.read_bytes() + text.encode())
    pose: Literal["start", "grasp"] = "start" if found is None else "grasp"
    what, picture = f"the {pose}, and the hand unrolled", read.out.with_suffix(".png")
    draw(console, what, str(read.out), scene, pose, picture, read.overwrite)
    if found is None:
        return 1
    name = pasted(read.out)
    train = f"tactilerl train --env {name} --recipe steady --total-timesteps 15000"
    console.print(f"next: tactilerl env --env {name} --check    {train}")
    return 0


def _write(read: HandFlags) -> None:
    """Write the file; once more with other servos, where the model's own do not do."""
    said: dict[str, Any] = {"palm": read.palm} if read.palm else {}
    said |= {"drop": list(read.drop)} if read.drop else {}
    model = read.model
    if ":" not in model:
        path = Path(model).parent.resolve() / Path(model).name
        model = os.path.relpath(path, read.out.parent.resolve())
    notes = _written(read.out, model, said)
    try:
        bad = _servos_fail(read.out)
    except ValueError:
        _say_what_was_guessed(read.out)
        raise
    if bad:
        notes = _written(read.out, model, {**said, "servos": "library"})
        notes.append(f"{bad}: the joints get the library's servos")
    for note in notes:
        console.print(f"note: {note}")


def _written(path: Path, model: str, said: dict[str, Any]) -> list[str]:
    """Write the file once; return notes on what was guessed."""
    folder = path.parent.absolute()
    text, notes = sandbox.call(guess.describe, model, folder, said)
    _save(path, (MARK + text).encode())
    return notes


def _save(path: Path, content: bytes) -> None:
    with replacing(path) as file:
        file.write(content)


def _servos_fail(path: Path) -> str:
    """Return how the model's own servos fail, "" where they do not."""
    try:
        notes = hands.get(str(path)).notes
        weak = [note.partition(";")[0] for note in notes if "weak or slow" in note]
        return (*weak, "")[0]
    except ValueError as error:
        if "hang still" not in str(error):
            raise
        return str(error).rpartition("model: ")[2].partition(";")[0]


def _say_what_was_guessed(path: Path) -> None:
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    console.print(f"{path}: guessed; correct it in the file:")
    for key in ("palm", "palmar", "fingers"):
        console.print(f"  {key}: {data[key]}")
    for name, about in data["digits"].items():
        console.print(f"  digits.{name}: {', '.join(about['links'])}")
