"""The flags of a run, and of the scene that it has."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, Literal

import tyro

from ..algos import recipes
from ..envs import hands, scenes
from ..envs.grasp import GraspConfig
from ..errors import InputError
from ..terminal import flags
from . import config as configuration
from .config import RunConfig

ABOUT = f"a named scene ({', '.join(scenes.names())}) or its .toml file; other flags override it"
NAMED_SCENE = ("named_scene", Annotated[str, tyro.conf.arg(name="scene", help=ABOUT)], "")


def defaults(args: list[str]) -> RunConfig:
    """The configuration before most flags: it depends on these four."""
    deciding = ("algo", "env", "recipe", "scene")
    return configuration.defaults(**{name: flags.peek(args, f"--{name}", "") for name in deciding})


TRUST = "allow the import of the module in the environment's id"


def read(args: list[str], base: RunConfig) -> tuple[RunConfig, Any]:
    """All flags of `train`, over the defaults `base`; and those that are not of the configuration."""
    about = "continue the run in this folder from its last whole epoch"
    resume = ("resume", Annotated[str, tyro.conf.arg(help=about, metavar="RUN")], "")
    about = "with --resume: allow another number of processes; no longer the same bit for bit"
    any_ranks = ("any_ranks", Annotated[bool, tyro.conf.arg(help=about)], False)
    trust = ("trust", Annotated[bool, tyro.conf.arg(help=f"with --resume: {TRUST}")], False)
    about = "hyperparameters that go together; other flags change them one by one"
    known = tuple(recipes.recipes(base.run.algo))
    recipe = ("recipe", Annotated[Literal[known], tyro.conf.arg(help=about)], recipes.PAPER)
    kinds = [(name, type(part)) for name, part in base.parts.items()]
    options = dataclasses.make_dataclass(
        "Options", [*kinds, recipe, NAMED_SCENE, resume, any_ranks, trust]
    )
    about = (
        "Train a policy. --algo and --env decide which flags there are; their defaults are the "
        "paper's, or those of --recipe and --scene."
    )
    with hands_named(base.run.env):
        given: Any = flags.parse(options, args, "tactilerl train", options(**base.parts), about)
    parts = {name: getattr(given, name) for name in base.parts}
    return dataclasses.replace(base, **parts), given


@contextmanager
def hands_named(env: str) -> Iterator[None]:
    """Where a flag of a scene is refused because `env` is no hand, say which hands there are."""
    try:
        yield
    except InputError as error:
        refused = str(error).partition("'--")[2].partition("'")[0].partition("=")[0]
        is_scene = refused.replace("-", "_") in {
            field.name for field in dataclasses.fields(GraspConfig)
        }
        if hands.is_hand(env) or not is_scene:
            raise
        raise InputError(f"{error} (--env {env} is none of {hands.allowed()})") from error
