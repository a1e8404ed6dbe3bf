"""Command-line flags from dataclasses, by tyro."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import tyro

from ..algos import mpi
from ..envs import sensors, validation
from ..errors import InputError, input_errors

T = TypeVar("T")


def parse(
    kind: type[T],
    args: Sequence[str],
    prog: str,
    about: str,
    default: Any = tyro.MISSING_NONPROP,
) -> T:
    """Read `args` into a dataclass, whose fields are the flags, or those of its dataclasses.

    Raises SystemExit(2) after tyro has said what is wrong with a flag, SystemExit(0) after
    --help, and InputError for a value that is out of the range in its field's type. What has
    a `validate` is left for it to check.
    """
    read: T = tyro.cli(
        kind,
        args=args,
        prog=prog,
        description=about,
        config=(tyro.conf.OmitArgPrefixes,),
        console_outputs=mpi.launched_rank() in (None, "0"),
        default=default,
    )
    with input_errors():
        for part in (read, *vars(read).values()):
            if dataclasses.is_dataclass(part) and not hasattr(part, "validate"):
                validation.require(type(part), vars(part))  # type: ignore[arg-type]
    return read


def parse_parts(
    parts: Mapping[str, Any], args: Sequence[str], prog: str, about: str
) -> Any:
    """Read `args` over the values of several dataclasses; return an object with these by name.

    A sensor of the part `scene` brings its numbers, which the other flags overrule.
    """
    kinds = [(name, type(part)) for name, part in parts.items()]
    options = dataclasses.make_dataclass("Options", kinds)
    read: Any = parse(options, args, prog, about, options(**parts))
    if "scene" in parts:
        with input_errors():
            read.scene = sensors.choose(parts["scene"], given(read.scene, args))
    return read


def given(part: Any, args: Sequence[str]) -> dict[str, Any]:
    """Return those fields of a dataclass that was read from `args` whose flags are among them."""
    names = (arg.partition("=")[0].replace("_", "-") for arg in args)
    flags = {name.replace("--no-", "--", 1) for name in names}
    return {k: v for k, v in vars(part).items() if f"--{k}".replace("_", "-") in flags}


def peek(args: Sequence[str], *names: str) -> dict[str, str]:
    """Return the values of flags before all are known, "" for those that are not given.

    Some decide which other flags there are, and their defaults. InputError where one
    has no value, or an empty one.
    """
    parser = argparse.ArgumentParser(
        add_help=False, allow_abbrev=False, exit_on_error=False
    )
    for name in names:
        parser.add_argument(f"--{name}")
    try:
        given = vars(parser.parse_known_args(args)[0])
    except argparse.ArgumentError as error:
        raise InputError(f"{error.argument_name}: {error.message}") from None
    if empty := [name for name, value in given.items() if value == ""]:
        raise InputError(
            f"{empty[0]}: found an empty value; give one, or leave out --{empty[0]}"
        )
    return {name: value or "" for name, value in given.items()}
