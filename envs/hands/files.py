"""The files of hands: where the library's are, what they are called, and whether they have changed."""

from __future__ import annotations

import hashlib
from pathlib import Path

FOLDER, SUFFIX = Path(__file__).parent, ".toml"
KEPT = ".grasp.toml"
"""In place of SUFFIX: where a command keeps a grasp that it has found for a file without one."""


def short_digest(*files: Path) -> str:
    """Of what is in them."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[
        :16
    ]
