"""`tactilerl evaluate`: a trained run, as it was trained or with other sensors."""

from __future__ import annotations

import dataclasses
import json
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.table import Table

from ..algos import UnfitError
from ..algos.mpi import Communicator
from ..envs import validation
from ..envs.observations import SensorConfig
from ..errors import InputError, input_errors
from ..machine import WorkerCount
from ..runs import evaluation, policies, sweep
from ..runs.config import RunConfig
from ..runs.run_dir import RunDir
from ..runs.training import start_workers
from ..terminal import flags
from ..terminal.console import console, progress
from ..terminal.help import About

ABOUT = About(
    "Success rate and return of a trained run, with confidence intervals. Sensor flags replace the "
    "sensor settings of the training.",
    first=("run", "episodes", "stochastic", "taxel_dead", "sweep", "workers", "json"),
    examples=(
        "tactilerl evaluate runs/X",
        "tactilerl evaluate runs/X --sweep taxel-dead 0 0.1 0.2 0.5",
    ),
)


@dataclass(frozen=True)
class EvaluateFlags:
    """Flags of `tactilerl evaluate`."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    episodes: evaluation.EpisodeCount = 100
    """Number of episodes, whose starts do not occur in training."""
    stochastic: bool = False
    """Keep the exploration noise."""
    workers: WorkerCount = None
    """Episodes played side by side; default: one per free core."""
    env: str = ""
    """The run's environment id, repeated to allow importing the module that it names."""
    trust: bool = False
    """Allow that import without repeating the id."""
    touch: Literal["on", "off"] | None = None
    """What the policy reads of its taxels, as in training; default: the run's."""
    sweep: tuple[str, ...] = ()
    """A sensor flag or touch, and the values to try, such as --sweep taxel-dead 0 0.1 0.2 0.5."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """`tactilerl evaluate RUN`"""
    read, sensors = _read(
        args, SensorConfig()
    )  # which run, before its sensors are known
    saved = RunDir(read.run).read_config(read.env, read.trust).scene
    if saved is None:
        read = flags.parse(EvaluateFlags, args, "tactilerl evaluate", ABOUT)
    else:
        names = validation.names(SensorConfig)
        read, sensors = _read(
            args, SensorConfig(**{name: getattr(saved, name) for name in names})
        )
    trained = policies.read_run(read.run, read.env, read.trust)
    run = trained.config
    about: dict[str, Any] = {
        "run": str(read.run), "epoch": trained.epoch, "env_steps": trained.env_steps,
        "stochastic": read.stochastic,
    }  # fmt: skip
    if run.scene is not None:
        chosen = vars(sensors) | {"touch": read.touch or run.scene.touch}
        others = {k: v for k, v in chosen.items() if v != getattr(run.scene, k)}
        run = dataclasses.replace(run, scene=dataclasses.replace(run.scene, **others))
        about |= {"sensors": others} if others else {}
    elif read.touch:
        raise InputError(
            f"--touch: found a run on {run.run.env!r}, allowed one of a grasping scene"
        )
    name, values, runs = (
        sweep.vary(run, read.sweep) if read.sweep else ("", [""], [run])
    )
    _require_taxels(trained.config, runs)
    rows = [evaluation.summarise(_play(each, trained.policy, read)) for each in runs]
    result = about | rows[0]
    if read.sweep:
        points = [{name: value, **row} for value, row in zip(values, rows, strict=True)]
        result = {**about, "sweep": name, "points": points}
    if read.json:
        print(json.dumps(result))
    else:
        console.print(_table(result))
    return 0


def _require_taxels(trained: RunConfig, runs: list[RunConfig]) -> None:
    """InputError where a policy would be shown more or fewer inputs than it was trained with."""
    for run in runs:
        touches = [
            each.scene.touch for each in (trained, run) if each.scene is not None
        ]
        if touches.count("absent") == 1:
            own, found = touches
            raise InputError(f"--touch: found {found} for a run that was trained with touch {own}; its "
                             "policy has another number of inputs")  # fmt: skip


def _read(args: list[str], sensors: SensorConfig) -> tuple[EvaluateFlags, SensorConfig]:
    """The flags, and the sensors: these, but for flags that say otherwise."""
    kinds: list[Any] = [
        ("command_part", EvaluateFlags),
        ("sensor_part", SensorConfig, sensors),
    ]
    options: Any = dataclasses.make_dataclass("Options", kinds)
    read = flags.parse(options, args, "tactilerl evaluate", ABOUT)
    return read.command_part, read.sensor_part


def _play(run: RunConfig, policy: Any, read: EvaluateFlags) -> list[dict[str, Any]]:
    """Play an evaluation's episodes; a row each."""
    with input_errors():
        workers = start_workers(run, Communicator(), read.workers)
    rows = []
    with closing(workers), progress("playing", read.episodes, not read.json) as tick:
        try:
            for episode in workers.play(
                evaluation.task(policy, read.stochastic), range(read.episodes)
            ):
                rows.append(evaluation.row(episode))
                tick()
        except UnfitError as error:
            raise InputError(str(error)) from error
    return rows


def _table(result: dict[str, Any]) -> Table:
    """Which policy, with which sensors where they are not those of the run, and how good it is."""
    others = (
        f"{name.replace('_', '-')} {value}"
        for name, value in result.get("sensors", {}).items()
    )
    about = ", ".join([result["run"], f"epoch {result['epoch']}", *others])
    # A policy that has just begun to learn may succeed with its exploration noise only.
    noise = "without exploration noise; --stochastic plays with it"
    table = Table(caption="with exploration noise" if result["stochastic"] else noise)
    if "sweep" in result:
        name, points = result["sweep"], result["points"]
        table.title = f"{about}, {points[0]['episodes']} episodes each"
        for column in (
            name.replace("_", "-"),
            "success rate",
            "95 % interval",
            "return",
        ):
            table.add_column(column)
        for point in points:
            table.add_row(
                *_row(point, "success_rate", str(point[name])),
                f"{point['mean_return']:.2f}",
            )
        return table
    table.title = f"{about}, {result['episodes']} episodes"
    for column in ("", "mean", "95 % interval"):
        table.add_column(column)
    if "success_rate" in result:
        table.add_row(*_row(result, "success_rate", "success rate"))
        if result["mean_held_steps"] > 1:  # where success does not end the episode
            table.add_row(
                "steps at the goal, at the end", f"{result['mean_held_steps']:.1f}", ""
            )
    table.add_row(*_row(result, "mean_return", "return", ".2f"))
    table.add_row("length", f"{result['mean_length']:.1f}", "")
    for fault, what in (("diverged", "diverged episodes"), ("warnings", "warnings")):
        if result[fault]:
            table.add_row(what, str(result[fault]), "")
    return table


def _row(
    result: dict[str, Any], measure: str, what: str, form: str = ".3f"
) -> tuple[str, str, str]:
    """What it is, its value, and its interval."""
    low, high = result[f"{measure}_ci"]
    return what, format(result[measure], form), f"{low:{form}} – {high:{form}}"
