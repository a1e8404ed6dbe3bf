"""Dataclasses to flags, by tyro; what is wrong with them in one line."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import tyro

from ..envs import touch, typed
from ..envs.choices import meant
from ..envs.objects import Number
from ..errors import PEERS, SAME, InputError, input_errors
from . import help
from .help import of_field as of_field

T = TypeVar("T")
VALUES: dict[Any, str] = {
    Number: "a number, or a range such as 0.5..1",
    tuple[float, float]: "two numbers",
    tuple[float, ...]: "numbers",
    tuple[int, ...]: "whole numbers",
    float: "a number",
    int: "a whole number in digits, such as 50000",
    Path: "a path",
    str: "a name",
}


def parse(kind: type[T], args: Sequence[str], prog: str, about: help.About, default: Any = None) -> T:
    """Read `args` into a dataclass; InputError over bad flags, SystemExit(0) after --help."""
    if help.SHORT & {*args} or help.ALL in args:
        help.show(kind, default, prog, about, everything=help.ALL in args)
    known = [field.name for field, _ in _fields(kind)]
    args = _own(args, known)
    extra = {} if default is None else {"default": default}
    options: dict[str, Any] = {"config": (tyro.conf.OmitArgPrefixes,), "return_unknown_args": True}
    try:
        with contextlib.redirect_stderr(io.StringIO()) as said:
            read, unknown = tyro.cli(kind, args=args, prog=prog, **options, **extra)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(f"{_reason(said.getvalue(), args, kind)}; see {prog} --help") from None
    if unknown:
        reason = f"found {unknown[0]!r}, {_hint(unknown[0], known)}"
        raise InputError(f"{reason}{' See' if reason.endswith('?') else '; see'} {prog} --help")
    own = getattr(read, "command_part", read)
    if not hasattr(own, "validate"):  # what has, is validated with what it belongs to
        with input_errors():
            for name, hint in get_type_hints(type(own), include_extras=True).items():
                typed.require_type(getattr(own, name), hint, of_field(name))
    return read


def peek(args: Sequence[str], flag: str, default: str = "") -> str:
    """The value of one flag before all are known: it decides which others there are.

    As for every flag, the last one counts.
    """
    found = _given(args, flag)
    if found[:1] == [""]:
        raise InputError(f"{flag}: found nothing, expected a value")
    return found[0] if found else default


def _reason(said: str, args: Sequence[str], kind: Any) -> str:
    """What is wrong with a flag that tyro names, found and allowed; else what tyro says of it."""
    own = [*_fields(kind)]
    if n_missing := said.count("(required)"):
        required = [f.name for f, _ in own if f.default is f.default_factory is MISSING]
        return f"found no {required[-n_missing].upper()}"
    known = {field.name: hint for field, hint in own}
    lines = (line.strip(" │╭╮╰╯─") for line in said.splitlines())
    reason = " ".join(takewhile(bool, lines))  # the flag's help follows
    reason = " ".join(re.split(r"\s*-{5,}\s*", reason)[:2])  # a terminal without boxes has dashes
    if missing := re.search(r"Missing value for argument '(?:--|[\w-]+\.)([\w-]+)'", reason):
        name = missing[1].replace("-", "_")
        if name not in known:
            return f"--{missing[1]}: found no value, allowed a value"
        if f"--{missing[1]}" not in missing[0]:
            return f"found no {name.upper()}"
    for flag in re.findall(r"--[\w-]+", reason):
        if (name := flag[2:].replace("-", "_")) in known:
            found = " ".join(_given(args, flag))
            return f"{flag}: found {repr(found) if found else 'no value'}, {_allowed(known[name])}"
    return reason or "found flags that are not allowed"


def _allowed(hint: Any) -> str:
    """What a flag of this type takes."""
    if choices := typed.choices(hint):
        return f"allowed: {', '.join(choices)}"
    parts = list(typed.parts(hint))
    known = (text for kind, text in VALUES.items() if kind in parts)
    return f"allowed {next(known, typed.words(hint))}"


def _hint(token: str, known: Sequence[str]) -> str:
    """What may have been meant by what is no flag."""
    from ..algos import ALGORITHMS, get

    if not token.startswith("-"):
        placed = _placed(token, known)
        return f"did you mean {placed}?" if placed else "which no flag takes"
    name = token.partition("=")[0].lstrip("-").replace("-", "_")
    no = "no_" if name.startswith("no_") and name not in PEERS else ""
    learners = [*ALGORITHMS] if "algo" in known else []
    fields = {"": known, **{f" with --algo {a}": [*typed.names(get(a)[0])] for a in learners}}
    for where, names in sorted(fields.items(), key=lambda each: name not in each[1]):
        likely, why = meant(name.removeprefix(no), names, PEERS)
        own = " or ".join(of_field(no + field) for field in likely)
        hint = f"did you mean {own}{where}?" if own else "which is not a flag"
        if own or why:
            break
    return f"{hint} ({why})" if why else hint


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


def _own(args: Sequence[str], known: Sequence[str]) -> list[str]:
    """The arguments with the names that our fields have: --touch off is --run-type control."""
    own = list(args)
    for at, arg in enumerate(args):
        flag, equals, value = arg.partition("=")
        name = flag[2:].replace("-", "_") if flag.startswith("--") else ""
        found = value if equals else next(iter(args[at + 1 :]), "")
        if name == "touch_rule":
            flag = "--touch"
        elif name == "touch" and "run_type" in known and found not in touch.RULES:
            if found not in help.SWITCH:
                allowed = ", ".join(help.SWITCH)
                raise InputError(
                    f"--touch: found {repr(found) if found else 'no value'}, allowed: {allowed}"
                )
            flag, value = "--run-type", help.SWITCH[found]
            own[at + 1 : at + 2] = own[at + 1 : at + 2] if equals else [value]
        elif name not in known and SAME.get(name) in known:
            flag = of_field(SAME[name])
        if name:
            own[at] = f"{flag}{equals}{value}" if equals else flag
    return own


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
