"""What `--help` prints: the flags that matter, as tyro shows them; with `--help-all` all of them."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from types import NoneType
from typing import (
    Annotated,
    Any,
    NamedTuple,
    NoReturn,
    get_args,
    get_origin,
    get_type_hints,
)

import docstring_parser
import tyro

from ..envs import validation

SHORT, ALL = {"-h", "--help"}, "--help-all"


class About(NamedTuple):
    """What a command is for."""

    text: str = ""
    first: tuple[str, ...] = ()
    """Fields that --help shows, in this order; none: all."""
    examples: tuple[str, ...] = ()
    defaults: Mapping[str, str] = {}
    """What happens without a flag, where that is not its field's default."""


def show(
    kind: Any, default: Any, prog: str, about: About, everything: bool
) -> NoReturn:
    """Print the flags of a dataclass; raises SystemExit."""
    groups = list(_groups(kind, default, about.defaults))
    every = {field[0]: field for _, fields in groups for field in fields}
    first = [every[name] for name in dict.fromkeys(about.first) if name in every]
    is_short = not everything and 0 < len(first) < len(every)
    parts = [("", first)] if is_short else groups
    shown: list[Any] = []
    for title, fields in parts:
        part = dataclasses.make_dataclass(title or "Flags", fields, kw_only=True)
        shown += [(title, part)] if title else fields
    options = dataclasses.make_dataclass("Options", shown, kw_only=True)
    options.__doc__ = None
    config = (tyro.conf.OmitArgPrefixes,)
    said = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        tyro.cli(options, args=["--help"], prog=prog, description="", config=config)
    said.seek(0)
    usage, _, flags = said.read().partition("\n")
    for text in (about.text, usage):
        print(textwrap.fill(text, shutil.get_terminal_size().columns), end="\n\n")
    print(flags.strip())
    if about.examples:
        print("\n".join(["examples:", *(f"  {line}" for line in about.examples), ""]))
    print(
        "--import MODULE imports a module of yours first, such as one that adds a task."
    )
    if is_short:
        print(f"{prog} {ALL} lists all {len(every)} flags.")
    raise SystemExit(0)


def of_field(field: str) -> str:
    """The flag of a field."""
    return f"--{field.replace('_', '-')}"


METAVARS = {int: "INT", float: "FLOAT", str: "STR"}
Shown = tuple[str, Any, Any]
"""Name, annotated type and default of a field, as `make_dataclass` takes them."""


def _groups(
    kind: Any, default: Any, usual: Mapping[str, str]
) -> Iterator[tuple[str, list[Shown]]]:
    """Fields of a dataclass, and of each of its parts under the name of its class."""
    hints = get_type_hints(kind, include_extras=True)
    docs = {p.arg_name: p.description or "" for base in kind.__mro__[-2::-1]
            for p in docstring_parser.parse_from_object(base).params}  # fmt: skip
    own = []
    for field in dataclasses.fields(kind):
        hint, value = hints[field.name], getattr(default, field.name, field.default)
        if dataclasses.is_dataclass(hint):
            parts = list(_groups(hint, value, usual))
            yield (
                getattr(hint, "__name__", ""),
                [each for _, fields in parts for each in fields],
            )
        else:
            own.append(_shown(field.name, hint, value, docs.get(field.name, ""), usual))
    yield "", own


def _shown(
    name: str, hint: Any, value: Any, doc: str, usual: Mapping[str, str]
) -> Shown:
    """A field as its flag is to be shown: its text in one paragraph, no default that says nothing."""
    base, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    own: Any = next(
        (note for note in notes if hasattr(note, "metavar")), tyro.conf.arg()
    )
    said = usual.get(name, "" if value is None or value is False else value)
    said = " ".join(map(str, said)) if isinstance(said, tuple) else str(said)
    hint_of_it = (
        "(required)"
        if value is dataclasses.MISSING
        else f"(default: {said})"
        if said
        else ""
    )
    metavar = own.metavar or ("PATH" if name == "out" else None)
    if NoneType in get_args(base):  # which nobody types
        of_kind = [
            METAVARS[part] for part in METAVARS if part in validation.parts(base)
        ]
        metavar = metavar or next(iter(of_kind), None)
    words = " ".join((own.help or doc).split())
    flag = tyro.conf.arg(
        name=own.name, metavar=metavar, help=words, help_behavior_hint=hint_of_it
    )
    return (
        name,
        Annotated[(base, *(note for note in notes if note is not own), flag)],
        value,
    )
