"""What a run is made of: options of the run, choices of the scene, hyperparameters.

Each command-line flag is a field of one of these dataclasses; `--algo`, `--env` and `--recipe`
decide which dataclasses there are and what the defaults are.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from .. import algos, envs
from ..algos import recipes
from ..envs import hands, layouts, plugins, scenes, validation
from ..envs.grasp import GraspConfig, GraspEnv, setup
from ..envs.scenes import NamedScene
from ..envs.validation import nearest, require_known
from ..errors import PEERS, InputError, input_errors
from ..machine import WorkerCount


@dataclass(frozen=True)
class RunOptions:
    """What is trained, how long, and where it is written."""

    algo: str = "ppo"
    """Learner: ppo or ddpg_her."""
    env: str = "shadow"
    """A hand (shadow, mpl, allegro, or a hand's .toml file), a toy (lqr, point-reach), or the id of a
    Gymnasium environment with Box or goal-Dict observations and Box actions."""
    total_timesteps: Annotated[int, "[1, 1e15]"] = 500_000
    """Environment steps of the whole run, over all processes."""
    workers: WorkerCount = None
    """Episodes played side by side in each process, which learns on as many cores, up to two; default:
    one per free core. Results do not depend on it."""
    seed: Annotated[int, "[0, 4294967295]"] = 0
    """Random seed of the whole run."""
    out: str | None = None
    """Run folder; default: runs/ALGO_ENV_..._sSEED. A run that is already there continues if its flags
    are the same."""
    device: str = "cpu"
    """PyTorch device of the networks, such as cuda."""
    threads: Annotated[int, "[1, 1000]"] = 1
    """PyTorch threads. Another number can change the last digits of the results."""
    tensorboard: bool = False
    """Also write TensorBoard events (extra: tensorboard)."""

    def validate(self) -> None:
        """Raise ValueError where the environment cannot be one; ranges are in the types."""
        if not (ENV_ID.fullmatch(self.env) or hands.is_hand(self.env)):
            raise ValueError(f"env: found {self.env!r}, allowed a name, a hand's .toml file, an id or "
                             "module:id")  # fmt: skip


PARTS = ("run", "scene", "learner")
ENV_ID = re.compile(
    r"(([^\W\d]\w*)(\.[^\W\d]\w*)*:)?[\w/.-]+"
)  # that of Gymnasium, [module:]id
# Fields that may differ between a run and its continuation: they do not change its course.
FREE_ON_RESUME = {"total_timesteps", "workers", "out", "tensorboard"}
LAYOUT_COPY = "layout.toml"  # in the run folder, when the layout is a file


@dataclass(frozen=True)
class RunConfig:
    """Everything a run depends on; `scene` is None for environments that are not ours."""

    run: RunOptions
    scene: GraspConfig | None
    learner: Any
    folder: Path | None = None
    """The run's folder, once it exists: its copy of a layout file counts, not the original."""
    hand: str = ""
    """Digest of the files of a hand of one's own (`hands.digest`) with which the run was made."""

    @property
    def parts(self) -> dict[str, Any]:
        """Those that there are, by name."""
        return {
            name: part for name in PARTS if (part := getattr(self, name)) is not None
        }

    def choose(self, choices: Mapping[str, Any]) -> RunConfig:
        """A copy with other values of some fields, by name; ValueError naming an unknown field."""
        own = {name: validation.names(part) for name, part in self.parts.items()}
        require_known(choices, set().union(*own.values()), PEERS)
        chosen = {}
        for name, part in self.parts.items():
            values = {k: v for k, v in choices.items() if k in own[name]}
            for k, value in values.items():  # one value stands for a tuple of one
                if isinstance(getattr(part, k), tuple) and np.isscalar(value):
                    values[k] = (value,)
            chosen[name] = validation.replace(part, values)
        return dataclasses.replace(self, **chosen)

    def validate(self) -> None:
        """Raise ValueError naming the first invalid field."""
        for part in self.parts.values():
            validation.validate(part)
        if (self.scene is None) == hands.is_hand(self.run.env):
            found = "no scene" if self.scene is None else "a scene"
            raise ValueError(f"env: found {self.run.env!r} with {found}")

    @property
    def make_env(self) -> Callable[..., Any]:
        """A function that makes one environment; can be pickled.

        InputError when that would import a module that nobody has asked for, or the files of its
        hand have gone or changed.
        """
        module, colon, _ = self.run.env.partition(":")
        if colon and module not in sys.modules:  # the folder may be somebody else's
            raise InputError(
                f"env: found {self.run.env!r}, of the module {module}; if you trust it, give "
                f"--import {module}"
            )
        if self.hand:
            with input_errors(f"{self.folder}: the hand of this run cannot be read"):
                found = hands.digest(self.run.env)
            if found != self.hand:
                raise InputError(
                    f"{self.folder}: the files of this run's hand ({self.run.env}) have changed since "
                    "it was made; put the old ones back"
                )
        if self.scene is None:
            return partial(envs.make, self.run.env)
        choices: dict[str, Any] = {}
        if self.scene.hand_seed is None:
            choices["hand_seed"] = self.run.seed
        if self.layout_file and self.folder and (self.folder / LAYOUT_COPY).is_file():
            choices["layout"] = str(self.folder / LAYOUT_COPY)
        return partial(
            GraspEnv, self.run.env, dataclasses.replace(self.scene, **choices)
        )

    @property
    def layout_file(self) -> Path | None:
        """The user's layout file, if the layout is one."""
        is_file = self.scene is not None and layouts.is_file(self.scene.layout)
        return Path(self.scene.layout) if self.scene is not None and is_file else None

    @property
    def again(self) -> str:
        """The flags that a command needs besides the folder: modules to import."""
        return "".join(f" --import {module}" for module in plugins.imported)

    def name(self) -> str:
        """Default name of the run's folder."""
        env = (
            hands.file(self.run.env).stem
            if hands.is_hand(self.run.env)
            else self.run.env
        )
        parts = [self.run.algo, re.sub("[/:]", "-", env)]
        if self.scene is not None:
            scene = self.scene
            parts += [
                scene.task,
                f"layout{layouts.short(scene.layout)}",
                f"touch-{scene.touch}",
            ]
        return "_".join([*parts, f"s{self.run.seed}"])

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for config.json."""
        return dict.fromkeys(PARTS) | {
            k: dataclasses.asdict(part) for k, part in self.parts.items()
        }

    def identity(self) -> dict[str, Any]:
        """What makes it this run: plain values without those that may change on resume."""
        parts = json.loads(json.dumps(self.as_dict()))
        counts = (
            {"total_timesteps"} if getattr(self.learner, "anneals", False) else set()
        )
        for name in FREE_ON_RESUME - counts:
            del parts["run"][name]
        return parts

    def difference(self, other: dict[str, Any]) -> str | None:
        """The first field in which `other`, another's identity, is another run; None if none."""
        for part, mine in self.identity().items():
            a, b = mine or {}, other.get(part) or {}
            if part == "learner":
                a, b = (recipes.completed(self.run.algo, values) for values in (a, b))
            for key in {**a, **b}:
                if a.get(key) != b.get(key):
                    return f"{key}: found {b.get(key)!r}, the run was made with {a.get(key)!r}"
        return None


def defaults(
    algo: str | None = None,
    env: str | None = None,
    recipe: str | None = None,
    scene: str | None = None,
) -> RunConfig:
    """The configuration before any flag: the paper's, but for what a named scene says. InputError for
    an unknown algorithm, recipe, environment or scene.

    With another learner than the scene's own, the scene's hyperparameters are left out.
    """
    with input_errors():
        named = scenes.load(scene) if scene else NamedScene(env=RunOptions.env)
        for name in ("algo", "recipe"):
            validation.require_type(
                named.train.get(name, ""), str, f"scene {scene}: train: {name}"
            )
    own, env = named.train.get("algo", RunOptions.algo), env or named.env
    if scene and algo not in (None, own):
        defaults(scene=scene)  # what is left out is checked as well
    algo = algo or own
    train = {k: v for k, v in named.train.items() if k != "algo"} if algo == own else {}
    usual = train.pop("recipe", recipes.PAPER)
    if algo not in (known := algos.ALGORITHMS):
        hint = nearest(algo, known)
        raise InputError(
            f"--algo: unknown algorithm {algo!r}; {hint}allowed: {', '.join(known)}"
        )
    with input_errors(f"scene {scene}: train"):
        require_known(
            train, {"total_timesteps", *validation.names(algos.get(algo)[0])}, PEERS
        )
    if scene and not hands.is_hand(env):
        raise InputError(
            f"--env: found {env!r} with --scene, allowed: {hands.allowed()}"
        )
    paper = known[algo]
    with input_errors(f"scene {scene}" if scene else ""):
        config = RunConfig(
            RunOptions(algo=algo, env=env, total_timesteps=paper.total_timesteps),
            setup(env, **{"task": paper.task, **named.on(env)})
            if hands.is_hand(env)
            else None,
            recipes.recipe(algo, recipe or usual),
        ).choose(train)
        config.validate()
        return config


def configure(choices: Mapping[str, Any]) -> RunConfig:
    """Return the validated configuration that some choices make, by the names of fields.

    `algo`, `env`, `recipe` and `scene` decide which fields there are and their defaults; values
    are plain, as TOML or JSON has them. Raises InputError naming the first that is wrong.
    """
    deciding = {key: choices.get(key) for key in ("algo", "env", "recipe", "scene")}
    rest = {k: v for k, v in choices.items() if k not in ("recipe", "scene")}
    with input_errors():
        for key, value in deciding.items():
            validation.require_type(value, str | None, key)
        config = defaults(**deciding).choose(rest)
        config.validate()
    return config


def from_dict(data: dict[str, Any]) -> RunConfig:
    """The configuration that `as_dict` wrote; InputError when it is not one."""
    try:
        run = validation.make(RunOptions, data["run"], "run")
        config_type, _ = algos.get(run.algo)
        scene = (
            None
            if data["scene"] is None
            else validation.make(GraspConfig, data["scene"], "scene")
        )
        learner = recipes.completed(run.algo, data["learner"])
        config = RunConfig(run, scene, validation.make(config_type, learner, "learner"))
        config.validate()
        return config
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"not a configuration of this version: {error}") from error
