"""Names that somebody chose."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from typing import Any

Aliases = Mapping[str, tuple[str, str]]
"""What others call a choice -> what is nearest to it here (names with spaces between), and why."""
NONE: Aliases = {}


def require_known(
    names: Iterable[str], known: Iterable[str], aliases: Aliases = NONE
) -> None:
    """ValueError naming the first of `names` that is not known, what may have been meant, and all that
    are known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            likely, why = meant(name, known, aliases)
            hint = f"did you mean {' or '.join(likely)}? " if likely else ""
            reason = f"({why}) " if why else ""
            raise ValueError(
                f"{name}: unknown; {hint}{reason}allowed: {', '.join(known)}"
            )


def require_one_of(known: Iterable[str], value: Any, where: str) -> None:
    """ValueError where a value is none of those that are known."""
    if value not in (known := list(known)):
        raise ValueError(f"{where}: found {value!r}, allowed: {', '.join(known)}")


def meant(
    name: str, known: Collection[str], aliases: Aliases = NONE
) -> tuple[list[str], str]:
    """Those of `known` that somebody may have meant by `name`, and how they differ from it."""
    peers, why = aliases.get(name, ("", ""))
    likely = [own for own in peers.split() if own in known]
    if likely or (name in aliases and not peers):
        return likely, why
    longer = [own for own in known if own.startswith(name)] if len(name) > 2 else []
    return longer[:1] or difflib.get_close_matches(
        name.lower(), known, 1, cutoff=0.7
    ), ""


def nearest(name: str, known: Iterable[str]) -> str:
    """A question for whoever mistyped one of `known`, or nothing."""
    likely, _ = meant(name, list(known))
    return f"did you mean {likely[0]}? " if likely else ""
