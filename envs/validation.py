"""Check what anybody may have written: names, values of a dataclass's fields, and TOML files.

A field's type says what it allows, and where that is an interval, the type says which:
`Annotated[float, "[0, 1)"]`. All errors are ValueErrors of one line, "NAME: found X,
allowed Y".
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

T = TypeVar("T")
Fraction = Annotated[float, "[0, 1]"]
Newtons = Annotated[float, "[0, 100]"]
WORDS = {
    int: "a whole number",
    float: "a number",
    str: "a string",
    bool: "True or False",
    dict: "a table",
    Path: "a path",
    NoneType: "None",
}
ACCEPTED: dict[Any, Any] = {float: int | float, tuple: list | tuple, Any: object}
"""What Python types stand for a type in a field."""
INTEGER_LIMIT = 2**63  # numbers stay below, so that they have a place in an array


# -- names that somebody chose ---------------------------------------------------------------


def require_known(names: Iterable[str], known: Iterable[str], where: str = "") -> None:
    """Raise ValueError naming the first of `names` that is not known.

    It says what may have been meant, and all that are known.
    """
    known = sorted(known)
    for name in names:
        if name not in known:
            path = f"{where}.{name}" if where else name
            hint = nearest(name, known)
            raise ValueError(f"{path}: unknown; {hint}allowed: {', '.join(known)}")


def require_one_of(known: Iterable[str], value: Any, where: str) -> None:
    """Raise ValueError where a value is none of those that are known."""
    if value not in (known := list(known)):
        hint = nearest(str(value), known)
        raise ValueError(f"{where}: found {value!r}, {hint}allowed: {', '.join(known)}")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a question for whoever mistyped one of `known`, or nothing."""
    likely = difflib.get_close_matches(name.lower(), list(known), 1)
    return f"did you mean {likely[0]}? " if likely else ""


# -- dataclasses -----------------------------------------------------------------------------


def names(dataclass: Any) -> set[str]:
    """Return the names of the fields of a dataclass, or of an instance of one."""
    return {field.name for field in dataclasses.fields(dataclass)}


@cache
def hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields, with their intervals."""
    return get_type_hints(kind, include_extras=True)


def fill(kind: type[T], table: Any, where: str = "") -> T:
    """Return a dataclass from a table of a TOML or JSON file; what is not in it has its default.

    Raises ValueError naming the first key that is missing, unknown or of another type.
    """
    types = hints(kind)  # type: ignore[arg-type]
    require_known(require_type(table, dict, where), types, where)
    values = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        path = f"{where}.{field.name}" if where else field.name
        if field.name in table:
            values[field.name] = require_type(
                table[field.name], types[field.name], path
            )
        elif field.default is dataclasses.MISSING is field.default_factory:
            raise ValueError(f"{path}: missing, allowed {words(types[field.name])}")
    return kind(**values)


def replace(instance: T, choices: Mapping[str, Any]) -> T:
    """Return a copy of a dataclass with some fields chosen otherwise, as `plain` has them."""
    return dataclasses.replace(instance, **plain(type(instance), choices))  # type: ignore[type-var]


def plain(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for fields of a dataclass, whose lists are tuples, and NumPy's numbers Python's.

    One value stands for a tuple of one.
    """
    tuples = {f.name for f in dataclasses.fields(kind) if isinstance(f.default, tuple)}
    plain = {name: _plain(value) for name, value in values.items()}
    return {
        name: (value,)
        if name in tuples and isinstance(value, str | float | int)
        else value
        for name, value in plain.items()
    }


def _plain(value: Any) -> Any:
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def quoted(value: Any) -> str:
    """Return a string, a number or a list of them as TOML has it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def validate(instance: Any) -> None:
    """Raise ValueError naming the first field of a dataclass that is invalid or of another type."""
    require(type(instance), vars(instance))
    instance.validate()


def require(kind: type, values: Mapping[str, Any]) -> None:
    """Raise ValueError naming the first of `values` that is not what the field of that name says."""
    for name, hint in hints(kind).items():
        require_type(values[name], hint, name)


def require_rising(span: tuple[float, ...], where: str) -> None:
    """Raise ValueError for an interval whose lower end does not come first."""
    if span[0] >= span[1]:
        raise ValueError(f"{where}: found {list(span)}, expected the lower end first")


# -- values ----------------------------------------------------------------------------------


def require_type(value: Any, hint: Any, where: str) -> Any:
    """Return a value as the type `hint` has it, or raise ValueError.

    Lists become tuples, whole numbers floats, tables dataclasses. It is an error when
    the value is not of that type, or not in its interval. True is no number, nor is
    10**400.
    """
    is_union = get_origin(hint) in (Union, UnionType)
    options = get_args(hint) if is_union else (hint,)
    option = next((each for each in options if _is_kind(value, each)), None)
    kind, inner = get_origin(option) or option, get_args(option)
    wrong = ValueError(f"{where}: found {_short(value)}, allowed {words(hint)}")
    if option is None:
        raise wrong
    if kind is Annotated:
        value = require_type(value, inner[0], where)
        for interval in inner[1:]:  # those of other libraries are no strings
            if isinstance(interval, str) and not _is_within(value, interval):
                raise ValueError(f"{where}: found {value}, allowed {interval}")
    elif kind is Literal:
        require_one_of(inner, value, where)
    elif kind in (tuple, list) and inner:
        is_fixed = kind is tuple and ... not in inner
        types = inner if is_fixed else inner[:1] * len(value)
        if len(types) != len(value):
            raise wrong
        wheres = (
            f"{where} {number}" if dataclasses.is_dataclass(each) else where
            for number, each in enumerate(types, 1)
        )
        return kind(map(require_type, value, types, wheres))
    elif kind is dict and inner:
        return {k: require_type(v, inner[1], f"{where}.{k}") for k, v in value.items()}
    elif dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return fill(kind, value, where)  # type: ignore[arg-type]
    return float(value) if kind is float else value


def _is_kind(value: Any, hint: Any) -> bool:
    """Return whether a value is one of a type but for its parts and its interval."""
    kind = get_origin(hint) or hint
    if kind is Annotated:
        return _is_kind(value, get_args(hint)[0])
    if kind is Literal:
        return value is not None
    if dataclasses.is_dataclass(kind):
        return isinstance(value, kind | dict)  # type: ignore[operator]
    if isinstance(value, bool) and kind in (int, float):
        return False
    if isinstance(value, int) and abs(value) >= INTEGER_LIMIT:
        return False
    if isinstance(value, str) and "\0" in value:
        return False
    return isinstance(value, ACCEPTED.get(kind, kind))


def _is_within(value: float, interval: str) -> bool:
    low, high = map(float, interval[1:-1].split(", "))
    is_above = value > low or (interval[0] == "[" and value == low)
    return is_above and (value < high or (interval[-1] == "]" and value == high))


def words(hint: Any) -> str:
    """Return what a type allows, in words."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind is Annotated:
        return words(inner[0])
    if kind is Literal:
        return f"one of {', '.join(inner)}"
    if kind is tuple:
        items = ["..." if part is ... else words(part) for part in inner]
        return f"a list ({', '.join(items)})"
    if kind in (Union, UnionType):
        return " or ".join(map(words, inner))
    if dataclasses.is_dataclass(kind):
        return WORDS[dict]
    return WORDS.get(kind, str(getattr(kind, "__name__", kind)))


def _short(value: Any) -> str:
    """Return the beginning of a value; of a table, that it is one."""
    value = list(value) if isinstance(value, tuple) else value
    return "a table" if isinstance(value, dict) else repr(value)[:50]


# -- TOML files ------------------------------------------------------------------------------


def read_text(path: Path, what: str) -> str:
    """Return the content of a file, called `what` in errors.

    Raise ValueError where it is no UTF-8, and FileNotFoundError.
    """
    if not os.path.isfile(path):  # Path.is_file raises when a name is too long
        fault = "is a folder" if os.path.isdir(path) else "does not exist"
        raise FileNotFoundError(f"{what} {str(path)!r} {fault}")
    return path.read_text(encoding="utf-8-sig")


def read(path: Path, what: str) -> dict[str, Any]:
    """Return the content of a TOML file, called `what` in errors.

    Raise ValueError naming what is wrong with it, and FileNotFoundError.
    """
    try:
        return tomllib.loads(read_text(path, what))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{what} {path}: not valid TOML: {error}") from None


@contextmanager
def blamed(what: str) -> Iterator[None]:
    """Have ValueErrors inside say of what they are."""
    try:
        yield
    except ValueError as error:
        about = "" if str(error).startswith(what) else f"{what}: "
        raise ValueError(f"{about}{error}") from None


def table(data: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return a table of a file, empty where there is none; ValueError for something else."""
    return dict(require_type(data.get(key, {}), dict, key))
