"""Hold a run's configuration: options of the run, choices of the scene, hyperparameters.

Each command-line flag is a field of one of these dataclasses; `--algo`, `--env` and
`--recipe` decide which dataclasses there are and what the defaults are.
"""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from .. import algos, envs
from ..algos import recipes
from ..envs import hands, layouts, plugins, scenes, sensors, validation
from ..envs.grasp import GraspConfig, GraspEnv, setup
from ..envs.scenes import NamedScene
from ..envs.validation import require_known, require_one_of
from ..errors import InputError, input_errors
from ..machine import WorkerCount


@dataclass(frozen=True)
class RunOptions:
    """Options of a run: what is trained, how long, and where it is written."""

    algo: str = "ppo"
    """Learner: ppo or ddpg_her."""
    env: str = "shadow"
    """A hand (shadow, mpl, allegro, or a hand's .toml file), a toy (lqr, point-reach),
    or the id of a Gymnasium environment with Box or goal-Dict observations and Box
    actions."""
    total_timesteps: Annotated[int, "[1, 1e15]"] = 500_000
    """Environment steps of the whole run, over all processes."""
    workers: WorkerCount = None
    """Episodes played side by side in each process, which also learns on up to two of
    these cores; default: one per free core. Results do not depend on it."""
    seed: Annotated[int, "[0, 4294967295]"] = 0
    """Random seed of the whole run."""
    out: str | None = None
    """Run folder; default: runs/ALGO_ENV_..._sSEED. A run that is already there
    continues if its flags are the same."""
    device: str = "cpu"
    """PyTorch device of the networks, such as cuda."""
    n_test_episodes: Annotated[int, "[0, 100000]"] = 0
    """Episodes of a test at the end of the run, without exploration noise: the first
    that `evaluate` plays, in the scene of the training. Studies: 200 unless they say
    otherwise."""
    tensorboard: bool = False
    """Also write TensorBoard events (extra: tensorboard)."""


PARTS = ("run", "scene", "learner")
# Fields that may differ between a run and its continuation: they do not change its
# course.
FREE_ON_RESUME = {"total_timesteps", "workers", "out", "tensorboard", "n_test_episodes"}
LENGTH_COUNTS = (
    " and anneals (--anneal-lr and the like) to zero over that length, so it cannot be extended: "
    "begin a run of the whole length, or one without annealing"
)
FINAL_TEST = "final_test_success_rate"
"""Column of progress.csv: empty but in the last row of a run that is tested at its
end."""
HAND_COPY = "hand.toml"  # in the run folder, when the hand is none of the library's
LAYOUT_COPY = "layout.toml"  # in the run folder, when the layout is a file


@dataclass(frozen=True)
class RunConfig:
    """Everything a run depends on; `scene` is None for environments that are not ours."""

    run: RunOptions
    scene: GraspConfig | None
    learner: Any
    folder: Path | None = None
    """The run's folder, once it exists: its copies of a layout's and a hand's file
    count."""
    hand: str = ""
    """Digest of the files of a hand of one's own (`hands.digest`) with which the run
    was made."""

    @property
    def parts(self) -> dict[str, Any]:
        """The parts that there are, by name."""
        parts = {name: getattr(self, name) for name in PARTS}
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def names(self) -> set[str]:
        """Names of all fields of the parts."""
        return {name for part in self.parts.values() for name in vars(part)}

    def choose(self, choices: Mapping[str, Any]) -> RunConfig:
        """Return a copy with other values of some fields; ValueError naming what is wrong with them."""
        require_known(choices, self.names)
        chosen = {}
        for name, part in self.parts.items():
            values = {k: v for k, v in choices.items() if k in vars(part)}
            choose = sensors.choose if name == "scene" else validation.replace
            chosen[name] = choose(part, values)
        config = dataclasses.replace(self, **chosen)
        config.validate()
        return config

    def validate(self) -> None:
        """Raise ValueError naming the first invalid field."""
        validation.require(RunOptions, vars(self.run))
        for part in (self.scene, self.learner):
            if part is not None:
                validation.validate(part)

    @property
    def make_env(self) -> Callable[..., Any]:
        """The function that makes one environment; it can be pickled.

        InputError as `place` raises it.
        """
        env, scene = self.place
        if scene is None:
            return partial(envs.make, env)
        return partial(GraspEnv, env, scene)

    @property
    def place(self) -> tuple[str, GraspConfig | None]:
        """The environment's name or its hand, and the scene, with the run's own copies of files.

        InputError when that would import a module that nobody has asked for, or the
        files of its hand have gone or changed.
        """
        env, scene = self.run.env, self.scene
        module, colon, _ = env.partition(":")
        if colon and module not in sys.modules:  # the folder may be somebody else's
            raise InputError(
                f"env: found {env!r}, of the module {module}; if you trust it, give --import {module}"
            )
        if self.hand:
            env = self._copy(HAND_COPY, env)
            with input_errors(f"{self.folder}: the hand of this run cannot be read"):
                digest = hands.digest(env)
            if digest != self.hand:
                raise InputError(
                    f"{self.folder}: the files of this run's hand ({env}) have "
                    "changed since it was made; put the old ones back"
                )
        if scene is not None and scene.hand_seed is None:
            scene = dataclasses.replace(scene, hand_seed=self.run.seed)
        if scene is not None and self.layout_file:
            layout = self._copy(LAYOUT_COPY, scene.layout)
            scene = dataclasses.replace(scene, layout=layout)
        return env, scene

    def _copy(self, name: str, original: str) -> str:
        """Return the path of the run's copy of a file, or that of the original where there is none."""
        copy = Path(self.folder or "", name)
        return str(copy) if self.folder and copy.is_file() else original

    @property
    def layout_file(self) -> Path | None:
        """The user's layout file, if the layout is one."""
        layout = self.scene.layout if self.scene else ""
        return Path(layout) if layouts.is_file(layout) else None

    @property
    def again(self) -> str:
        """The flags that a command needs besides the folder: modules to import."""
        return "".join(f" --import {module}" for module in plugins.imported)

    def name(self) -> str:
        """Return the default name of the run's folder."""
        scene, env = self.scene, self.run.env
        if scene is None:
            parts = [re.sub("[/:]", "-", env)]
        else:
            layout = f"layout{layouts.short(scene.layout)}"
            parts = [hands.file(env).stem, scene.task, layout, f"touch-{scene.touch}"]
        return "_".join([self.run.algo, *parts, f"s{self.run.seed}"])

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for config.json."""
        parts = {name: dataclasses.asdict(part) for name, part in self.parts.items()}
        return dict.fromkeys(PARTS) | parts

    def difference(self, other: RunConfig) -> str | None:
        """Return the first field in which `other` is another run; None if it may continue this one."""
        # What is annealed follows from the length.
        free = FREE_ON_RESUME - {"total_timesteps" if self.learner.anneals else ""}
        for name, part in self.parts.items():
            theirs = vars(getattr(other, name))
            for key, value in vars(part).items():
                if key not in free and theirs[key] != value:
                    why = LENGTH_COUNTS if key == "total_timesteps" else ""
                    return f"{key}: found {theirs[key]!r}, the run was made with {value!r}{why}"
        return None


def defaults(
    algo: str | None = None,
    env: str | None = None,
    recipe: str | None = None,
    scene: str | None = None,
) -> RunConfig:
    """Return the configuration before any flag: the paper's, but for what a named scene says.

    With another learner than the scene's own, only what the scene says for that one
    counts (`[train.ddpg_her]`). Raises InputError for an unknown algorithm, recipe,
    environment or scene.
    """
    names = {"algo": algo, "env": env, "recipe": recipe, "scene": scene}
    with input_errors(f"scene {scene}" if scene else ""):
        for name, value in names.items():
            validation.require_type(value, str | None, name)
        named = scenes.load(scene) if scene else NamedScene()
        env = env or named.env
        others = {name: x for name, x in named.train.items() if isinstance(x, dict)}
        require_known(others, algos.ALGORITHMS, "train")
        its_own = named.train.get("algo", RunOptions.algo)
        algo = algo or validation.require_type(its_own, str, "algo")
        train = {"recipe": recipes.PAPER, **(named.train if algo == its_own else {})}
        train |= others.get(algo, {})
        train = {name: x for name, x in train.items() if name not in {"algo", *others}}
        usual = train.pop("recipe")
        require_one_of(algos.ALGORITHMS, algo, "algo")
        paper, grasp = algos.ALGORITHMS[algo], None
        learner = recipes.recipe(algo, recipe or usual)
        if recipe:  # its values, not those that the scene's own recipe has there
            train = {name: x for name, x in train.items() if name not in vars(learner)}
        if hands.is_hand(env):
            grasp = setup(env, **{"task": paper.task, **named.on(env)})
        elif scene:
            raise ValueError(f"env: found {env!r}, allowed: {hands.allowed()}")
        run = RunOptions(algo=algo, env=env, total_timesteps=paper.total_timesteps)
        return RunConfig(run, grasp, learner).choose(train)


def configure(choices: Mapping[str, Any]) -> RunConfig:
    """Return the validated configuration that some choices make, by the names of fields.

    `algo`, `env`, `recipe` and `scene` decide which fields there are and their
    defaults; values are plain, as TOML or JSON has them. Raises InputError naming the
    first that is wrong.
    """
    deciding = {key: choices.get(key) for key in ("algo", "env", "recipe", "scene")}
    rest = {k: v for k, v in choices.items() if k not in ("recipe", "scene")}
    with input_errors():
        config = defaults(**deciding)
        require_known(choices, config.names | {"recipe", "scene"})
        return config.choose(rest)


def from_dict(data: dict[str, Any]) -> RunConfig:
    """Return the configuration that `as_dict` made a dict of; InputError when it is not one."""
    try:
        run = validation.fill(RunOptions, data["run"], "run")
        config_type, _ = algos.get(run.algo)
        scene = None
        if data["scene"] is not None:
            scene = validation.fill(GraspConfig, data["scene"], "scene")
        learner = validation.fill(config_type, data["learner"], "learner")
        return RunConfig(run, scene, learner)
    except (KeyError, TypeError, ValueError) as error:
        problem = f"no {error}" if isinstance(error, KeyError) else error
        raise InputError(
            f"not a configuration of this version, which reads runs of 0.5.0 on: {problem}"
        ) from error
