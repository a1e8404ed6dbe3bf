"""The flags of a run, and of the scene that it has."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, Literal

import tyro

from ..algos import recipes
from ..envs import hands, scenes
from ..envs.choices import nearest
from ..envs.grasp import GraspConfig
from ..errors import InputError
from ..terminal import flags
from ..terminal.help import About
from . import config as configuration
from .config import RunConfig

ABOUT = f"A named scene ({', '.join(scenes.names())}) or its .toml file; other flags override it."
NAMED_SCENE = ("named_scene", Annotated[str, tyro.conf.arg(name="scene", help=ABOUT)], "")


def defaults(args: list[str]) -> RunConfig:
    """The configuration before most flags: it depends on these four."""
    deciding = ("algo", "env", "recipe", "scene")
    return configuration.defaults(**{name: flags.peek(args, f"--{name}", "") for name in deciding})


TRAIN = About(
    "Train a policy. --scene, --algo and --env decide which flags there are and their defaults, which "
    "are the paper's without --scene and --recipe.",
    first=(
        "named_scene", "algo", "env", "layout", "run_type", "task", "recipe", "total_timesteps", "seed",
        "workers", "out", "resume",
    ),
    examples=(
        "tactilerl train --scene handover",
        "tactilerl train --scene handover --touch off",
        "tactilerl train --algo ddpg_her --env shadow --layout 4 --seed 1",
        "tactilerl train --resume runs/X --total-timesteps 1000000",
    ),
)  # fmt: skip
TRUST = "allow the import of the module in the environment's id"


def read(args: list[str], base: RunConfig) -> tuple[RunConfig, Any]:
    """All flags of `train`, over the defaults `base`; and those that are not of the configuration."""
    about = "Continue the run in this folder from its last whole epoch."
    resume = ("resume", Annotated[str, tyro.conf.arg(help=about, metavar="RUN")], "")
    about = "With --resume: allow another number of processes; results then differ in their bits."
    any_ranks = ("any_ranks", Annotated[bool, tyro.conf.arg(help=about)], False)
    trust = ("trust", Annotated[bool, tyro.conf.arg(help=f"With --resume: {TRUST}.")], False)
    about = "Hyperparameters that go together; other flags override them."
    known = tuple(recipes.recipes(base.run.algo))
    recipe = ("recipe", Annotated[Literal[known], tyro.conf.arg(help=about)], recipes.PAPER)
    kinds = [(name, type(part)) for name, part in base.parts.items()]
    options = dataclasses.make_dataclass(
        "Options", [*kinds, recipe, NAMED_SCENE, resume, any_ranks, trust]
    )
    with hands_named(base.run.env):
        given: Any = flags.parse(options, args, "tactilerl train", options(**base.parts), TRAIN)
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
        hint = nearest(env, hands.HANDS)
        raise InputError(f"{error} ({hint}--env {env} is none of {hands.allowed()})") from error
