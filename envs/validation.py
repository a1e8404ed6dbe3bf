"""Check what anybody may have written: names, values of a dataclass's fields, and TOML files.

A field's type says what it allows, and where that is an interval, the type says which:
`Annotated[float, "[0, 1)"]`. All errors are ValueErrors of one line, "NAME: found X, allowed Y".
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
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
    is_typeddict,
)

import numpy as np

T = TypeVar("T")
Fraction = Annotated[float, "[0, 1]"]
WORDS = {
    int: "a whole number",
    float: "a number",
    str: "a string",
    bool: "True or False",
    dict: "a table",
    NoneType: "None",
}
LARGEST = 2**63  # whole numbers stay below, so that they have a place in an array
LARGEST_FILE = 10_000_000  # bytes
Aliases = Mapping[str, tuple[str, str]]
"""What others call a choice -> what is nearest to it here (names with spaces between), and why."""
NONE: Aliases = {}


# -- names that somebody chose ---------------------------------------------------------------


def require_known(
    names: Iterable[str], known: Iterable[str], aliases: Aliases = NONE
) -> None:
    """Raise ValueError naming the first of `names` that is not known, what may have been meant, and
    all that are known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            likely, why = meant(name, known, aliases)
            hint = f"did you mean {' or '.join(likely)}? " if likely else ""
            reason = f"({why}) " if why else ""
            raise ValueError(
                f"{name}: unknown; {hint}{reason}allowed: {', '.join(known)}"
            )


def require_one_of(known: Iterable[str], value: Any, where: str) -> None:
    """Raise ValueError where a value is none of those that are known."""
    if value not in (known := list(known)):
        raise ValueError(f"{where}: found {value!r}, allowed: {', '.join(known)}")


def meant(
    name: str, known: Collection[str], aliases: Aliases = NONE
) -> tuple[list[str], str]:
    """Return those of `known` that somebody may have meant by `name`, and how they differ from it."""
    peers, why = aliases.get(name, ("", ""))
    likely = [own for own in peers.split() if own in known]
    if likely or (name in aliases and not peers):
        return likely, why
    longer = [own for own in known if own.startswith(name)] if len(name) > 2 else []
    return longer[:1] or difflib.get_close_matches(
        name.lower(), known, 1, cutoff=0.7
    ), ""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a question for whoever mistyped one of `known`, or nothing."""
    likely, _ = meant(name, list(known))
    return f"did you mean {likely[0]}? " if likely else ""


# -- dataclasses -----------------------------------------------------------------------------


def names(dataclass: Any) -> set[str]:
    """Return the names of the fields of a dataclass, or of an instance of one."""
    return {field.name for field in dataclasses.fields(dataclass)}


def hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields, with their intervals."""
    return get_type_hints(kind, include_extras=True)


def make(kind: type[T], values: Any, where: str) -> T:
    """Return a dataclass from JSON's values: all of its fields, none besides; lists are its tuples.

    Raises ValueError naming the first field that is missing, unknown or of another type.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where}: found {_short(values)}, expected an object")
    if different := sorted(values.keys() ^ names(kind)):
        found = "an unknown" if different[0] in values else "no"
        raise ValueError(f"{where}: found {found} field {different[0][:50]!r}")
    values = plain(values)
    require(kind, values)
    return kind(**values)


def fill(kind: type[T], table: Any, where: str = "") -> T:
    """Return a dataclass from a table of a TOML file; what is not in it has its default.

    Lists become tuples, tables dataclasses where a field's type is one, and whole numbers floats.
    Raises ValueError naming the first key that is missing, unknown or of another type.
    """
    types = hints(kind)
    only(_table(table, where), types, where or "the file")
    values = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        path = f"{where}.{field.name}" if where else field.name
        if field.name in table:
            values[field.name] = _filled(table[field.name], types[field.name], path)
        elif (
            field.default is dataclasses.MISSING is field.default_factory
        ):  # it has to be there
            allowed = words(types[field.name])
            raise ValueError(f"{path}: found None, expected {allowed}")
    return kind(**values)


def _filled(value: Any, hint: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return fill(hint, value, where)  # type: ignore[arg-type]
    inner = get_args(hint)
    if get_origin(hint) is dict:
        return {
            key: _filled(each, inner[1], f"{where}.{key}")
            for key, each in _table(value, where).items()
        }
    if get_origin(hint) is tuple and dataclasses.is_dataclass(inner[0]):
        if not isinstance(value, list):
            raise ValueError(f"{where}: found {_short(value)}, expected [[{where}]]")
        return tuple(
            _filled(each, inner[0], f"{where} {number}")
            for number, each in enumerate(value, 1)
        )
    value = _plain(value)
    require_type(value, hint, where)
    return _floats(value) if float in parts(hint) and int not in parts(hint) else value


def _floats(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_floats, value))
    if isinstance(value, dict):
        return {key: _floats(each) for key, each in value.items()}
    return float(value) if isinstance(value, int) else value


def replace(instance: T, choices: Mapping[str, Any]) -> T:
    """Return a copy of a dataclass with some fields chosen otherwise; lists are its tuples."""
    return dataclasses.replace(instance, **plain(choices))  # type: ignore[type-var]


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values with JSON's lists as tuples, and NumPy's numbers as Python's."""
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


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
        found = f"found {list(span)}, expected the lower end first"
        raise ValueError(f"{where}: {found}")


def allow_only_with(what: str, config: Any, *names: str) -> None:
    """Raise ValueError for a field of `config` that is not as usual, where it does nothing without
    `what`."""
    usual = {field.name: field.default for field in dataclasses.fields(config)}
    for name in names:
        if (found := getattr(config, name)) != usual[name]:
            raise ValueError(f"{name}: found {found}, allowed only with {what}")


# -- values ----------------------------------------------------------------------------------


def require_type(value: Any, hint: Any, name: str) -> None:
    """Raise ValueError when `value` is not of the type `hint`, or not in its interval.

    True is no number, nor is 10**400.
    """
    if _fits(value, hint):
        return
    for option in _options(hint):
        inner = get_args(option)
        if get_origin(option) is Annotated and _fits(value, inner[0]):
            allowed = " and ".join(map(_span, _intervals(inner)))
            raise ValueError(f"{name}: found {value}, allowed {allowed}")
        if get_origin(option) is tuple and isinstance(value, tuple):
            for item, own in zip(value, _items(option, value), strict=False):
                require_type(item, own, name)
    literals = [get_args(o) for o in _options(hint) if get_origin(o) is Literal]
    allowed = f": {', '.join(*literals)}" if literals else f" {words(hint)}"
    raise ValueError(f"{name}: found {_short(value)}, allowed{allowed}")


def _fits(value: Any, hint: Any) -> bool:
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, option) for option in inner)
    if kind is Annotated:
        return _fits(value, inner[0]) and all(
            _is_within(value, interval) for interval in _intervals(inner)
        )
    if kind is Literal:
        return isinstance(value, str) and value in inner
    if kind is tuple and inner:
        items = _items(hint, value) if isinstance(value, tuple) else ()
        is_long = isinstance(value, tuple) and len(items) == len(value)
        return is_long and all(map(_fits, value, items))
    if is_typeddict(kind):
        types = hints(kind)
        return isinstance(value, dict) and all(
            key in value and _fits(value[key], types[key]) for key in types
        )
    if kind is list and inner:
        return isinstance(value, list) and all(_fits(each, inner[0]) for each in value)
    if kind is dict and inner:
        return isinstance(value, dict) and all(
            _fits(key, inner[0]) and _fits(each, inner[1])
            for key, each in value.items()
        )
    if kind in (int, float):
        is_number = isinstance(value, kind | int) and not isinstance(value, bool)
        return is_number and (isinstance(value, float) or abs(value) < LARGEST)
    if kind is str:
        return isinstance(value, str) and "\0" not in value
    return kind is Any or isinstance(value, kind)


def _options(hint: Any) -> tuple[Any, ...]:
    """Return the types any of which a type allows."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _items(hint: Any, value: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the types of a tuple's items."""
    inner = get_args(hint)
    return inner[:1] * len(value) if ... in inner else inner


def _intervals(inner: tuple[Any, ...]) -> list[str]:
    """Return those among what a type is annotated with; the others are of other libraries."""
    return [each for each in inner[1:] if isinstance(each, str)]


def _is_within(value: float, interval: str) -> bool:
    low, high = map(float, interval[1:-1].split(", "))
    is_above = value > low or (interval[0] == "[" and value == low)
    return is_above and (value < high or (interval[-1] == "]" and value == high))


def _span(interval: str) -> str:
    """Return an interval in words."""
    low, high = interval[1:-1].split(", ")
    is_from, is_to = interval[0] == "[", interval[-1] == "]"
    if high == "inf":
        return f"{low} or more" if is_from else f"a finite number above {low}"
    if is_from:
        return f"from {low} to {'' if is_to else 'below '}{high}"
    return f"above {low}, {'up to' if is_to else 'below'} {high}"


def parts(hint: Any) -> Iterator[Any]:
    """Yield a type, and the types that it is made of."""
    yield hint
    for part in get_args(hint):
        yield from parts(part)


def words(hint: Any) -> str:
    """Return what a type allows, in words."""
    kind, inner = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return words(inner[0])
    if kind is tuple:
        items = ["..." if part is ... else words(part) for part in inner]
        if set(items) == {WORDS[float]}:
            return f"{len(items)} numbers"
        return f"a list ({', '.join(items)})"
    if kind in (Union, UnionType):
        return " or ".join(map(words, inner))
    return WORDS.get(kind or hint, str(getattr(hint, "__name__", hint)))


def _short(value: Any) -> str:
    """Return a value, or its type when it has many parts."""
    if isinstance(value, int) and abs(value) >= LARGEST:
        return f"a number of {value.bit_length()} bits, allowed up to 63"
    plain_types = str | int | float | None
    is_flat = isinstance(value, list | tuple) and all(
        isinstance(item, plain_types) for item in value
    )
    if is_flat:
        return f"[{', '.join(map(_short, value))}]"[:50]
    return repr(value)[:50] if isinstance(value, plain_types) else type(value).__name__


# -- TOML files ------------------------------------------------------------------------------


def read(path: Path, what: str) -> dict[str, Any]:
    """Return the content of a TOML file, called `what` in errors; ValueError naming what is wrong with
    it, and FileNotFoundError."""
    if not os.path.isfile(path):  # Path.is_file raises when a name is too long
        raise FileNotFoundError(f"{what} {str(path)!r} does not exist")
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
        if len(content) > LARGEST_FILE:
            raise ValueError(f"found more than {LARGEST_FILE:,} bytes")
        return tomllib.loads(content.decode("utf-8"))
    except RecursionError:
        raise ValueError(f"{what} {path}: nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{what} {path}: not valid TOML: {error}") from None


@contextmanager
def blamed(what: str) -> Iterator[None]:
    """Have ValueErrors inside say of what they are."""
    try:
        yield
    except ValueError as error:
        about = "" if str(error).startswith(what) else f"{what}: "
        raise ValueError(f"{about}{error}") from None


def only(data: Mapping[str, Any], allowed: Collection[str], where: str) -> None:
    """Raise ValueError naming the first key that is not allowed."""
    if unknown := sorted(set(data) - set(allowed)):
        found = f"{where}: unknown key {unknown[0]!r}"
        raise ValueError(f"{found}; allowed: {', '.join(sorted(allowed))}")


def table(
    data: Mapping[str, Any], key: str, allowed: Collection[str] | None = None
) -> dict[str, Any]:
    """Return a table of a file, empty where there is none; ValueError for something else, and for a
    key in it that is not allowed."""
    value = _table(data.get(key, {}), key)
    if allowed is not None:
        only(value, allowed, key)
    return value


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: found {value!r:.50}, expected a table")
    return value
