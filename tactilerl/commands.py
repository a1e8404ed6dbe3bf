"""One function per command: flags in, exit code out."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from . import config as configuration
from . import flags
from .config import RunConfig, RunOptions
from .envs import GRASP_ENVS
from .envs.grasp import GraspConfig, setup
from .envs.observations import SensorConfig
from .envs.simulators import Camera
from .errors import InputError, input_errors

console = Console(highlight=False, soft_wrap=True, markup=False)
SETTLED_NOTE = "hold_verdict=settled decides holds early; how often it is wrong: docs/concepts/tasks.md"


# -- train -----------------------------------------------------------------------------------


def train(args: list[str]) -> int:
    """`tactilerl train`"""
    from .algos import mpi
    from .run_dir import RunDir
    from .train import train as run

    resume = flags.peek(args, "--resume", "")
    algo = flags.peek(args, "--algo", RunOptions.algo)
    env = flags.peek(args, "--env", RunOptions.env if not resume else "")
    saved = RunDir(Path(resume)).read_config(env, "--trust" in args)[0] if resume else None
    config, options = read_config(args, saved or configuration.defaults(algo, env))
    for flag in ("any_ranks", "trust"):
        if getattr(options, flag) and not resume:
            raise InputError(f"--{flag.replace('_', '-')}: found without --resume, allowed with it")
    if resume and any(arg.partition("=")[0] == "--out" for arg in args):
        raise InputError("--out: a resumed run stays in its folder; leave it out")
    with input_errors():
        config.validate()
        comm = mpi.world()
    if saved and (difference := saved.difference(config.identity())):
        raise InputError(f"--resume {resume}: {difference}; a resumed run keeps its settings")
    if comm.rank == 0:
        console.print(_summary(config, comm.size))
    path = run(config, comm, Path(resume) if resume else None, options.any_ranks)
    if comm.rank == 0:
        console.print(
            f"\nThe run is in {path}: progress.csv (learning curve), checkpoint.pt, config.json.\n"
            f"  tactilerl evaluate {path}"
        )
    return 0


TRUST = "allow the import of the module in the environment's id"


def read_config(args: list[str], base: RunConfig) -> tuple[RunConfig, Any]:
    """All flags of `train`, over the defaults `base`; and those that are not of the configuration."""
    parts = {"run": base.run, "scene": base.scene, "learner": base.learner}
    parts = {name: part for name, part in parts.items() if part is not None}
    about = "continue the run in this folder from its last whole epoch"
    resume = ("resume", Annotated[str, tyro.conf.arg(help=about, metavar="RUN")], "")
    about = "with --resume: allow another number of processes; no longer the same bit for bit"
    any_ranks = ("any_ranks", Annotated[bool, tyro.conf.arg(help=about)], False)
    trust = ("trust", Annotated[bool, tyro.conf.arg(help=f"with --resume: {TRUST}")], False)
    kinds = [(name, type(part)) for name, part in parts.items()]
    options = dataclasses.make_dataclass("Options", [*kinds, resume, any_ranks, trust])
    read: Any = flags.parse(
        options,
        args,
        "tactilerl train",
        options(**parts),
        "Train a policy. Defaults are the paper's; --algo and --env decide which flags there are.",
    )
    config = RunConfig(read.run, getattr(read, "scene", None), read.learner, None, base.is_trusted)
    return config, read


def _summary(config: RunConfig, ranks: int) -> str:
    """What the run resolved to, one line per part."""
    several = f"{ranks} processes" if ranks > 1 else "1 process (mpirun -n 2 tactilerl ... for two)"
    lines = [f"tactilerl train: {several}"]
    for part, values in config.as_dict().items():
        if values:
            lines.append(f"  {part:8}" + "  ".join(f"{k}={v}" for k, v in values.items()))
    if config.scene is not None and config.scene.hold_verdict == "settled":
        lines.append(f"  note     {SETTLED_NOTE}")
    return "\n".join(lines)


# -- evaluate --------------------------------------------------------------------------------


@dataclass(frozen=True)
class EvaluateFlags:
    """Flags of `tactilerl evaluate`."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    episodes: int = 100
    """Episodes to play; their starts are not those of training."""
    stochastic: bool = False
    """Keep the exploration noise."""
    workers: int | None = None
    """Episodes played side by side; default: the free cores."""
    env: str = ""
    """The run's environment again: allows the import of the module in its id."""
    trust: bool = False
    """Allow that import without naming the environment."""
    sweep: tuple[str, ...] = ()
    """A sensor flag and the values to try: --sweep taxel-dead 0 0.1 0.2 0.5."""
    out: Path | None = None
    """With --sweep: picture to write, .png, .svg or .pdf (needs 'tactilerl[plots]')."""
    json: bool = False
    """Print JSON instead of a table."""


def evaluate(args: list[str]) -> int:
    """`tactilerl evaluate RUN`"""
    from . import evaluate as evaluation
    from . import sweep

    read, sensors = _read_evaluate(args)
    if read.out is not None and not read.sweep:
        raise InputError("--out: found without --sweep, allowed only with it")
    with input_errors():
        configuration.require_workers(read.workers)
        if read.out is not None:
            sweep.require_drawable(read.out)
    trained = evaluation.load_policy(read.run, read.env, read.trust)
    run = trained.config
    if run.scene is not None and sensors is not None:
        run = dataclasses.replace(run, scene=dataclasses.replace(run.scene, **vars(sensors)))
    about = {"run": str(read.run), "epoch": trained.epoch, "env_steps": trained.env_steps}
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
    from .run_dir import RunDir

    sensors = SensorConfig()
    read, _ = _parse_evaluate(args, sensors)  # which run, before its sensors are known
    _at_least("--episodes", read.episodes, 1)
    scene = RunDir(read.run).read_config(read.env, read.trust)[0].scene
    if scene is None:
        return flags.parse(EvaluateFlags, args, "tactilerl evaluate"), None
    names = [field.name for field in dataclasses.fields(SensorConfig)]
    return _parse_evaluate(args, SensorConfig(**{name: getattr(scene, name) for name in names}))


def _parse_evaluate(args: list[str], sensors: SensorConfig) -> tuple[EvaluateFlags, SensorConfig]:
    kinds: list[Any] = [("own", EvaluateFlags), ("sensors", SensorConfig, sensors)]
    options: Any = dataclasses.make_dataclass("Options", kinds)
    read = flags.parse(options, args, "tactilerl evaluate")
    return read.own, read.sensors


def _play(run: RunConfig, policy: Any, read: EvaluateFlags) -> list[dict[str, Any]]:
    """Play an evaluation's episodes; a row each."""
    from rich.progress import track

    from . import evaluate as evaluation
    from .algos.mpi import Communicator
    from .train import start_workers

    with input_errors():
        workers = start_workers(run, Communicator(), read.workers)
    is_shown = sys.stderr.isatty() and not read.json
    screen = Console(stderr=True)
    with closing(workers):
        played = workers.play(evaluation.task(policy, read.stochastic), range(read.episodes))
        shown = track(played, "playing", read.episodes, console=screen, disable=not is_shown)
        return [evaluation.row(episode) for episode in shown]


def _tell(result: dict[str, Any], as_json: bool, table: Callable[[dict[str, Any]], Table]) -> int:
    if as_json:
        print(json.dumps(result))
    else:
        console.print(table(result))
    return 0


def _evaluation_table(result: dict[str, Any]) -> Table:
    title = f"{result['run']}, epoch {result['epoch']}, {result['episodes']} episodes"
    table = Table("", "mean", "95 % interval", title=title)
    if "success_rate" in result:
        low, high = result["success_rate_ci"]
        table.add_row("success rate", f"{result['success_rate']:.3f}", f"{low:.3f} – {high:.3f}")
        table.add_row("steps in success at the end", f"{result['mean_held_steps']:.1f}", "")
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
    title = f"{result['run']}, epoch {result['epoch']}, {points[0]['episodes']} episodes each"
    table = Table(name.replace("_", "-"), "success rate", "95 % interval", "return", title=title)
    for point in points:
        low, high = point["success_rate_ci"]
        rate, interval = f"{point['success_rate']:.3f}", f"{low:.3f} – {high:.3f}"
        table.add_row(str(point[name]), rate, interval, f"{point['mean_return']:.2f}")
    return table


# -- env -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EnvFlags:
    """Flags of `tactilerl env`, besides the scene's."""

    env: str = "shadow"
    """Name of the environment."""
    describe: bool = False
    """List every entry of the observation and of the action."""
    json: bool = False
    """Print JSON instead of text."""


def env(args: list[str]) -> int:
    """`tactilerl env --describe`"""
    from . import envs

    name = flags.peek(args, "--env", EnvFlags.env)
    read, scene = _read_scene(EnvFlags, args, name, "tactilerl env")
    with input_errors():
        made = envs.make(name, **(dataclasses.asdict(scene) if scene else {}))
    try:
        base: Any = made.unwrapped
        described: dict[str, Any] = {
            "env": name,
            "action_space": str(made.action_space),
            "observation_space": str(made.observation_space),
        }
        if scene:
            described |= {"observation": base.observation_names(), "action": base.hand.action_names}
            described["taxels"] = len(base.taxels)
    finally:
        made.close()
    if read.json:
        print(json.dumps(described))
        return 0
    for key in ("env", "action_space", "observation_space", "taxels"):
        if key in described:
            print(f"{key}: {described[key]}")
    if read.describe:
        for key in ("action", "observation"):
            for index, entry in enumerate(described.get(key, ())):
                print(f"{key}[{index}] {entry}")
    return 0


def _read_scene(
    kind: type[Any], args: list[str], env: str, prog: str
) -> tuple[Any, GraspConfig | None]:
    """Flags of one command together with the scene's, where `env` has a scene."""
    parts: list[Any] = [("own", kind)]
    defaults: dict[str, Any] = {"own": kind()}
    if env in GRASP_ENVS:
        parts.append(("scene", GraspConfig))
        defaults["scene"] = setup(env)
    options = dataclasses.make_dataclass("Options", parts)
    read: Any = flags.parse(options, args, prog, options(**defaults))
    return read.own, getattr(read, "scene", None)


# -- doctor ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class DoctorFlags:
    """Flags of `tactilerl doctor`, besides the scene's."""

    env: str = "shadow"
    """Name of the environment."""
    grasps: int = 20
    """Perturbed grasps per layout."""
    seconds: float = 3.0
    """Length of each hold, s."""
    compare: bool = False
    """Run the same grasps in the other simulator too: how far do the taxels agree?"""
    verbose: bool = False
    """Name the taxels that never fired."""
    json: bool = False
    """Print JSON instead of a table."""


def doctor(args: list[str]) -> int:
    """`tactilerl doctor`: exit 1 when a layout is blind."""
    from . import doctor as taxels

    name = flags.peek(args, "--env", DoctorFlags.env)
    read, scene = _read_scene(DoctorFlags, args, name, "tactilerl doctor")
    if scene is None:
        raise InputError(f"--env: found {name!r}, allowed: {', '.join(GRASP_ENVS)}")
    _at_least("--grasps", read.grasps, 1)
    if not 0.05 <= read.seconds <= 60:
        raise InputError(f"--seconds: found {read.seconds}, allowed from 0.05 to 60")
    chosen = flags.peek(args, "--layout", "")
    names = [chosen] if chosen else [str(i) for i in range(1, 7)]
    with input_errors():
        figures = [
            taxels.examine(
                name, dataclasses.replace(scene, layout=layout), read.grasps, read.seconds, read.compare
            )
            for layout in names
        ]
    blind = [f.layout for f in figures if f.is_blind]
    if read.json:
        print(json.dumps([f.as_dict() for f in figures]))
        return 1 if blind else 0
    table = Table(title=f"{name} in {scene.simulator}, rule {scene.touch}: taxels during the hold")
    for column in ("layout", "taxels", "held", "bits on", "steps with any", "never fired", ""):
        table.add_column(column, justify="right")
    for f in figures:
        table.add_row(
            *(f.layout, str(f.taxels), f"{f.held}/{f.grasps}", f"{f.mean_bits:.2f}"),
            *(f"{100 * f.share_any:.0f} %", str(len(f.never_fired)), "blind" if f.is_blind else "ok"),
        )
    console.print(table)
    for f in figures if read.compare else ():
        share = "nothing to compare" if f.agreement is None else f"{100 * f.agreement:.0f} %"
        console.print(f"layout {f.layout}: of what fires in either simulator, fires in both: {share}")
    if read.verbose:
        for f in figures:
            console.print(f"layout {f.layout} never fired: {', '.join(f.never_fired) or 'none'}")
    return 1 if blind else 0


# -- render ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class RenderFlags:
    """Flags of `tactilerl render`, besides the scene's."""

    run: tyro.conf.Positional[Path | None] = None
    """Run folder: film its policy in its own scene. Without one: picture of a scripted grasp."""
    video: Path = Path("episodes.mp4")
    """The film of a run's policy to write."""
    episodes: int = 1
    """Episodes in the film: the first that `evaluate` would play. Hold tests last 2 s unless
    --hold-seconds is given."""
    env: str = "shadow"
    """Environment of the picture."""
    out: Path = Path("grasp.png")
    """The picture to write."""
    pose: Literal["start", "grasp"] = "grasp"
    """The start of an episode, or a scripted grasp (picture)."""
    azimuth: float = Camera.azimuth
    """Direction of the camera, degrees; 300 looks at the palm."""
    elevation: float = Camera.elevation
    """Elevation of the camera, degrees; positive looks up from below."""
    distance: float = Camera.distance
    """Distance of the camera, m."""

    @property
    def camera(self) -> Camera:
        """The camera there."""
        return Camera(self.azimuth, self.elevation, self.distance)


def render(args: list[str]) -> int:
    """`tactilerl render`: a scripted grasp with its taxels; `tactilerl render RUN`: a film."""
    from . import render as pictures

    name = flags.peek(args, "--env", RenderFlags.env)
    read, scene = _read_scene(RenderFlags, args, name, "tactilerl render")
    if not 0.05 <= read.distance <= 10:
        raise InputError(f"--distance: found {read.distance}, allowed from 0.05 to 10")
    for flag in ("video", "episodes") if read.run is None else ("env", "out", "pose"):
        if getattr(read, flag) != getattr(RenderFlags, flag):
            needed = "with" if read.run is None else "without"
            raise InputError(f"--{flag}: allowed only {needed} RUN; see --help")
    if read.run is not None:
        return _film(args, read, scene)
    if scene is None:
        raise InputError(f"--env: found {name!r}, allowed: {', '.join(GRASP_ENVS)}")
    with input_errors():
        lit = pictures.picture(name, scene, read.pose, read.camera, read.out)
    console.print(f"{read.out}: {lit} taxels fire")
    return 0


def _film(args: list[str], read: RenderFlags, scene: GraspConfig | None) -> int:
    """The film of a run: of a scene's flags, only the length of the hold test has a meaning."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from . import render as pictures

    assert read.run is not None
    hold_seconds = pictures.HOLD_SECONDS
    if scene is not None and flags.peek(args, "--hold-seconds", ""):
        hold_seconds = scene.hold_seconds
        scene = dataclasses.replace(scene, hold_seconds=setup(read.env).hold_seconds)
    if scene != setup(read.env):
        raise InputError(
            "render RUN: found scene flags, allowed only --hold-seconds: a run keeps its scene"
        )
    _at_least("--episodes", read.episodes, 1)
    columns = SpinnerColumn(), TextColumn("{task.completed:.0f} pictures"), TimeElapsedColumn()
    bar = Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())
    with input_errors(), bar:
        drawn = bar.add_task("")
        film = pictures.film(
            *(read.run, read.episodes, hold_seconds, read.camera, read.video),
            tick=lambda: bar.advance(drawn),
        )
        for success in film:
            verdict = "success" if success else "no success"
            console.print(f"{read.video}: {verdict} (hold tests of {hold_seconds:g} s)")
    return 0


def _at_least(flag: str, value: int, least: int) -> None:
    if value < least:
        raise InputError(f"{flag}: found {value}, allowed {least} or more")
