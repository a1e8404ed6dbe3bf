"""What `--help` prints: the flags that matter first; with `--help-all` all of them, in groups."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import docstring_parser
import tyro

WIDTH = 78  # columns, at most
SHORT, ALL = {"-h", "--help"}, "--help-all"
SHOWN = {"run_type": "touch", "touch": "touch-rule"}
"""Fields whose flags have other names."""
SWITCH = {"on": "main", "off": "control", "absent": "absent"}
"""What --touch takes -> the run type, as the paper calls it."""


METAVARS = {str: "NAME", int: "INT", float: "FLOAT", Path: "PATH", float | str: "NUMBER", "out": "PATH"}


class About(NamedTuple):
    """What a command is for."""

    text: str = ""
    first: tuple[str, ...] = ()
    """Fields that --help shows, in this order; none: all."""
    examples: tuple[str, ...] = ()


NOTHING = About()


def show(kind: Any, default: Any, prog: str, about: About, everything: bool) -> None:
    """Print the flags of a dataclass; raises SystemExit."""
    rows = {name: (group, hint, value) for group, name, hint, value in _flags(kind, default)}
    first = [name for name in about.first if name in rows]
    is_short = not everything and 0 < len(first) < len(rows)
    groups: dict[Any, list[Any]] = {}
    for name in dict.fromkeys([*first, *([] if is_short else rows)]):
        group, *field = rows[name]
        groups.setdefault(None if name in first else group, []).append((name, *field))
    root: list[Any] = groups.pop(None, [])
    for group, fields in groups.items():
        title = re.sub("(Config|Options|Flags)$", "", group.__name__)
        described = {"__doc__": (group.__doc__ or "").partition("\n")[0]}
        nested = dataclasses.make_dataclass(title, fields, namespace=described)
        title = re.sub("(?<=[a-z])(?=[A-Z])", " ", title).lower()
        kind = Annotated[nested, tyro.conf.arg(name=title)]
        root.append((f"in_{len(root)}", kind, dataclasses.field(default_factory=nested)))
    shown = dataclasses.make_dataclass("Shown", root, kw_only=True, namespace={"__doc__": ""})
    conf = tyro.conf
    config = conf.OmitArgPrefixes, conf.DisallowNone, conf.PositionalMetavarFromFieldName
    print(textwrap.fill(about.text, WIDTH), end="\n\n" if about.text else "")
    with _narrow(), contextlib.suppress(SystemExit):
        tyro.cli(shown, args=["--help"], prog=prog, description="", config=config)
    if about.examples:
        print("\n".join(["examples:", *(f"  {line}" for line in about.examples), ""]))
    if is_short:
        print(f"{prog} {ALL} lists all {len(rows)} flags.")
    raise SystemExit(0)


@contextlib.contextmanager
def _narrow() -> Iterator[None]:
    """A terminal of at most WIDTH columns."""
    before = {"COLUMNS": os.environ["COLUMNS"]} if "COLUMNS" in os.environ else {}
    os.environ["COLUMNS"] = str(min(WIDTH, shutil.get_terminal_size().columns))
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        os.environ.update(before)


def _flags(kind: Any, default: Any, is_part: bool = False) -> Iterator[tuple[Any, str, Any, Any]]:
    """(class that has it in a part, name, annotated type, default) of each field of a dataclass and of
    its parts."""
    hints = get_type_hints(kind, include_extras=True)
    owners = {name: c for c in reversed(kind.__mro__) for name in vars(c).get("__annotations__", ())}
    docs = {p.arg_name: p.description for c in kind.__mro__[-2::-1]
            for p in docstring_parser.parse_from_object(c).params}  # fmt: skip
    for field in dataclasses.fields(kind):
        value = getattr(default, field.name, field.default)
        if value is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        if dataclasses.is_dataclass(part := hints[field.name]):
            yield from _flags(part, value, is_part=True)
        else:
            shown = _annotated(field.name, hints[field.name], value, docs.get(field.name))
            yield owners[field.name] if is_part else None, field.name, *shown


def _annotated(name: str, hint: Any, value: Any, doc: str | None) -> tuple[Any, Any]:
    """A field's type and default as tyro is to show them."""
    base, *rest = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    own: Any = next((each for each in rest if hasattr(each, "help_behavior_hint")), tyro.conf.arg())
    rest = [each for each in rest if each is not own]
    if name == "run_type":
        base, value = Literal[tuple(SWITCH)], {run: word for word, run in SWITCH.items()}[value]
    words = " ".join((own.help or doc or "").split())
    label = f"{value:g}" if isinstance(value, float) else None
    is_unset = value in (None, "", ()) or value is False
    conf = dataclasses.replace(
        own,
        name=own.name or SHOWN.get(name),
        help=words,
        metavar=own.metavar
        or (None if any(type(m) is not str for m in rest) else METAVARS.get(name) or _metavar(base)),
        help_behavior_hint="" if is_unset else lambda found: f"(default: {label or found})",
    )
    markers = [tyro.conf.FlagCreatePairsOff] if value is False else []
    return Annotated[(base, conf, *markers, *rest)], value


def _metavar(hint: Any) -> str | None:
    """What stands for a flag's value; None where tyro knows better."""
    if get_origin(hint) is Annotated:
        return _metavar(get_args(hint)[0])
    parts = [part for part in get_args(hint) if part is not NoneType]
    if hint in METAVARS or not parts or get_origin(hint) is Literal:
        return METAVARS.get(hint)
    words = [_metavar(part) for part in parts if part is not ...]
    if None in words or (get_origin(hint) is not tuple and len(parts) > 1):
        return None
    return f"[{words[0]} ...]" if ... in parts else " ".join(map(str, words))
