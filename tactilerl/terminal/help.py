"""What a command is for, as its help begins."""

from __future__ import annotations

from typing import NamedTuple


class About(NamedTuple):
    """The text of a command's help, and commands to try."""

    text: str = ""
    first: tuple[str, ...] = ()
    examples: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n  ".join([self.text + "\n\nexamples:", *self.examples])
