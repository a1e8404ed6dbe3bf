"""Flags of a command together with those of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

from ..envs import hands, layouts, scenes, validation
from ..envs.grasp import GraspConfig, setup
from ..envs.scenes import NamedScene
from ..errors import InputError, input_errors
from ..pictures import hand_map
from ..runs.arguments import NAMED_SCENE, read_parts
from ..terminal import flags
from ..terminal.help import About

T = TypeVar("T")


def read_any(
    kind: type[T], args: Sequence[str], prog: str, about: About
) -> tuple[T, GraspConfig | None]:
    """The command's own flags, and the scene's where its environment has a scene. --help shows the
    first, and of the scene's those that `about` names."""
    command: Any = kind()
    about = about._replace(first=("scene", "env", *about.first, *vars(command)))
    with input_errors():
        name = flags.peek(args, "--scene")
        named = scenes.load(name) if name else NamedScene(env=command.env)
    env = flags.peek(args, "--env", named.env)
    if name and not hands.is_hand(env):
        raise InputError(
            f"--env: found {env!r} with --scene, allowed: {hands.allowed()}"
        )
    parts: dict[str, Any] = {"command": dataclasses.replace(command, env=env)}
    if hands.is_hand(env):
        with input_errors(f"scene {name}" if name else ""):
            parts["scene"] = setup(env, **named.on(env))
            validation.validate(parts["scene"])  # before tyro reads it as the defaults
    read = read_parts(env, parts, args, prog, about, NAMED_SCENE)
    return read.command_part, getattr(read, "scene_part", None)


def read_scene(
    kind: type[T], args: Sequence[str], prog: str, about: About
) -> tuple[T, GraspConfig]:
    """The same; InputError where the environment has no scene."""
    read, scene = read_any(kind, args, prog, about)
    if scene is None:
        raise InputError(
            f"--env: found {vars(read)['env']!r}, allowed: {hands.allowed()}"
        )
    return read, scene


def layout_notes(name: str, layout: str) -> list[str]:
    """What to know about a layout on a hand: where it wants taxels and the hand has no surface, and
    which of its taxels lie beyond theirs."""
    wanted, hand = layouts.load(layout), hands.get(name)
    placed = wanted.place(hand)
    found = {
        "no taxels at {}, which " + name + " does not have": layouts.left_out(
            wanted, hand
        ),
        "beyond the end of their segment: {}": hand_map.beyond(hand, placed),
        "further from the skin of their link than they reach: {}": hand_map.off_skin(
            hand, placed
        ),
    }
    short = layouts.short(layout)
    notes = [
        f"layout {short}: {text.format(', '.join(it))}"
        for text, it in found.items()
        if it
    ]
    return [*hand.notes, *notes]
