"""The command `tactilerl study`: of each of its parts the flags, and what it does."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.table import Table

from ..errors import InputError, extra
from ..files import pasted
from ..machine import free_cores
from ..runs.config import RunConfig
from ..study import check, engine, grid, looks, parts, progress, records
from ..study.records import Record, StudyFiles
from ..study.runner import RunJob
from ..terminal import flags
from ..terminal.console import console
from ..terminal.progress_bar import duration

LONG = 6 * 3600  # s; a study that takes longer is asked for twice


@dataclass(frozen=True)
class Run:
    """Run or continue the runs of a study file."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME. Runs already in it are continued."""
    on: str = "local"
    """Where runs are trained: local; mpi (under mpirun); dask:ADDRESS of a scheduler; or slurm, pbs,
    lsf, sge or htcondor (extra: cluster)."""
    jobs: Annotated[int, "[1, inf)"] | None = None
    """Runs trained side by side; default: one per core. With a batch system: jobs to submit."""
    walltime: str | None = None
    """Time limit of a job of a batch system, as it wants it; default: dask-jobqueue's."""
    memory: str | None = None
    """Memory of a job of a batch system; default: dask-jobqueue's, or 3GB."""
    ranks_per_run: Annotated[int, "[1, inf)"] = 1
    """Processes per run (for DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try failed runs again."""
    trust: bool = False
    """Allow importing modules that the study file names, as `import` or in an environment's id."""
    yes: bool = False
    """Start without a question, however long it takes."""

    def __call__(self) -> int:
        """`tactilerl study run FILE`"""
        chosen = engine.Engine(
            self.on, self.jobs, self.ranks_per_run, self.walltime, self.memory
        )
        with chosen.executor() as pool:
            return self._train(*pool) if pool is not None else 0

    def _train(self, pool: Executor, parallel: Callable[[], int]) -> int:
        study = grid.read(self.study)
        files, title = (
            StudyFiles(self.out or Path("studies") / study.name),
            f"study {study.name}",
        )
        runs = study.runs()
        console.print(f"{title}: checking {len(runs)} runs")
        configs = check.configure(runs, self.trust)
        found = {run.name: files.record(run) for run in runs}
        check.require_same(found.values(), configs)
        seconds = check.start(found.values(), configs)
        if not self._is_wanted(found.values(), configs, seconds, parallel()):
            return 1
        files.create(study)
        if self.retry_failed:
            for name, record in found.items():
                if record.state == "failed":
                    files.beside(record.run, "json").unlink(missing_ok=True)
                    found[name] = files.record(record.run)
        todo = [one.run for one in found.values() if not one.has_ended]
        here, folder = Path.cwd(), files.path.absolute()
        jobs = {run.name: RunJob(folder, run, self.ranks_per_run, here) for run in todo}
        left = "to do" if study.looks is None else "to do at most"
        console.print(f"{title}: {len(runs)} runs, {len(jobs)} {left}, in {files.path}")
        with progress.Watch(files, found, parallel) as watch:
            run_all = partial(engine.run_all, pool=pool, watch=watch)
            if study.looks is None:
                endings = run_all(list(jobs.values()))
            else:
                endings = looks.run(study, files.path, jobs, run_all, console.print)
        failures = _print_failures(files.record(run) for run in runs)
        if busy := list(endings.values()).count("busy"):
            console.print(f"{busy} runs are trained by another `study run`")
        console.print(f"  tactilerl study report {pasted(files.path)}")
        return 1 if failures else 0

    def _is_wanted(
        self,
        found: Iterable[Record],
        configs: Mapping[str, RunConfig],
        seconds: dict[str, float],
        parallel: int,
    ) -> bool:
        """Say how many steps there are to do and about how long they take; ask where that is long."""
        steps, left = 0.0, 0.0
        for one in found:
            if one.fraction and one.run.setup not in seconds:
                seconds[one.run.setup] = one.seconds / int(one.rows[-1]["env_steps"])
        for one in found:
            if one.state != "done" and (not one.has_ended or self.retry_failed):
                own = (1 - one.fraction) * configs[one.run.name].run.total_timesteps
                steps, left = (
                    steps + own,
                    left + own * seconds.get(one.run.setup, 0.0) / parallel,
                )
        about = f"about {duration(left)} with {parallel} at a time"
        console.print(f"{steps:,.0f} steps to do: {about}")
        if left < LONG or self.yes or not sys.stdin.isatty():
            return True
        return input("Start? [y/N] ").strip().lower() in ("y", "yes")


def _json(value: Any) -> str:
    """As JSON, which has no numbers that are not finite: those are null."""
    return json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None))


def _print_failures(found: Iterable[Record]) -> int:
    """Every run that failed, and why; how many."""
    failed = [record for record in found if record.state == "failed"]
    for record in failed:
        console.print(f"failed: {record.run.name}: {record.reason}")
    return len(failed)


@dataclass(frozen=True)
class Todo:
    """Print a command for each run that is not done, for job arrays."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME."""
    ranks_per_run: Annotated[int, "[1, inf)"] = 1
    """Processes per run."""
    trust: bool = False
    """Allow importing modules that the study file names, as `import` or in an environment's id."""

    def __call__(self) -> None:
        """`tactilerl study todo FILE`"""
        study = grid.read(self.study)
        files = StudyFiles(self.out or Path("studies") / study.name)
        found = [files.record(run) for run in study.runs()]
        check.require_same(
            found, check.configure((record.run for record in found), self.trust)
        )
        files.create(study)
        for record in found:
            if record.state != "done":
                print(
                    shlex.join(
                        RunJob(files.path, record.run, self.ranks_per_run).command(
                            "tactilerl"
                        )
                    )
                )


@dataclass(frozen=True)
class Status:
    """Count runs that are done, running, failed and left."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> None:
        """`tactilerl study status FOLDER`"""
        study, found = records.load(self.folder)
        counts = progress.counts(found)
        eta = progress.eta(found, counts["running"] or free_cores())
        verdicts = looks.judge(study, found)
        said = looks.answers(study, verdicts)
        if self.json:
            states = {
                one.run.name: {
                    "state": one.state,
                    "fraction": one.fraction,
                    "seconds": one.seconds,
                }
                for one in found
            }
            result = {"study": study.name, "runs": len(states), **counts, "eta_s": eta}
            print(_json({**result, "answers": said, "states": states}))
            return
        console.print(progress.table(f"study {study.name}, {len(found)} runs", found))
        for sentence in said:
            console.print(sentence)
        is_over = all(one.has_ended for one in found) or looks.have_ended(verdicts)
        console.print("nothing left to do" if is_over else f"ETA {duration(eta)}")
        _print_failures(found)


@dataclass(frozen=True)
class Plan:
    """Estimate from a pilot how many pairs of runs are needed."""

    study: tyro.conf.Positional[Path]
    """Folder of a pilot study, or the file that `collect` wrote."""
    effect: float = 0.1
    """Difference in success rate to detect."""
    power: float = 0.8
    """Probability of detecting this difference, that is, the power."""
    alpha: float = 0.05
    """Significance level of the test."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> None:
        """`tactilerl study plan FOLDER`"""
        with extra("study"):
            from ..study import planning
        for name in ("effect", "power", "alpha"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(
                    f"--{name}: found {getattr(self, name)}, allowed between 0 and 1"
                )
        needs = planning.plan(
            *records.load(self.study), self.effect, self.power, self.alpha
        )
        if not needs:
            raise InputError(
                f"{self.study}: no comparison with two or more pairs of runs to plan from"
            )
        if self.json:
            print(_json([dataclasses.asdict(need) for need in needs]))
            return
        title = f"Pairs of runs for a difference of {self.effect:g} with power {self.power:g}"
        caption = (
            "n: pairs so far; r: correlation within seeds; sd: of their differences\n"
            "alone: unpaired runs per group; 95 %: interval of pairs\n"
            "Holm: pairs, corrected for all settings"
        )
        table = Table(
            title=title,
            caption=caption,
            box=box.SIMPLE_HEAD,
            padding=0,
            show_edge=False,
        )
        for column in (
            "set-up",
            "score",
            "n",
            "r",
            "sd",
            "alone",
            "pairs",
            "95 %",
            "Holm",
        ):
            table.add_column(column, no_wrap=True)
        for need in needs:
            counts = need.unpaired, need.needed, *need.interval, need.needed_holm
            alone, pairs, low, high, holm = (str(n) if n else "–" for n in counts)
            row = [
                need.setup,
                need.score,
                str(need.pairs),
                f"{need.correlation:.2f}",
                f"{need.sd:.2f}",
            ]
            table.add_row(*row, alone, pairs, f"{low}–{high}", holm)
        console.print(table)
        for name, need in planning.best(needs).items():
            console.print(
                f"{name}: {need.score} needs the fewest pairs. In the study file:"
            )
            console.print(f'  primary = {{score = "{need.score}"}}')
            if need.needed_holm:
                pairs_at = planning.looks(need.needed_holm, self.alpha / need.settings)
                terms = f"pairs = {pairs_at}, effect = {self.effect:g}, alpha = {self.alpha:g}"
                console.print(f"  looks = {{{terms}}}")


@dataclass(frozen=True)
class Compare:
    """Compare two studies, or parts of them, pairing runs by seed."""

    a: tyro.conf.Positional[str]
    """Folder of a study or a collected file; with :NAME,NAME only the runs of these set-ups,
    settings and groups, as in `pilot:layout 2,touch`."""
    b: tyro.conf.Positional[str]
    """What to compare A with. Runs with the same seed form pairs."""
    score: grid.Score = "area"
    """area: mean success over the run; final: over its last tenth; converged: the converged rate."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> None:
        """`tactilerl study compare A B`"""
        a, b = parts.read(self.a), parts.read(self.b)
        rows = parts.compare(a, b, self.score)
        differing = parts.differing(a, b)
        if self.json:
            print(_json({"differing": differing, "rows": rows}))
            return
        table = Table(
            title=f"{self.a} − {self.b}: {self.score}", box=box.SIMPLE_HEAD, padding=0
        )
        for column in ("", "runs", "steps", "pairs", "difference", "p", "p, Holm"):
            table.add_column(column, no_wrap=bool(column), overflow="fold")
        for one in rows:
            gap = "{value:+.3f} ({low:+.3f} to {high:+.3f})".format(**one)
            sizes = (
                "{} / {}".format(*one["runs"]),
                f"{one['until']:,.0f}",
                str(one["pairs"]),
            )
            p_values = (
                f"{p:.3f}" if p == p else "–" for p in (one["p"], one["p_holm"])
            )
            table.add_row(one["place"], *sizes, gap, *p_values)
        console.print(table)
        console.print(f"they differ in: {'; '.join(differing) or 'nothing'}")


@dataclass(frozen=True)
class Collect:
    """Pack the records of a study into one file."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """File to write; default: collected.tar.gz in FOLDER."""

    def __call__(self) -> None:
        """`tactilerl study collect FOLDER`"""
        path = records.collect(self.folder, self.out)
        console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


@dataclass(frozen=True)
class Report:
    """Write tables, figures and report.html."""

    study: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    out: Path | None = None
    """Folder for the report; default: report/ beside the runs or the collected file."""
    resamples: Annotated[int, "[100, 1e6]"] = 50_000
    """Resamples of every bootstrap and permutation test but those of looks; fewer are faster and less
    exact."""

    def __call__(self) -> None:
        """`tactilerl study report FOLDER`"""
        with extra("study"):
            from ..study import analysis, report, summary
        found = analysis.analyse(*records.load(self.study), self.resamples)
        out = (
            self.out
            or (self.study if os.path.isdir(self.study) else self.study.parent)
            / "report"
        )
        try:
            path = report.write(found, out)
        except OSError as error:
            raise InputError(
                f"cannot write the report into {str(out)!r}: {error.strerror}"
            ) from error
        for sentence in summary.answers(found):
            console.print(sentence)
        for warning in summary.warnings(found):
            console.print(f"note: {warning}")
        console.print(f"{path} (tables and figures beside it)")


KINDS: tuple[Any, ...] = (Run, Todo, Status, Plan, Compare, Collect, Report)
PARTS = {kind.__name__.lower(): kind for kind in KINDS}


def main(args: list[str]) -> int:
    """`tactilerl study PART`"""
    about = {name: str(kind.__doc__) for name, kind in PARTS.items()}
    if not args or args[0] in ("-h", "--help", "--help-all"):
        lines = [
            f"  {name:9}{text[0].lower()}{text[1:-1]}" for name, text in about.items()
        ]
        lines += ["", "tactilerl study PART --help lists a part's options."]
        print(
            "\n".join(["usage: tactilerl study PART [OPTIONS]", "", "parts:", *lines])
        )
        return 0 if args else 2
    name, *rest = args
    if name not in PARTS:
        raise InputError(f"study: found {name!r}, allowed: {', '.join(PARTS)}")
    part = flags.parse(PARTS[name], rest, f"tactilerl study {name}", about=about[name])
    code: int = part() or 0
    return code
