"""`tactilerl evaluate`: a trained run, as it was trained or with other sensors."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from ..algos import UnfitError
from ..algos.mpi import Communicator
from ..envs.observations import SensorConfig
from ..errors import InputError, input_errors
from ..runs import evaluation, policies, sweep
from ..runs.config import RunConfig, Workers
from ..runs.run_dir import RunDir
from ..runs.training import start_workers
from ..terminal import flags
from ..terminal.console import console
from ..terminal.help import About

ABOUT = About(
    "Success rate and return of a trained run, with confidence intervals. Sensor flags play it with "
    "other sensors than it was trained with.",
    first=("run", "episodes", "stochastic", "taxel_dead", "sweep", "out", "workers", "json"),
    examples=(
        "tactilerl evaluate runs/X",
        "tactilerl evaluate runs/X --sweep taxel-dead 0 0.1 0.2 0.5 --out faults.png",
    ),
)


@dataclass(frozen=True)
class EvaluateFlags:
    """Flags of `tactilerl evaluate`."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    episodes: Annotated[int, "[1, inf)"] = 100
    """Episodes to play; their starts are not those of training."""
    stochastic: bool = False
    """Keep the exploration noise."""
    workers: Workers = None
    """Episodes played side by side; default: one per free core."""
    env: str = ""
    """The id of the run's environment once more, to allow the import of the module it names."""
    trust: bool = False
    """Allow that import without naming the environment."""
    sweep: tuple[str, ...] = ()
    """A sensor flag and the values to try: --sweep taxel-dead 0 0.1 0.2 0.5."""
    out: Path | None = None
    """With --sweep: picture to write, .png, .svg or .pdf (extra: plots)."""
    json: bool = False
    """Print JSON instead of a table."""


def main(args: list[str]) -> int:
    """`tactilerl evaluate RUN`"""
    read, sensors = _read_evaluate(args)
    if read.out is not None and not read.sweep:
        raise InputError("--out: found without --sweep, allowed only with it")
    with input_errors():
        if read.out is not None:
            sweep.require_drawable(read.out)
    trained = policies.read_run(read.run, read.env, read.trust)
    run = trained.config
    about: dict[str, Any] = {
        "run": str(read.run), "epoch": trained.epoch, "env_steps": trained.env_steps,
        "stochastic": read.stochastic,
    }  # fmt: skip
    if run.scene is not None and sensors is not None:
        others = {k: v for k, v in vars(sensors).items() if v != getattr(run.scene, k)}
        run = dataclasses.replace(run, scene=dataclasses.replace(run.scene, **others))
        about |= {"sensors": others} if others else {}
    if not read.sweep:
        result = about | evaluation.summarise(_play(run, trained.policy, read))
        return _tell(result, read.json, _evaluation_table)
    name, values, runs = sweep.vary(run, read.sweep)
    rows = [evaluation.summarise(_play(each, trained.policy, read)) for each in runs]
    points = [{name: value, **row} for value, row in zip(values, rows, strict=True)]
    if read.out is not None:
        sweep.draw(name, values, rows, read.out)
    return _tell({**about, "sweep": name, "points": points}, read.json, _sweep_table)


def _read_evaluate(args: list[str]) -> tuple[EvaluateFlags, SensorConfig | None]:
    """The flags, and the sensors: the saved ones but for flags that say otherwise; None where the
    run has no scene of ours."""
    sensors = SensorConfig()
    read, _ = _parse_evaluate(args, sensors)  # which run, before its sensors are known
    scene = RunDir(read.run).read_config(read.env, read.trust)[0].scene
    if scene is None:
        return flags.parse(EvaluateFlags, args, "tactilerl evaluate", about=ABOUT), None
    names = [field.name for field in dataclasses.fields(SensorConfig)]
    return _parse_evaluate(args, SensorConfig(**{name: getattr(scene, name) for name in names}))


def _parse_evaluate(args: list[str], sensors: SensorConfig) -> tuple[EvaluateFlags, SensorConfig]:
    kinds: list[Any] = [("command", EvaluateFlags), ("sensor", SensorConfig, sensors)]
    options: Any = dataclasses.make_dataclass("Options", kinds)
    read = flags.parse(options, args, "tactilerl evaluate", about=ABOUT)
    return read.command, read.sensor


def _play(run: RunConfig, policy: Any, read: EvaluateFlags) -> list[dict[str, Any]]:
    """Play an evaluation's episodes; a row each."""
    with input_errors():
        workers = start_workers(run, Communicator(), read.workers)
    is_shown = sys.stderr.isatty() and not read.json
    screen = Console(stderr=True)
    with closing(workers):
        played = workers.play(evaluation.task(policy, read.stochastic), range(read.episodes))
        shown = track(played, "playing", read.episodes, console=screen, disable=not is_shown)
        try:
            return [evaluation.row(episode) for episode in shown]
        except UnfitError as error:
            raise InputError(str(error)) from error


def _tell(result: dict[str, Any], as_json: bool, table: Callable[[dict[str, Any]], Table]) -> int:
    if as_json:
        print(json.dumps(result))
    else:
        console.print(table(result))
    return 0


def _about(result: dict[str, Any]) -> str:
    """Which policy, and with which sensors where they are not those of the run."""
    others = (f"{name.replace('_', '-')} {value}" for name, value in result.get("sensors", {}).items())
    return ", ".join([result["run"], f"epoch {result['epoch']}", *others])


def _caption(result: dict[str, Any]) -> str:
    """A policy that has just begun to learn may succeed with its exploration noise only."""
    if result["stochastic"]:
        return "with exploration noise"
    return "without exploration noise; --stochastic plays with it"


def _evaluation_table(result: dict[str, Any]) -> Table:
    title = f"{_about(result)}, {result['episodes']} episodes"
    table = Table("", "mean", "95 % interval", title=title, caption=_caption(result))
    if "success_rate" in result:
        low, high = result["success_rate_ci"]
        table.add_row("success rate", f"{result['success_rate']:.3f}", f"{low:.3f} – {high:.3f}")
        if result["mean_held_steps"] > 1:  # where success does not end the episode
            table.add_row("steps at the goal, at the end", f"{result['mean_held_steps']:.1f}", "")
    for part in result.get("by_object", ()):
        low, high = part["success_rate_ci"]
        what = f"success rate, {part['object']} ({part['episodes']})"
        table.add_row(what, f"{part['success_rate']:.3f}", f"{low:.3f} – {high:.3f}")
    low, high = result["mean_return_ci"]
    table.add_row("return", f"{result['mean_return']:.2f}", f"{low:.2f} – {high:.2f}")
    table.add_row("length", f"{result['mean_length']:.1f}", "")
    for fault, what in (("diverged", "diverged episodes"), ("warnings", "warnings")):
        if result[fault]:
            table.add_row(what, str(result[fault]), "")
    return table


def _sweep_table(result: dict[str, Any]) -> Table:
    name, points = result["sweep"], result["points"]
    title = f"{_about(result)}, {points[0]['episodes']} episodes each"
    columns = (name.replace("_", "-"), "success rate", "95 % interval", "return")
    table = Table(*columns, title=title, caption=_caption(result))
    for point in points:
        low, high = point["success_rate_ci"]
        rate, interval = f"{point['success_rate']:.3f}", f"{low:.3f} – {high:.3f}"
        table.add_row(str(point[name]), rate, interval, f"{point['mean_return']:.2f}")
    return table
