"""Named scenes: choices of hand, simulator, task and senses that belong together, and who learns there.

Each is a TOML file here, or anybody's own, that says why it chose what it chose. With `base` it says
only what differs from another scene of the library.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import toml_files
from ..choices import nearest, require_one_of

FOLDER = Path(__file__).parent
SUFFIX = ".toml"


@dataclass(frozen=True)
class NamedScene:
    """What a scene's file says."""

    about: str = ""
    """One sentence for people."""
    env: str = "shadow"
    """The hand."""
    scene: dict[str, Any] = field(default_factory=dict)
    """Fields of `grasp.GraspConfig`."""
    train: dict[str, Any] = field(default_factory=dict)
    """Flags of ``tactilerl train``: learner, recipe, hyperparameters, length."""


def names() -> tuple[str, ...]:
    """Scenes that can be asked for by name."""
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}")))


def gymnasium_id(name: str) -> str:
    """Of a named scene: dark_mpl is tactilerl/DarkMpl-v0."""
    return f"tactilerl/{''.join(word.capitalize() for word in name.split('_'))}-v0"


def load(name: str) -> NamedScene:
    """A scene by name, or from a .toml file; ValueError naming what is wrong, and FileNotFoundError."""
    if not name.endswith(SUFFIX) and name not in names():
        raise ValueError(
            f"scene: found {name!r}, {nearest(name, names())}allowed: {', '.join(names())}, or the "
            "path of a .toml file"
        )
    path = Path(name) if name.endswith(SUFFIX) else FOLDER / f"{name}{SUFFIX}"
    data = toml_files.read(path, "scene file")
    kinds = {"about": str, "base": str, "env": str, "scene": dict, "train": dict}
    toml_files.only(data, set(kinds), f"scene file {path}")
    base = NamedScene()
    for key, value in data.items():
        if not isinstance(value, kinds[key]):
            allowed = f"a {kinds[key].__name__}"
            raise ValueError(f"scene file {path}: {key}: found {value!r}, allowed {allowed}")
        if key == "base":
            require_one_of(names(), value, f"scene file {path}: base")
            base = load(value)
    both = {key: {**getattr(base, key), **data.get(key, {})} for key in ("scene", "train")}
    return NamedScene(data.get("about", base.about), data.get("env", base.env), **both)
