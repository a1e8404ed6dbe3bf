"""Names that somebody chose."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence

Aliases = Mapping[str, Sequence[str]]
"""What others call a choice -> what is nearest to it here."""


def require_known(names: Iterable[str], known: Iterable[str], aliases: Aliases | None = None) -> None:
    """ValueError naming the first of `names` that is not known, what may have been meant, and all that
    are known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            likely = " or ".join(meant(name, known, aliases))
            hint = f"did you mean {likely}? " if likely else ""
            raise ValueError(f"{name}: unknown; {hint}allowed: {', '.join(known)}")


def meant(name: str, known: Collection[str], aliases: Aliases | None = None) -> list[str]:
    """Those of `known` that somebody may have meant by `name`."""
    by_alias = [own for own in (aliases or {}).get(name, []) if own in known]
    return by_alias or difflib.get_close_matches(name, known, 1, cutoff=0.7)
