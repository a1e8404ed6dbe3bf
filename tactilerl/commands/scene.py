"""Flags of a command together with those of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

from .. import flags
from ..envs.grasp import GraspConfig, setup
from ..envs.hands import HANDS
from ..errors import InputError

T = TypeVar("T")


def read_scene(kind: type[T], args: Sequence[str], env: str, prog: str) -> tuple[T, GraspConfig | None]:
    """The command's own flags, and the scene's where `env` has a scene."""
    parts: dict[str, Any] = {"command": kind()}
    if env in HANDS:
        parts["scene"] = setup(env)
    options = dataclasses.make_dataclass("Options", [(name, type(it)) for name, it in parts.items()])
    read: Any = flags.parse(options, args, prog, options(**parts))
    return read.command, getattr(read, "scene", None)


def require_scene(scene: GraspConfig | None, env: str) -> GraspConfig:
    """The scene; InputError where `env` has none."""
    if scene is None:
        raise InputError(f"--env: found {env!r}, allowed: {', '.join(HANDS)}")
    return scene
