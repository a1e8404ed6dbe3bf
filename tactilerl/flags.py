"""Dataclasses to flags, by tyro; its boxed errors become one line."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from .errors import InputError

T = TypeVar("T")


def parse(kind: type[T], args: Sequence[str], prog: str, default: Any = None, about: str = "") -> T:
    """Read `args` into a dataclass; InputError over bad flags, SystemExit(0) after --help."""
    output = io.StringIO()
    extra = {} if default is None else {"default": default}
    config = (tyro.conf.OmitArgPrefixes,)
    try:
        with contextlib.redirect_stderr(output):
            return tyro.cli(kind, args=args, prog=prog, description=about, config=config, **extra)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise InputError(_one_line(output.getvalue())) from None


def peek(args: Sequence[str], flag: str, default: str) -> str:
    """The value of one flag before all are known: it decides which others there are.

    As for every flag, the last one counts.
    """
    found = [args[i + 1] for i, arg in enumerate(args[:-1]) if arg == flag]
    found += [arg.partition("=")[2] for arg in args if arg.startswith(flag + "=")]
    if "" in found:
        raise InputError(f"{flag}: found nothing, expected a value")
    return found[-1] if found else default


def _one_line(boxed: str) -> str:
    """The message of tyro's box: the text above its first rule."""
    lines = [re.sub(r"[│╭╮╰╯]", " ", line).strip() for line in boxed.splitlines()]
    message: list[str] = []
    for line in lines[1:]:
        if line and not line.strip("─"):
            break
        message.append(line)
    return " ".join(" ".join(message).split()) or "bad flags; see --help"
