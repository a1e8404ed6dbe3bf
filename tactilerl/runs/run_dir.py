"""The run folder: config.json, progress.csv, checkpoint.pt, and what a learner remembers.

A folder can be cut off at any moment (`kill -9`, a full disk) and stays readable: files are
replaced whole, and the progress table is cut back to the checkpoint when a run goes on. One
process writes to it: who makes it or goes on with it holds its lock.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated, Any

from .. import machine
from ..algos import recipes
from ..envs import hands, layouts, plugins, scenes
from ..envs.validation import require_type
from ..errors import InputError, input_errors
from ..files import damage_named, read_json, replacing, writable
from .config import LAYOUT_COPY, PARTS, RunConfig, defaults, from_dict
from .progress_csv import ProgressTable

FORMAT = 3  # of all files in a run folder; 1 and 2 are those of 0.1
Values = dict[str, Any]
RECORD: dict[str, Any] = {"run": Values, "scene": Values | None, "learner": Values}
RECORD |= {"ranks": Annotated[int, "[1, inf)"], "provenance": list[machine.Origin]}


class RunDir:
    """One run's files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / "config.json"
        self.progress = ProgressTable(path / "progress.csv")
        self.checkpoint_file = path / "checkpoint.pt"
        self.experience_folder = path / "experience"

    def settled(self, config: RunConfig) -> RunConfig:
        """The configuration of a run here. InputError where one is here already that is another run."""
        config = dataclasses.replace(config, folder=self.path)
        if not os.path.exists(self.config_file):  # False for any name
            return config
        saved = self.read_config()
        if difference := saved.difference(config.identity()):
            raise InputError(
                f"{self.path}: {difference}; a continued run keeps its settings (another --out "
                "makes another run)"
            )
        return dataclasses.replace(config, hand=saved.hand)

    def create(self) -> None:
        """Make the folder where there is none; InputError where that cannot be, or it is no run's."""
        with writable(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            names = {path.name for path in self.path.iterdir() if path.suffix != ".tmp"}
        if not (self.config_file.exists() or names <= {".lock"}):
            raise InputError(
                f"folder {str(self.path)!r} exists but is not a run folder; choose another with --out"
            )

    def write_config(
        self, config: RunConfig, ranks: int, epoch: int = 0, env_steps: int = 0
    ) -> str:
        """Write config.json: every value, the number of ranks, and with what it was made.

        A run that goes on after `epoch` with other versions keeps the record of those before;
        returns in words what changed.
        """
        records = self.record()["provenance"] if self.config_file.exists() else []
        now = machine.origin(epoch, env_steps)
        changed = machine.difference(records[-1], now) if records else ""
        if changed or not records:
            records.append(now)
        content = {
            "format": FORMAT,
            **config.as_dict(),
            "ranks": ranks,
            "provenance": records,
        }
        if hand := config.hand or hands.digest(config.run.env):
            content["hand"] = hand
        with replacing(self.config_file) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())
        if config.layout_file and not (self.path / LAYOUT_COPY).exists():
            with replacing(self.path / LAYOUT_COPY) as file:
                file.write(layouts.load(str(config.layout_file)).toml().encode())
        return changed

    def read_config(self) -> RunConfig:
        """Return the run's configuration; raise InputError when there is none."""
        data = self.record()
        with damage_named(self.config_file):
            config = from_dict({name: data[name] for name in PARTS})
        hand = str(data.get("hand", ""))
        return dataclasses.replace(config, folder=self.path, hand=hand)

    def record(self) -> dict[str, Any]:
        """What config.json holds, with values of this version or another; InputError when damaged."""
        if os.path.isfile(self.path):  # False where the name is too long
            raise InputError(
                f"{str(self.path)!r} is a file, allowed the folder of a run; a saved policy is for "
                "Python (tactilerl.load_policy)"
            )
        missing = f"{str(self.path)!r} is not a run folder: no config.json in it"
        with damage_named(self.config_file, "not a run's configuration", missing):
            return as_record(read_json(self.config_file))


def as_record(data: Any) -> dict[str, Any]:
    """The values of a config.json, of this version or another, by their names in this one; ValueError
    where they are something else."""
    require_type(data, dict[str, Any], "record")
    if data.get("format") != FORMAT:
        raise ValueError(
            f"not of format {FORMAT}; continue runs of version 0.1 with that version"
        )
    for name, kind in RECORD.items():
        if name not in data:
            raise ValueError(f"no {name!r} in it")
        require_type(data[name], kind, name)
    for name in ("algo", "env"):
        require_type(data["run"].get(name), str, name)
    return with_new_names(data)


def with_new_names(parts: dict[str, Any]) -> dict[str, Any]:
    """The parts of a run, named as in this version, which has one precision."""
    run = parts.get("run", {}).items()
    run = {name: value for name, value in run if (name, value) != ("matmul", "float32")}
    scene = parts.get("scene") and scenes.renamed(parts["scene"])
    if scene and scene.get("critic_sees") == "observation":  # of 0.4.0
        del scene["critic_sees"]
    return parts | {"run": run, "scene": scene}


def resolve(
    algo: str | None = None,
    env: str = "",
    recipe: str | None = None,
    scene: str | None = None,
    resume: str | Path | None = None,
) -> RunConfig:
    """Return the configuration before other choices: `config.defaults`, or that of the run in
    the folder `resume`. Imports the module that `env` names. InputError where there is no such
    run, or a scene is named as well."""
    module, colon, _ = env.partition(":")
    if colon:
        with input_errors("env"):
            plugins.import_modules([module])
    if not resume:
        return defaults(algo, env, recipe, scene)
    if scene:
        raise InputError("scene: found with resume; a resumed run keeps its settings")
    saved = RunDir(Path(resume)).read_config()
    if env not in ("", saved.run.env):
        raise InputError(f"env: found {env!r}, the run was made with {saved.run.env!r}")
    if recipe:
        with input_errors():
            learner = recipes.recipe(saved.run.algo, recipe)
        saved = dataclasses.replace(saved, learner=learner)
    return saved
