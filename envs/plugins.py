"""Modules that add tasks, touch rules or hands of their own: `--import MODULE`.

A module adds to `tasks.TASKS`, `touch.RULES` or `hands.OTHERS` when it is imported.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module

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
    """Let modules be found in the current folder too, as by `python -m`."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def require_class(known: Mapping[str, type], name: str, field: str) -> None:
    """Raise ValueError for a field that names no known class, or one that lacks methods."""
    if name not in known:
        allowed = f"{', '.join(known)}, or what a module adds (--import MODULE)"
        raise ValueError(f"{field}: found {name!r}, allowed: {allowed}")
    kind = known[name]
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        raise ValueError(
            f"{field}: {name!r} ({kind.__name__}) lacks {', '.join(missing)}"
        )
