"""Are values of the types and in the ranges that a dataclass says? For what anybody may have written.

A range is an interval in a field's type: `Annotated[float, "[0, 1)"]`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from types import NoneType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from typeguard import CollectionCheckStrategy, TypeCheckError, check_type

T = TypeVar("T")
Fraction = Annotated[float, "[0, 1]"]
WORDS = {
    int: "a whole number",
    float: "a number",
    str: "a string",
    bool: "True or False",
}
LARGEST = 2**63  # whole numbers stay below, so that they have a place in an array


def make(kind: type[T], values: Any, where: str) -> T:
    """A dataclass from JSON's values: all of its fields, none besides; lists are its tuples.

    ValueError naming the first field that is missing, unknown or of another type.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where}: found {_short(values)}, expected an object")
    if values.keys() != names(kind):
        different = sorted(values.keys() ^ names(kind))[0]
        found = "an unknown" if different in values else "no"
        raise ValueError(f"{where}: found {found} field {different[:50]!r}")
    values = plain(values)
    require(kind, values)
    return kind(**values)


def names(dataclass: Any) -> set[str]:
    """Of a dataclass's fields, or of those of an instance."""
    return {field.name for field in dataclasses.fields(dataclass)}


def replace(instance: T, choices: Mapping[str, Any]) -> T:
    """A copy of a dataclass with some fields chosen otherwise; lists are its tuples."""
    return dataclasses.replace(instance, **plain(choices))  # type: ignore[type-var]


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """JSON's lists are the tuples of dataclasses, and NumPy's numbers are Python's."""
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def validate(instance: Any) -> None:
    """ValueError naming the first field of a dataclass that is invalid or of another type."""
    require(type(instance), vars(instance))
    instance.validate()


def require(kind: type, values: Mapping[str, Any]) -> None:
    """ValueError naming the first of `values` that is not what the field of that name says."""
    for name, hint in hints(kind).items():
        require_type(values[name], hint, name)


def hints(kind: type) -> dict[str, Any]:
    """The types of a dataclass's fields, with their ranges."""
    return get_type_hints(kind, include_extras=True)


def allow_only_with(what: str, config: Any, *names: str) -> None:
    """ValueError for a field of `config` that is not as usual, where it does nothing without `what`."""
    usual = {field.name: field.default for field in dataclasses.fields(config)}
    for name in names:
        if (found := getattr(config, name)) != usual[name]:
            raise ValueError(f"{name}: found {found}, allowed only with {what}")


def require_type(value: Any, hint: Any, name: str) -> None:
    """ValueError when `value` is not of the type `hint`, or not in its range; True is no number, nor is
    10**400."""
    try:
        check_type(
            value, hint, collection_check_strategy=CollectionCheckStrategy.ALL_ITEMS
        )
    except TypeCheckError:
        if allowed := choices(hint):
            raise ValueError(
                f"{name}: found {value!r}, allowed: {', '.join(allowed)}"
            ) from None
        raise ValueError(
            f"{name}: found {_short(value)}, allowed {words(hint)}"
        ) from None
    items = value if isinstance(value, tuple) else (value,)
    for item, own in zip(items, _of_items(hint, len(items)), strict=True):
        if isinstance(item, str) and "\0" in item:
            raise ValueError(f"{name}: found {item[:50]!r}, allowed no character 0")
        if isinstance(item, bool) and bool not in parts(own):
            raise ValueError(f"{name}: found {item}, expected a number")
        if isinstance(item, int) and abs(item) >= LARGEST:
            raise ValueError(
                f"{name}: found a number of {item.bit_length()} bits, allowed up to 63"
            )
        for part in parts(own) if isinstance(item, int | float) else ():
            for interval in getattr(part, "__metadata__", ()):
                if isinstance(interval, str):
                    _require_within(item, interval, name)


def _of_items(hint: Any, n: int) -> tuple[Any, ...]:
    """The types of the `n` items of a tuple, each its own where the type says so."""
    tuples = (get_args(part) for part in parts(hint) if get_origin(part) is tuple)
    return next(
        (own for own in tuples if len(own) == n and ... not in own), (hint,) * n
    )


def _require_within(value: float, interval: str, name: str) -> None:
    low, high = interval[1:-1].split(", ")
    is_from, is_to = interval[0] == "[", interval[-1] == "]"
    is_above = value > float(low) or (is_from and value == float(low))
    if is_above and (value < float(high) or (is_to and value == float(high))):
        return
    if high == "inf":
        allowed = f"{low} or more" if is_from else f"a finite number above {low}"
    elif is_from:
        allowed = f"from {low} to {'' if is_to else 'below '}{high}"
    else:
        allowed = f"above {low}, {'up to' if is_to else 'below'} {high}"
    raise ValueError(f"{name}: found {value}, allowed {allowed}")


def choices(hint: Any) -> list[str]:
    """The words that a type allows, where it does not allow any."""
    literals = (part for part in parts(hint) if get_origin(part) is Literal)
    return [choice for literal in literals for choice in get_args(literal)]


def parts(hint: Any) -> Iterator[Any]:
    """A type, and the types that it is made of."""
    yield hint
    for part in get_args(hint):
        yield from parts(part)


def words(hint: Any) -> str:
    """What a type allows."""
    if get_origin(hint) is Annotated:
        return words(get_args(hint)[0])
    parts = ["..." if part is ... else words(part) for part in get_args(hint)]
    if get_origin(hint) is tuple:
        return f"a list ({', '.join(parts)})"
    return " or ".join(parts) or WORDS.get(
        hint, "None" if hint is NoneType else hint.__name__
    )


def _short(value: Any) -> str:
    """A value, or its type when it has many parts."""
    is_plain = value is None or isinstance(value, str | int | float)
    return repr(value)[:50] if is_plain else type(value).__name__
