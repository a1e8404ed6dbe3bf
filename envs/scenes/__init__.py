"""Named scenes: choices of hand, simulator, task and senses that belong together, and who learns there.

Each is a TOML file here, or anybody's own, that says why it chose what it chose. With
`base` it says only what differs from another scene of the library. `scaled` names the
lengths that are meant for the scene's own hand: on another they grow with its fingers.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import hands, validation
from ..objects import scaled
from ..validation import require_one_of

FOLDER = Path(__file__).parent
SUFFIX = ".toml"
LENGTHS = {"object_size", "start_offset", "handover_reach"}
"""Fields that may be relative to the length of fingers."""


@dataclass(frozen=True)
class NamedScene:
    """Content of a scene's file."""

    about: str = ""
    """One sentence for people."""
    env: str = "shadow"
    """The hand."""
    scene: dict[str, Any] = field(default_factory=dict)
    """Fields of `grasp.GraspConfig`."""
    train: dict[str, Any] = field(default_factory=dict)
    """Flags of ``tactilerl train``: learner, recipe, hyperparameters, length; in a
    table by the name of another learner, those for that one."""
    scaled: tuple[str, ...] = ()
    """Fields of `scene` that are lengths relative to the fingers of `env`."""
    base: str = ""
    """The scene of the library that it says the differences from."""

    def on(self, hand: str) -> dict[str, Any]:
        """Return `scene` for a hand, with the lengths of `scaled` in m for its fingers."""
        if hand == self.env or not self.scaled:
            return self.scene
        factor = hands.get(hand).finger_length / hands.get(self.env).finger_length
        lengths = {name: scaled(self.scene[name], factor) for name in self.scaled}
        return self.scene | lengths


def names() -> tuple[str, ...]:
    """Return the names of the library's scenes."""
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}")))


def gymnasium_id(name: str) -> str:
    """Return the Gymnasium id of a named scene: dark_mpl is tactilerl/DarkMpl-v0."""
    return f"tactilerl/{''.join(word.capitalize() for word in name.split('_'))}-v0"


def load(name: str | Path) -> NamedScene:
    """Return a scene by name, or from a .toml file.

    Raise ValueError naming what is wrong, and FileNotFoundError.
    """
    path = Path(validation.require_type(name, str | Path, "scene"))
    if path.suffix != SUFFIX:
        require_one_of([*names(), f"NAME{SUFFIX}"], str(name), "scene")
        path = FOLDER / f"{name}{SUFFIX}"
    data = validation.read(path, "scene file")
    with validation.blamed(f"scene file {path}"):
        base = NamedScene()
        if "base" in data:
            require_one_of(names(), data["base"], "base")
            base = load(data["base"])
        named = validation.fill(NamedScene, {**vars(base), **data})
        scene = {**base.on(named.env), **data.get("scene", {})}
        for length in named.scaled:
            require_one_of(sorted(LENGTHS & scene.keys()), length, "scaled")
    train = _merged(base.train, data.get("train", {}))
    return dataclasses.replace(named, scene=scene, train=train)


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return flags of training on top of those of a base; of another learner, its table's."""
    tables = {name: x for name, x in base.items() if isinstance(x, dict)}
    if own.get("algo", base.get("algo")) != base.get("algo"):
        flags = tables.pop(str(own["algo"]), {})
        base = {**tables, **flags}
    merged = {**base, **own}
    for name, table in tables.items():
        if isinstance(merged[name], dict):
            merged[name] = {**table, **merged[name]}
    return merged
