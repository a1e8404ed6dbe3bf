"""What `--help` prints: the flags that matter first; with `--help-all` all of them, in groups."""

from __future__ import annotations

import dataclasses
import re
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, get_args, get_origin, get_type_hints

import docstring_parser
import tyro
from rich.panel import Panel
from rich.text import Text

from .console import console

WIDTH = 78  # columns, at most
LEFT = 25  # of these, for flags that are no longer
SHORT, ALL = {"-h", "--help"}, "--help-all"
SHOWN = {"run_type": "touch", "touch": "touch-rule"}
"""Fields whose flags have other names."""
SWITCH = {"on": "main", "off": "control", "absent": "absent"}
"""What --touch takes -> the run type, as the paper calls it."""
VALUES: dict[Any, str] = {str: "NAME", int: "INT", float: "FLOAT", Path: "PATH", float | str: "NUMBER"}


class About(NamedTuple):
    """What a command is for."""

    text: str = ""
    first: tuple[str, ...] = ()
    """Fields that --help shows, in this order; none: all."""
    examples: tuple[str, ...] = ()
    defaults: Mapping[str, str] = {}
    """What happens without a flag, where that is not its field's default."""


def show(kind: Any, default: Any, prog: str, about: About, everything: bool) -> NoReturn:
    """Print the flags of a dataclass; raises SystemExit."""
    width = min(WIDTH, shutil.get_terminal_size().columns)
    found = {name: rest for name, *rest in _fields(kind, default)}
    first = [name for name in about.first if name in found]
    is_short = not everything and 0 < len(first) < len(found)
    options = [_row("-h, --help", "show this help message and exit", width)]
    groups: dict[str, list[str]] = {"positional arguments": [], "options": options}
    places = []
    for name in dict.fromkeys([*first, *([] if is_short else found)]):
        owner, hint, value, doc = found[name]
        flag, words = _described(name, hint, value, doc, about.defaults.get(name, ""))
        title = "options"
        if not flag.startswith("-"):
            title = "positional arguments"
            places.append(flag)
        elif owner is not None and name not in first:
            title = re.sub("(Config|Options|Flags|s)$", "", owner.__name__)
            title = re.sub("(?<=[a-z])(?=[A-Z])|(?=HER)", " ", title).lower() + " options"
            intro = textwrap.fill((owner.__doc__ or "").partition("\n")[0], width - 4)
            groups.setdefault(title, [intro, "─" * (width - 4)])
        groups[title].append(_row(flag, words, width))
    usage = f"usage: {' '.join([prog, '[OPTIONS]', *places])}"
    print(textwrap.fill(about.text, width), usage, sep="\n\n", end="\n\n")
    for title, rows in groups.items():
        if rows:
            text = Text("\n".join(rows))
            console.print(Panel(text, title=title, title_align="left", width=width))
    if about.examples:
        print("\n".join(["examples:", *(f"  {line}" for line in about.examples), ""]))
    if is_short:
        print(f"{prog} {ALL} lists all {len(found)} flags.")
    raise SystemExit(0)


def _row(flag: str, words: str, width: int) -> str:
    """A flag, and what it does to the right of it, or below where the flag is long."""
    rest = " " * LEFT
    begin = flag.ljust(LEFT) if len(flag) < LEFT - 1 else f"{flag}\n{rest}"
    text = textwrap.fill(
        words, width - 4, initial_indent=rest, subsequent_indent=rest, break_on_hyphens=False
    )
    return begin + text[LEFT:]


def of_field(field: str) -> str:
    """The flag of a field."""
    return f"--{SHOWN.get(field, field).replace('_', '-')}"


def _fields(kind: Any, default: Any, is_part: bool = False) -> Iterator[tuple[str, Any, Any, Any, Any]]:
    """(name, class that has it in a part, type, default, docstring) of each field of a dataclass and of
    its parts."""
    hints = get_type_hints(kind, include_extras=True)
    docs = {p.arg_name: (c, p.description) for c in kind.__mro__[-2::-1]
            for p in docstring_parser.parse_from_object(c).params}  # fmt: skip
    for field in dataclasses.fields(kind):
        hint, value = hints[field.name], getattr(default, field.name, field.default)
        if dataclasses.is_dataclass(hint):
            yield from _fields(hint, value, is_part=True)
        else:
            owner, doc = docs.get(field.name, (None, ""))
            yield field.name, owner if is_part else None, hint, value, doc


def _described(name: str, hint: Any, value: Any, doc: str, usual: str) -> tuple[str, str]:
    """A flag as it is written, and what it does."""
    base, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    own: Any = next((note for note in notes if hasattr(note, "metavar")), tyro.conf.arg())
    words = " ".join((own.help or doc).split())
    if tyro.conf.Positional in notes:
        is_needed = value is dataclasses.MISSING
        many = " ..." if get_origin(base) is tuple else ""
        flag = name.upper() if is_needed else f"[{name.upper()}{many}]"
        return flag, words + " (required)" * is_needed
    if name == "run_type":
        base, value = Literal[tuple(SWITCH)], {run: word for word, run in SWITCH.items()}[value]
    flag = of_field(own.name or name)
    if isinstance(value, bool):
        flag, usual = f"{flag}, --no-{flag[2:]}" if value else flag, "on" * value
    else:
        flag += f" {own.metavar or ('PATH' if name == 'out' else _metavar(base))}"
    if not usual and not isinstance(value, bool):
        each = value if isinstance(value, tuple) else (value,)
        usual = " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in each if v is not None)
    return flag, f"{words} (default: {usual})" if usual else words


def _metavar(hint: Any) -> str:
    """What stands for a flag's value."""
    if hint in VALUES or get_origin(hint) is Literal:
        return VALUES.get(hint) or f"{{{','.join(get_args(hint))}}}"
    parts = get_args(hint)[:1] if get_origin(hint) is Annotated else get_args(hint)
    words = [_metavar(part) for part in parts if part not in (..., NoneType)]
    return f"[{words[0]} ...]" if ... in parts else " ".join(words)
