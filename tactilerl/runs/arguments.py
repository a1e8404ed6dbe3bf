"""The flags of a run, and of the scene that it has."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import tyro

from ..algos import recipes
from ..envs import hands, scenes, validation
from ..envs.grasp import GraspConfig
from ..envs.validation import nearest
from ..errors import InputError
from ..terminal import flags
from ..terminal.help import About
from .config import RunConfig
from .run_dir import resolve


def _extra(
    field: str, default: Any, about: str, kind: Any = str, **named: Any
) -> tuple[str, Any, Any]:
    """A field of a flag that is in no part of a run's configuration."""
    return field, Annotated[kind, tyro.conf.arg(help=about, **named)], default


ABOUT = f"A named scene ({', '.join(scenes.names())}) or a scene's .toml file; other flags override it."
NAMED_SCENE = _extra("scene", "", ABOUT)
TRUST = "With --resume: allow importing the module named in the environment's id."
RESUME = (
    _extra(
        "resume",
        "",
        "Continue the run in this folder from its last full epoch.",
        metavar="RUN",
    ),
    _extra("trust", False, TRUST, bool),
)
TRAIN = About(
    "Train a policy. The flags and their defaults depend on --scene, --algo and --env. "
    "Without --scene and --recipe, the defaults are the paper's.",
    first=(
        "scene", "algo", "env", "layout", "touch", "task", "recipe", "total_timesteps", "seed",
        "workers", "tensorboard", "out", "resume",
    ),
    examples=(
        "tactilerl train --scene handover",
        "tactilerl train --scene handover --touch off",
        "tactilerl train --algo ddpg_her --layout 4 --total-timesteps 26000",
        "tactilerl train --resume runs/X --total-timesteps 1000000",
    ),
)  # fmt: skip


def defaults(args: Sequence[str]) -> RunConfig:
    """The configuration before most flags: it depends on these."""
    deciding = ("algo", "env", "recipe", "scene", "resume")
    given = {name: flags.peek(args, f"--{name}") for name in deciding}
    return resolve(**given, trust="--trust" in args)


def read(args: Sequence[str], base: RunConfig) -> tuple[RunConfig, Any]:
    """All flags of `train`, over the defaults `base`; and those that are not of the configuration."""
    names = tuple(recipes.recipes(base.run.algo))
    known: Any = Literal[names]
    about = "A set of hyperparameters, which other flags override; default: the scene's, or paper."
    recipe = _extra(
        "recipe", None, about, known | None, metavar=f"{{{','.join(names)}}}"
    )
    more = (recipe, NAMED_SCENE, *RESUME)
    given = read_parts(base.run.env, base.parts, args, "tactilerl train", TRAIN, *more)
    return dataclasses.replace(
        base, **{name: getattr(given, f"{name}_part") for name in base.parts}
    ), given


def read_parts(
    env: str,
    parts: Mapping[str, Any],
    args: Sequence[str],
    prog: str,
    about: About,
    *more: Any,
) -> Any:
    """The flags over the values of several dataclasses, NAME_part each, and `more` of them.

    Where a flag of a scene is refused because `env` is no hand, it is said which hands there are.
    """
    kinds = [
        (f"{name}_part", type(part)) for name, part in parts.items()
    ]  # no flag has such a name
    options = dataclasses.make_dataclass("Options", [*kinds, *more])
    usual = options(**{f"{name}_part": part for name, part in parts.items()})
    try:
        return flags.parse(options, args, prog, about, usual)
    except InputError as error:
        refused = str(error).partition("'--")[2].partition("'")[0].partition("=")[0]
        if hands.is_hand(env) or refused.replace("-", "_") not in validation.names(
            GraspConfig
        ):
            raise
        hint = nearest(env, hands.HANDS)
        raise InputError(
            f"{error} ({hint}--env {env} is none of {hands.allowed()})"
        ) from error
