"""Dataclasses to flags, by tyro; what is wrong with them in one line."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import Field, fields, is_dataclass
from itertools import dropwhile, takewhile
from operator import not_
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import tyro

from ..envs import validation
from ..envs.validation import meant
from ..errors import PEERS, InputError, input_errors
from . import help
from .help import of_field as of_field

T = TypeVar("T")
POSITIONAL = {"folder", "run", "study"}
"""Fields that are written without a flag."""


def parse(
    kind: type[T],
    args: Sequence[str],
    prog: str,
    about: help.About,
    default: Any = None,
) -> T:
    """Read `args` into a dataclass; InputError over bad flags, SystemExit(0) after --help."""
    if help.SHORT & {*args} or help.ALL in args:
        help.show(kind, default, prog, about, everything=help.ALL in args)
    known = [field.name for field, _ in _fields(kind)]
    extra = {} if default is None else {"default": default}
    options: dict[str, Any] = {
        "config": (tyro.conf.OmitArgPrefixes,),
        "return_unknown_args": True,
    }
    try:
        with contextlib.redirect_stderr(io.StringIO()) as said:
            read, unknown = tyro.cli(kind, args=args, prog=prog, **options, **extra)
    except SystemExit as stop:
        if not stop.code:
            raise
        reason, names = (
            _reason(said.getvalue()),
            {name.replace("_", "-") for name in known},
        )
        given = [arg.partition("=")[0] for arg in args if arg.startswith("--")]
        wrong = [flag for flag in given if flag[2:].removeprefix("no-") not in names]
        if wrong and reason.startswith(
            "Missing"
        ):  # something else, that is, than what is wrong
            reason = f"found {wrong[0]!r}, {_hint(wrong[0], known)}"
        raise InputError(f"{reason}; see {prog} --help") from None
    if unknown:
        reason = f"found {unknown[0]!r}, {_hint(unknown[0], known)}"
        raise InputError(
            f"{reason}{' See' if reason.endswith('?') else '; see'} {prog} --help"
        )
    own = getattr(read, "command_part", read)
    if not hasattr(own, "validate"):  # what has, is validated with what it belongs to
        with input_errors():
            for name, hint in get_type_hints(type(own), include_extras=True).items():
                validation.require_type(getattr(own, name), hint, of_field(name))
    return read


CHOICE = re.compile(
    r"invalid choice ('.*') for argument '(--\S+)'\. Expected one of \((.*)\)\."
)
NUMBER = re.compile(
    r"Error parsing (--\S+): (.*\b(?:int|INT|float|FLOAT)\b.*?)('.*')(?:\]\.)?"
)
NUMBERS = re.compile(
    r"Error parsing (--\S+): Could not find valid parse for arguments: \[(.*)\]"
)
"""What tyro says of values of other types; any other list can be parsed."""


def peek(args: Sequence[str], flag: str, default: str = "") -> str:
    """The value of one flag before all are known: it decides which others there are.

    As for every flag, the last one counts.
    """
    found = _given(args, flag)
    if found[:1] == [""]:
        raise InputError(f"{flag}: found nothing, expected a value")
    return found[0] if found else default


def several(args: Sequence[str], flag: str) -> tuple[list[str], list[str]]:
    """The values of a flag that takes one elsewhere, and the arguments with the first of them alone."""
    values = _given(args, flag)
    if len(values) < 2:
        return values, list(args)
    is_flag = (arg.partition("=")[0].replace("_", "-") == flag for arg in args)
    last = max(i for i, found in enumerate(is_flag) if found)
    first = last + ("=" not in args[last])
    return values, [*args[: first + 1], *args[first + len(values) :]]


def _reason(said: str) -> str:
    """What tyro says is wrong, without its box and the flag's help, which follows."""
    lines = (line.strip(" │╭╮╰╯─|+") for line in said.splitlines()[1:])
    texts = (
        line if line.strip("-") else "" for line in lines
    )  # a rule is dashes in plain ASCII
    reason = " ".join(takewhile(bool, dropwhile(not_, texts))).replace(
        "command-part.", ""
    )
    if choice := CHOICE.fullmatch(reason):
        allowed = ", ".join(re.findall(r"'([^']*)'", choice[3]))
        return f"{choice[2]}: found {choice[1]}, allowed: {allowed}"
    if number := NUMBER.fullmatch(reason):
        allowed = "a number" if "float" in number[2].lower() else "a whole number"
        return f"{number[1]}: found {number[3]}, allowed {allowed}"
    if numbers := NUMBERS.fullmatch(reason):
        return f"{numbers[1]}: found {numbers[2]}, allowed numbers"
    return reason or "found flags that are not allowed"


def _hint(token: str, known: Sequence[str]) -> str:
    """What may have been meant by what is no flag."""
    if not token.startswith("-"):
        placed = _placed(token, known)
        return f"did you mean {placed}?" if placed else "which no flag takes"
    name = token.partition("=")[0].lstrip("-").replace("-", "_")
    no = "no_" if name.startswith("no_") and name not in PEERS else ""
    likely, why = meant(name.removeprefix(no), known, PEERS)
    own = " or ".join(_named(no + field) for field in likely)
    hint = f"did you mean {own}?" if own else "which is not a flag"
    return f"{hint} ({why})" if why else hint


def _named(field: str) -> str:
    """How it is written on the command line."""
    return (
        f"{field.upper()}, given without a flag"
        if field in POSITIONAL
        else of_field(field)
    )


def _placed(token: str, known: Sequence[str]) -> str:
    """A value that stands alone, after the flag that takes it; "" for none."""
    from ..algos import ALGORITHMS
    from ..envs import hands, scenes

    is_path = os.sep in token
    values = {"scene": scenes.names(), "env": hands.HANDS, "algo": ALGORITHMS}
    for flag, names in values.items():
        if flag in known and not is_path and (likely := meant(token, [*names])[0]):
            return f"--{flag} {likely[0]}"
    is_run = "resume" in known and (is_path or Path(token).is_dir())
    return f"--resume {token}" if is_run else ""


def _fields(kind: Any) -> Iterator[tuple[Field[Any], Any]]:
    """The fields of a dataclass and of those in it, with their types."""
    hints = get_type_hints(kind)
    for field in fields(kind):
        hint = hints[field.name]
        yield from _fields(hint) if is_dataclass(hint) else [(field, hint)]


def _given(args: Sequence[str], flag: str) -> list[str]:
    """The values that were given to a flag, the last time."""
    values: list[str] = []
    is_flags = False
    for arg in args:
        name, equals, value = arg.partition("=")
        if name.startswith("--"):
            is_flags = name.replace("_", "-") == flag
            values = [value] * bool(equals) if is_flags else values
        elif is_flags:
            values.append(arg)
    return values
