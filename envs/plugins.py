"""Modules that add tasks, touch rules or hands of their own: `--import MODULE`.

A module adds to `tasks.TASKS`, `touch.RULES` or `hands.OTHERS` when it is imported.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any

import numpy as np

imported: list[str] = []
"""Modules that this process was asked to import; those that it starts import them
too."""


def import_modules(names: Iterable[str]) -> None:
    """Import modules, from the current folder too; ValueError where one cannot be."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # as by `python -m`
    for name in names:
        try:
            import_module(name)
        except (Exception, SystemExit) as error:  # anything may happen in it
            raise ValueError(
                f"import: found {name!r}, which cannot be imported ({type(error).__name__}: {error})"
            ) from error
        if name not in imported:
            imported.append(name)


def require_class(
    known: Mapping[str, Any], name: str, field: str, base: type[Any]
) -> Any:
    """Return the class that a field names.

    Raises ValueError where it is not known, no subclass of `base`, or lacks methods of
    it.
    """
    if name not in known:
        raise ValueError(
            f"{field}: found {name!r}, allowed: {', '.join(known)}, or what a module adds (--import "
            "MODULE)"
        )
    kind = known[name]
    where = f"{field}: {name!r} ({getattr(kind, '__name__', kind)})"
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise ValueError(f"{where}: found no subclass of {base.__name__}")
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        raise ValueError(f"{where} lacks {', '.join(missing)}")
    return kind


def require_array(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Return what a module's class returned as an array.

    Raise ValueError, which says `where`, when it is no array of numbers of this shape.
    """
    if np.shape(value) != shape or np.asarray(value).dtype.kind not in "bifu":
        is_array = isinstance(value, np.ndarray)
        found = f"an array {value.shape}" if is_array else repr(value)[:50]
        raise ValueError(f"{where}: found {found}, allowed numbers of shape {shape}")
    return np.asarray(value)


def module_of(error: BaseException | None) -> str:
    """Return the imported module whose code raised an error, or what led to it; "" without one."""
    packages = {module.partition(".")[0] for module in imported}
    while error is not None:
        for frame, _ in traceback.walk_tb(error.__traceback__):
            name = str(frame.f_globals.get("__name__")).partition(".")[0]
            if name in packages:
                return name
        error = error.__cause__
    return ""
