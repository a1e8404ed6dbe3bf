"""Flags of a command together with those of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

from ..envs import hands, layouts, scenes
from ..envs.grasp import GraspConfig, setup
from ..errors import InputError, input_errors
from ..pictures import hand_map
from ..runs.arguments import NAMED_SCENE, hands_named
from ..terminal import flags
from ..terminal.help import About

T = TypeVar("T")


def read_scene(
    kind: type[T], args: Sequence[str], prog: str, about: About
) -> tuple[T, GraspConfig | None]:
    """The command's own flags, and the scene's where its environment has a scene. --help shows the
    first, and of the scene's those that `about` names."""
    own = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    about = about._replace(first=("named_scene", "env", *about.first, *own))
    with input_errors():
        name = flags.peek(args, "--scene", "")
        named = scenes.load(name) if name else None
    command: Any = kind()
    env = flags.peek(args, "--env", named.env if named else command.env)
    if named and not hands.is_hand(env):
        raise InputError(f"--env: found {env!r} with --scene, allowed: {hands.allowed()}")
    parts: dict[str, Any] = {"command": dataclasses.replace(command, env=env)}
    if hands.is_hand(env):
        with input_errors(f"scene {name}" if named else ""):
            parts["scene"] = setup(env, **(named.scene if named else {}))
    kinds = [(name, type(it)) for name, it in parts.items()]
    options = dataclasses.make_dataclass("Options", [*kinds, NAMED_SCENE])
    with hands_named(env):
        read: Any = flags.parse(options, args, prog, options(**parts), about)
    return read.command, getattr(read, "scene", None)


def require_scene(scene: GraspConfig | None, env: str) -> GraspConfig:
    """The scene; InputError where `env` has none."""
    if scene is None:
        raise InputError(f"--env: found {env!r}, allowed: {hands.allowed()}")
    return scene


def layout_notes(name: str, layout: str) -> list[str]:
    """What to know about a layout on a hand: where it wants taxels and the hand has no surface, and
    which of its taxels lie beyond theirs."""
    wanted, hand = layouts.load(layout), hands.get(name)
    notes = []
    if missing := layouts.left_out(wanted, hand):
        notes.append(f"layout {layout}: no taxels at {', '.join(missing)}, which {name} does not have")
    if beyond := hand_map.beyond(hand, wanted.place(hand)):
        notes.append(f"layout {layout}: beyond the end of their segment: {', '.join(beyond)}")
    if off := hand_map.off_skin(hand, wanted.place(hand)):
        notes.append(
            f"layout {layout}: further from the skin of their link than they reach: {', '.join(off)}"
        )
    return notes
