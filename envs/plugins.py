"""Tasks, touch rules and hands of other packages.

A package that is installed lists its own as entry points, in the groups `tactilerl.tasks`,
`tactilerl.sensors` and `tactilerl.hands`; one is imported when somebody asks for its name. Any other
module is imported by name, and adds its own to `tasks.TASKS`, `touch.RULES` or `hands.OTHERS`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

imported: list[str] = []
"""Modules that this process was asked to import; those that it starts import them too."""


def import_modules(names: Iterable[str]) -> None:
    """Import modules, from the current folder too; ValueError where one cannot be."""
    look_here()
    for name in names:
        try:
            import_module(name)
        except (Exception, SystemExit) as error:  # anything may happen in it
            reason = f"{type(error).__name__}: {error}"
            raise ValueError(
                f"import: found {name!r}, which cannot be imported ({reason})"
            ) from error
        if name not in imported:
            imported.append(name)


def look_here() -> None:
    """Modules are found in the current folder too, as by `python -m`."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def find(
    group: str,
    known: dict[str, Any],
    name: str,
    fits: Callable[[Any], bool],
    allowed: str,
) -> Any:
    """What is called `name` among those that are `known`, or else in an installed package; None where
    there is none. ValueError where it cannot be imported, or does not fit."""
    found = known.get(name)
    if found is None:
        if (point := _points(group).get(name)) is None:
            return None
        try:
            found = point.load()
        except (Exception, SystemExit) as error:
            reason = (
                f"{point.value} cannot be imported ({type(error).__name__}: {error})"
            )
            raise ValueError(f"{group}: found {name!r}, but {reason}") from error
    if not fits(found):
        raise ValueError(f"{group}: {name!r}: found {found!r:.80}, allowed {allowed}")
    known[name] = found
    return found


def require_class(
    group: str, known: dict[str, Any], base: Any, name: str, field: str
) -> None:
    """ValueError for a field that names no class derived from `base`, known or installed, or one that
    lacks methods."""

    def fits(found: Any) -> bool:
        return base in getattr(found, "__mro__", ())

    found = find(group, known, name, fits, f"a class derived from {base.__name__}")
    if found is None:
        allowed = ", ".join(names(group, known))
        more = "or what a module adds (--import MODULE)"
        raise ValueError(f"{field}: found {name!r}, allowed: {allowed}, {more}")
    if missing := sorted(getattr(found, "__abstractmethods__", ())):
        raise ValueError(
            f"{field}: {name!r} ({found.__name__}) lacks {', '.join(missing)}"
        )


def names(group: str, known: Iterable[str]) -> list[str]:
    """Those that are known or installed."""
    return list(dict.fromkeys([*known, *_points(group)]))


@cache
def _points(group: str) -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=f"tactilerl.{group}")}
