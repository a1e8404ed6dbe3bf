"""The command `tactilerl study`: its flags, and what each of its parts does."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro
from rich import box
from rich.table import Table

from ..algos.mpi import Communicator
from ..errors import InputError
from ..runs.files import pasted
from ..runs.training import free_cores
from ..study import display, grid
from ..study.folder import Outcome, RunFiles, StudyFolder
from ..terminal import flags
from ..terminal.console import console
from ..terminal.help import About
from ..terminal.progress_bar import duration

T = TypeVar("T")
if TYPE_CHECKING:
    from ..study.planning import Need
    from ..study.records import Record


@dataclass(frozen=True)
class RunFlags:
    """Flags of `tactilerl study run`."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME. Runs already in it are continued."""
    jobs: Annotated[int, "[1, inf)"] | None = None
    """Runs trained at a time; default: one per core, or under mpirun one per rank but the first."""
    ranks_per_run: Annotated[int, "[1, inf)"] = 1
    """Processes of each run (DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try failed runs again."""
    only: str = ""
    """Train only the runs of these set-ups, cells and arms: NAME,NAME as in `compare`."""
    collected: tuple[Path, ...] = ()
    """Leave out runs that are done in these folders or collected files of the study."""


def run(args: list[str]) -> int:
    """`tactilerl study run FILE`"""
    read = _read(RunFlags, args, "run")
    from ..study import runner

    parallel = read.jobs or max(1, free_cores(Communicator()) // read.ranks_per_run)
    with runner.executor(parallel) as pool:
        return _run(read, pool, parallel) if pool is not None else 0


def _run(read: RunFlags, pool: Executor, parallel: int) -> int:
    from ..study import check, looks, records, runner

    study = grid.read(read.study)
    folder = StudyFolder(read.out or Path("studies") / study.name)
    chosen = study.choose(read.only, read.study)
    if not chosen:
        raise InputError(f"--only: found {read.only!r}, but no run has all these names")
    elsewhere = records.load(read.study, *read.collected)[1] if read.collected else []
    done = {one.run.name for one in elsewhere if one.state == "done"}
    runs = [run for run in study.runs() if run.name in chosen and run.name not in done]
    title = f"study {study.name}"
    console.print(f"{title}: checking {len(runs)} runs")
    configs = check.configure(runs)
    damaged = check.find_damage(runs, configs, folder)
    check.start(runs, configs, folder)
    folder.create(study)
    jobs: dict[str, runner.Job] = {}
    for one in runs:
        files, total = folder.files(one), configs[one.name].run.total_timesteps
        if _is_to_do(one, files, total, damaged.get(one.name, ""), read.retry_failed):
            jobs[one.name] = runner.Job(files.base, check.arguments(one), total, read.ranks_per_run)
    overview = display.Overview(folder, runs)
    left = "to do" if study.looks is None else "to do at most"
    console.print(f"{title}: {len(runs)} runs, {len(jobs)} {left}, in {folder.path}")
    with display.Watch(overview, getattr(pool, "num_workers", parallel), title) as watch:
        run_all = partial(runner.run_all, pool=pool, watch=watch)
        if study.looks is None:
            endings = run_all(list(jobs.values()))
        else:
            endings = looks.run(study, folder, jobs, run_all, console.print, read.collected)
    failures = _print_failures(folder, runs)
    if busy := list(endings.values()).count("busy"):
        console.print(f"{busy} runs are trained by another `study run`")
    console.print(f"  tactilerl study report {pasted(folder.path)}")
    return 1 if failures else 0


def _is_to_do(run: grid.Run, files: RunFiles, total: int, damage: str, retries: bool) -> bool:
    """Is a run to be trained, after what is damaged was put aside or recorded as failed?"""
    if found := files.damage():
        console.print(f"{run.name}: {found}; recorded as done, it is trained again")
        if place := files.set_aside():
            console.print(f"  what is left of it: {pasted(place)}")
    if retries and (before := files.outcome()) and before.state == "failed":
        files.outcome_file.unlink()
    if damage:
        console.print(f"{run.name}: {damage}; repair or remove it, then --retry-failed")
        files.write_outcome(Outcome("failed", total, damage))
    outcome = files.outcome()
    return outcome is None or (outcome.state == "done" and outcome.total_timesteps < total)


def _print_failures(folder: StudyFolder, runs: list[grid.Run]) -> int:
    """Every run that failed, and why; how many."""
    outcomes = {one.name: folder.files(one).outcome() for one in runs}
    reasons = {name: o.reason for name, o in outcomes.items() if o and o.state == "failed"}
    for name, reason in reasons.items():
        console.print(f"failed: {name}: {reason}")
    return len(reasons)


@dataclass(frozen=True)
class StatusFlags:
    """Flags of `tactilerl study status`."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    json: bool = False
    """Print JSON instead of a table."""


def status(args: list[str]) -> int:
    """`tactilerl study status FOLDER`"""
    from ..study import looks

    read = _read(StatusFlags, args, "status")
    folder = StudyFolder(read.folder)
    study = folder.study()
    overview = display.Overview(folder, study.runs())
    eta = overview.eta(overview.counts()["running"] or free_cores(Communicator()))
    found = looks.judge(study, folder)
    said = looks.answers(study, found)
    if read.json:
        states = {name: dataclasses.asdict(one) for name, one in overview.standings.items()}
        counts = {"runs": len(states), **overview.counts()}
        result = {"study": study.name, **counts, "eta_s": eta, "answers": said, "states": states}
        print(json.dumps(result))
        return 0
    console.print(overview.table(f"study {study.name}, {len(overview.runs)} runs"))
    for sentence in said:
        console.print(sentence)
    has_all = overview.counts()["done"] + overview.counts()["failed"] == len(overview.runs)
    is_over = has_all or looks.have_ended(found)
    console.print("nothing left to do" if is_over else f"ETA {duration(eta)}")
    _print_failures(folder, overview.runs)
    return 0


@dataclass(frozen=True)
class CollectFlags:
    """Flags of `tactilerl study collect`."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study, or a collected file."""
    more: tyro.conf.Positional[tuple[Path, ...]] = ()
    """More of the same study to merge, its file too; of each run the furthest record counts."""
    out: Path | None = None
    """The file; default, of one folder: collected.csv.gz in it."""


def collect(args: list[str]) -> int:
    """`tactilerl study collect FOLDER`"""
    from ..study import records

    read = _read(CollectFlags, args, "collect")
    if read.more and read.out is None:
        raise InputError("study collect: found several folders and files, expected --out FILE")
    path = records.collect(read.folder, *read.more, out=read.out)
    console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return 0


@dataclass(frozen=True)
class ReportFlags:
    """Flags of `tactilerl study report`."""

    study: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    out: Path | None = None
    """Folder for the report; default: report/ beside the runs or the collected file."""
    resamples: Annotated[int, "[100, inf)"] = 50_000
    """Resamples of every bootstrap and permutation test; fewer are faster and less exact."""


def report(args: list[str]) -> int:
    """`tactilerl study report FOLDER`"""
    read = _read(ReportFlags, args, "report")
    with _needs_extra("report"):
        from ..study import report as page
        from ..study import summary
        from ..study.analysis import analyse
    analysis = analyse(*_load(read.study), read.resamples)
    out = read.out or (read.study if read.study.is_dir() else read.study.parent) / "report"
    try:
        path = page.write(analysis, out)
    except OSError as error:
        raise InputError(f"cannot write the report into {str(out)!r}: {error.strerror}") from error
    for sentence in summary.answers(analysis):
        console.print(sentence)
    for warning in summary.warnings(analysis):
        console.print(f"note: {warning}")
    console.print(f"{path} (tables and figures beside it)")
    return 0


@dataclass(frozen=True)
class PlanFlags:
    """Flags of `tactilerl study plan`."""

    study: tyro.conf.Positional[Path]
    """Folder of a pilot study, or the file that `collect` wrote."""
    effect: float = 0.1
    """Difference of success rates to detect."""
    power: float = 0.8
    """Probability of detecting it."""
    alpha: float = 0.05
    """Level of the test."""
    json: bool = False
    """Print JSON instead of a table."""


def plan(args: list[str]) -> int:
    """`tactilerl study plan FOLDER`"""
    from ..study import planning

    read = _read(PlanFlags, args, "plan")
    for name in ("effect", "power", "alpha"):
        if not 0 < getattr(read, name) < 1:
            raise InputError(f"--{name}: found {getattr(read, name)}, allowed between 0 and 1")
    study, records = _load(read.study)
    needs = planning.plan(study, records, read.effect, read.power, read.alpha)
    if not needs:
        raise InputError(f"{read.study}: no comparison with two or more pairs of runs to plan from")
    if read.json:
        print(json.dumps([dataclasses.asdict(need) for need in needs]))
        return 0
    title = f"Pairs of runs for a difference of {read.effect:g} with power {read.power:g}"
    console.print(_plan_table(title, needs))
    for name, need in planning.best(needs).items():
        assert need.needed is not None
        console.print(f"{name}: {need.score} needs the fewest pairs. In the study file:")
        console.print(f'  primary = {{score = "{need.score}"}}')
        console.print(f"  looks = {{pairs = {planning.looks(need.needed)}, effect = {read.effect:g}}}")
    return 0


def _plan_table(title: str, needs: list[Need]) -> Table:
    at = list(needs[0].power)
    caption = "r: within seeds; sd: of differences; alone: runs per arm; at: power"
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    columns = ("set-up", "score", "n", "r", "sd", "alone", "pairs", "95 %", "Holm")
    for column in (*columns, *(f"at {n}" for n in at)):
        table.add_column(column, no_wrap=True)
    for need in needs:
        alone, pairs, low, high, holm = (
            str(n) if n else "–" for n in (need.unpaired, need.needed, *need.interval, need.needed_holm)
        )
        row = [need.setup, need.score, str(need.pairs), f"{need.correlation:.2f}", f"{need.sd:.2f}"]
        powers = [f"{need.power[n]:.2f}" for n in at]
        table.add_row(*row, alone, pairs, f"{low}–{high}", holm, *powers)
    return table


@dataclass(frozen=True)
class CompareFlags:
    """Flags of `tactilerl study compare`."""

    a: tyro.conf.Positional[str]
    """Folder of a study or a collected file; with :NAME,NAME only the runs of these set-ups, cells
    and arms, as in `pilot:layout 2,main`."""
    b: tyro.conf.Positional[str]
    """Compared with it, in pairs of runs of the same seed where there are any."""
    score: Literal["area", "final", "converged"] = "area"
    """Of each run: mean success over the run, over its last tenth, or the converged rate."""
    json: bool = False
    """Print JSON instead of a table."""


def compare(args: list[str]) -> int:
    """`tactilerl study compare A B`"""
    from ..study import comparing

    read = _read(CompareFlags, args, "compare")
    a, b = comparing.read(read.a), comparing.read(read.b)
    rows = comparing.compare(a, b, read.score)
    differing = comparing.differing(a, b)
    if read.json:
        print(json.dumps({"differing": differing, "rows": [one.as_dict() for one in rows]}))
        return 0
    table = Table(title=f"{read.a} − {read.b}: {read.score}", box=box.SIMPLE_HEAD)
    for column in ("", "runs", "steps", "pairs", "difference", "p", "p, Holm"):
        table.add_column(column)
    for one in rows:
        gap, p = one.pairs.difference, one.pairs.p_value
        shown = f"{gap.value:+.3f} ({gap.low:+.3f}–{gap.high:+.3f})"
        sizes = f"{one.runs[0]} / {one.runs[1]}", f"{one.until:,.0f}", str(len(one.pairs) or "none")
        table.add_row(one.place, *sizes, shown, f"{p:.3f}", f"{one.p_holm:.3f}")
    console.print(table)
    console.print(f"they differ in: {'; '.join(differing) or 'nothing'}")
    if any(not len(one.pairs) for one in rows):
        console.print("note: without common seeds runs are not in pairs, and it takes more of them")
    return 0


def _read(kind: type[T], args: list[str], part: str) -> T:
    about = PARTS[part][1]
    return flags.parse(
        kind, args, f"tactilerl study {part}", about=About(f"{about[0].upper()}{about[1:]}.")
    )


def _load(path: Path) -> tuple[grid.Study, list[Record]]:
    from ..study import records

    return records.load(path)


@contextmanager
def _needs_extra(part: str) -> Iterator[None]:
    """InputError naming the extra when a package of it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(
            f"study {part} needs {error.name}, which is not installed: pip install 'tactilerl[study]'"
        ) from error


PARTS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "run": (run, "run or continue the runs of a study file"),
    "status": (status, "count runs that are done, running, failed and left"),
    "plan": (plan, "say how many pairs of runs an effect needs, from a pilot"),
    "compare": (compare, "compare two parts of studies, in pairs where seeds agree"),
    "collect": (collect, "pack the records of a study into one file"),
    "report": (report, "write tables, figures and report.html"),
}


def main(args: list[str]) -> int:
    """`tactilerl study PART`"""
    if not args or args[0] in ("-h", "--help", "--help-all"):
        lines = [f"  {name:9}{about}" for name, (_, about) in PARTS.items()]
        print("\n".join(["usage: tactilerl study PART [OPTIONS]", "", "parts:", *lines]))
        return 0 if args else 2
    if args[0] not in PARTS:
        raise InputError(f"study: found {args[0]!r}, allowed: {', '.join(PARTS)}")
    return PARTS[args[0]][0](args[1:])
