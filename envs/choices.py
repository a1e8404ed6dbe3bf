"""Names that somebody chose."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def require_known(names: Iterable[str], known: Iterable[str]) -> None:
    """ValueError naming the first of `names` that is not known, what may have been meant, and all that
    are known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            likely = difflib.get_close_matches(name, known, 1)
            meant = f"did you mean {likely[0]}? " if likely else ""
            raise ValueError(f"{name}: unknown; {meant}allowed: {', '.join(known)}")
