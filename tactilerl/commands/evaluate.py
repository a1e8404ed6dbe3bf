"""`tactilerl evaluate`: a trained run, as it was trained or with other sensors."""

from __future__ import annotations

import dataclasses
import json
import math
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.table import Table

from ..algos.mpi import Communicator
from ..algos.rollout import FAULTS
from ..envs import sensors
from ..envs.observations import SensorConfig
from ..errors import InputError, input_errors
from ..machine import WorkerCount
from ..runs import evaluation, policies
from ..runs.config import RunConfig
from ..runs.training import start_workers
from ..terminal import flags
from ..terminal.console import Progress, console
from .scene import sensor_notes, warn

ABOUT = """\
Success rate and return of a trained run, with confidence intervals. Sensor flags replace the
sensor settings of the training; those that are not given stay, whatever default they show.

examples:
  tactilerl evaluate runs/X
  tactilerl evaluate runs/X --taxel-dead 0.2"""


@dataclass(frozen=True)
class _CommandFlags:
    """Run and episodes that are played."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    episodes: evaluation.EpisodeCount = 100
    """Number of episodes, whose starts do not occur in training."""
    stochastic: bool = False
    """Keep the exploration noise."""
    workers: WorkerCount = None
    """Episodes played side by side; default: one per free core."""
    touch: Literal["on", "off"] | None = None
    """Touch for the policy: on, as in training, or off (all taxels read zero); default:
    the run's."""
    json: bool = False
    """Print JSON instead of a table, with what became of each episode:
    `render RUN --episode N` films it."""
    record: Path | None = None
    """CSV file for every step of the episodes: what was observed, done and earned, in
    named columns."""
    overwrite: bool = False
    """Replace a record that is there."""


@dataclass(frozen=True)
class EvaluateFlags:
    """Flags of `tactilerl evaluate`."""

    command: _CommandFlags
    sensors: SensorConfig = dataclasses.field(default_factory=SensorConfig)


def main(args: list[str]) -> int:
    """Run `tactilerl evaluate RUN`."""
    read = flags.parse(EvaluateFlags, args, "tactilerl evaluate", ABOUT)
    command: _CommandFlags = read.command
    trained = policies.read_run(command.run)
    if command.stochastic and not trained.explores:
        raise InputError(
            "stochastic: found with a run whose exploration noise was annealed to zero"
        )
    run, scene = trained.config, trained.config.scene
    changed: dict[str, Any] = {}
    if scene is not None:
        chosen = flags.given(read.sensors, args)
        if command.touch:
            chosen["touch"] = command.touch
            if scene.touch == "absent":  # inputs that it never had
                raise InputError(
                    f"touch: found {command.touch}, allowed absent, as the run was trained"
                )
        with input_errors():
            now = sensors.choose(scene, chosen)
        changed = {k: v for k, v in vars(now).items() if v != getattr(scene, k)}
        run = dataclasses.replace(run, scene=now)
    elif command.touch or read.sensors != SensorConfig():
        raise InputError(
            f"sensors: found with a run on {run.run.env!r}, which has no hand"
        )
    with input_errors():
        run.validate()
        env, scene = run.place
        if scene is not None:
            warn(sensor_notes(env, scene))
    played = _play(run, trained.policy, command)
    summary = evaluation.summarise(played)
    about = {
        "run": str(command.run), "epoch": trained.epoch, "env_steps": trained.env_steps,
        "stochastic": command.stochastic, **({"sensors": changed} if changed else {}),
    }  # fmt: skip
    if command.json:
        each = [{"episode": number, **row} for number, row in enumerate(played)]
        for row in each:
            row["success"] = None if math.isnan(row["success"]) else row["success"]
        print(json.dumps(about | summary | {"each": each}))
    else:
        console.print(_table(about, summary, trained.explores))
    return 0


def _play(run: RunConfig, policy: Any, command: _CommandFlags) -> list[dict[str, Any]]:
    """Play the episodes of an evaluation; return a row for each."""
    rows: list[dict[str, Any]] = []
    task = evaluation.task(policy, command.stochastic)
    tick = Progress("playing", command.episodes)
    with input_errors():
        workers = start_workers(run, Communicator(), command.workers)
        file = command.record, command.overwrite
        recorded = evaluation.recorder(*file, workers.env, policy)
        with closing(workers), recorded as record:
            for episode in workers.play(task, range(command.episodes)):
                record(len(rows), episode)
                rows.append(evaluation.row(episode))
                tick()
    return rows


def _table(about: dict[str, Any], summary: dict[str, Any], explores: bool) -> Table:
    """Return a table of how good a policy is, headed by its run and sensors."""
    changed = [f"{name} {value}" for name, value in about.get("sensors", {}).items()]
    title = ", ".join([about["run"], f"epoch {about['epoch']}", *changed])
    # A policy that has just begun to learn may succeed with its exploration noise only.
    how = "with" if about["stochastic"] else "without"
    hint = "; --stochastic plays with it" if explores and how == "without" else ""
    caption = f"{how} exploration noise{hint}"
    table = Table("", "mean", "95 % interval", title=title, caption=caption)
    for name in dict.fromkeys(["success_rate", *summary]):
        value = summary.get(name)
        is_fault = name in FAULTS and not value
        if value is None or isinstance(value, list) or is_fault:
            continue
        digits = 3 if "rate" in name else 1
        bounds = summary.get(f"{name}_ci", ())
        interval = " – ".join(f"{bound:.{digits}f}" for bound in bounds)
        shown = f"{value:.{digits}f}" if isinstance(value, float) else str(value)
        table.add_row(name.replace("_", " "), shown, interval)
    return table
