"""The command `tactilerl study`: of each of its parts the flags, and what it does."""

from __future__ import annotations

import dataclasses
import json
import os
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich import box
from rich.table import Table

from ..errors import InputError
from ..runs.cores import free_cores
from ..runs.files import pasted
from ..study import check, comparing, display, grid, looks, planning, records, runner
from ..study.folder import Outcome, RunFiles, StudyFolder
from ..terminal import flags
from ..terminal.console import console
from ..terminal.help import About
from ..terminal.progress_bar import duration


@dataclass(frozen=True)
class Run:
    """Run or continue the runs of a study file."""

    study: tyro.conf.Positional[Path]
    """Study file (TOML)."""
    out: Path | None = None
    """Folder of the study; default: studies/NAME. Runs already in it are continued."""
    jobs: Annotated[int, "[1, inf)"] | None = None
    """Runs trained side by side; default: one per core, or one per rank but the first under mpirun."""
    ranks_per_run: Annotated[int, "[1, inf)"] = 1
    """Processes per run (for DDPG+HER with several workers)."""
    retry_failed: bool = False
    """Try failed runs again."""
    only: str = ""
    """Train only runs with all these names of set-ups, cells or arms, as NAME,NAME."""
    collected: tuple[Path, ...] = ()
    """Skip runs that are done in these folders or collected files of the study."""

    def __call__(self) -> int:
        """`tactilerl study run FILE`"""
        parallel = self.jobs or max(1, free_cores() // self.ranks_per_run)
        with runner.executor(parallel) as pool:
            return self._train(pool, parallel) if pool is not None else 0

    def _train(self, pool: Executor, parallel: int) -> int:
        study = grid.read(self.study)
        folder = StudyFolder(self.out or Path("studies") / study.name)
        runs, title = self._runs(study), f"study {study.name}"
        console.print(f"{title}: checking {len(runs)} runs")
        configs = check.configure(runs)
        damaged = check.find_damage(runs, configs, folder)
        check.start(runs, configs, folder)
        folder.create(study)
        jobs: dict[str, runner.Job] = {}
        for one in runs:
            files, total = folder.files(one), configs[one.name].run.total_timesteps
            if self._is_to_do(one, files, total, damaged.get(one.name, "")):
                jobs[one.name] = runner.Job(files.base, one.arguments, total, self.ranks_per_run)
        overview = display.Overview(folder, runs)
        left = "to do" if study.looks is None else "to do at most"
        console.print(f"{title}: {len(runs)} runs, {len(jobs)} {left}, in {folder.path}")
        with display.Watch(overview, getattr(pool, "num_workers", parallel), title) as watch:
            run_all = partial(runner.run_all, pool=pool, watch=watch)
            if study.looks is None:
                endings = run_all(list(jobs.values()))
            else:
                endings = looks.run(study, folder, jobs, run_all, console.print, self.collected)
        failures = _print_failures(folder, runs)
        if busy := list(endings.values()).count("busy"):
            console.print(f"{busy} runs are trained by another `study run`")
        console.print(f"  tactilerl study report {pasted(folder.path)}")
        return 1 if failures else 0

    def _runs(self, study: grid.Study) -> list[grid.Run]:
        """Those that were chosen and are not done elsewhere."""
        chosen = study.choose(self.only, self.study)
        if not chosen:
            raise InputError(f"--only: found {self.only!r}, but no run has all these names")
        elsewhere = records.load(self.study, *self.collected)[1] if self.collected else []
        done = {one.run.name for one in elsewhere if one.state == "done"}
        return [run for run in study.runs() if run.name in chosen and run.name not in done]

    def _is_to_do(self, run: grid.Run, files: RunFiles, total: int, damage: str) -> bool:
        """Is a run to be trained, after what is damaged was put aside or recorded as failed?"""
        if found := files.damage():
            console.print(f"{run.name}: {found}; recorded as done, it is trained again")
            if place := files.set_aside():
                console.print(f"  what is left of it: {pasted(place)}")
        if self.retry_failed and (before := files.outcome()) and before.state == "failed":
            files.outcome_file.unlink()
        if damage:
            console.print(f"{run.name}: {damage}; repair or remove it, then --retry-failed")
            files.write_outcome(Outcome("failed", total, damage))
        outcome = files.outcome()
        if outcome and outcome.state == "done" and outcome.total_timesteps < total:
            files.outcome_file.unlink()  # it counts again when it is as long as the others
            return True
        return outcome is None


def _json(value: Any) -> str:
    """As JSON, which has no numbers that are not finite: those are null."""
    return json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None))


def _print_failures(folder: StudyFolder, runs: list[grid.Run]) -> int:
    """Every run that failed, and why; how many."""
    outcomes = {one.name: folder.files(one).outcome() for one in runs}
    reasons = {name: o.reason for name, o in outcomes.items() if o and o.state == "failed"}
    for name, reason in reasons.items():
        console.print(f"failed: {name}: {reason}")
    return len(reasons)


@dataclass(frozen=True)
class Status:
    """Count runs that are done, running, failed and left."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> None:
        """`tactilerl study status FOLDER`"""
        folder = StudyFolder(self.folder)
        study = folder.study()
        overview = display.Overview(folder, study.runs())
        counts = overview.counts()
        eta = overview.eta(counts["running"] or free_cores())
        found = looks.judge(study, folder)
        said = looks.answers(study, found)
        if self.json:
            states = {name: dataclasses.asdict(one) for name, one in overview.standings.items()}
            result = {"study": study.name, "runs": len(states), **counts, "eta_s": eta}
            print(_json({**result, "answers": said, "states": states}))
            return
        console.print(overview.table(f"study {study.name}, {len(overview.runs)} runs"))
        for sentence in said:
            console.print(sentence)
        has_all = counts["done"] + counts["failed"] == len(overview.runs)
        is_over = has_all or looks.have_ended(found)
        console.print("nothing left to do" if is_over else f"ETA {duration(eta)}")
        _print_failures(folder, overview.runs)


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
        for name in ("effect", "power", "alpha"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(f"--{name}: found {getattr(self, name)}, allowed between 0 and 1")
        needs = planning.plan(*records.load(self.study), self.effect, self.power, self.alpha)
        if not needs:
            raise InputError(f"{self.study}: no comparison with two or more pairs of runs to plan from")
        if self.json:
            print(_json([dataclasses.asdict(need) for need in needs]))
            return
        title = f"Pairs of runs for a difference of {self.effect:g} with power {self.power:g}"
        caption = (
            "n: pairs so far; r: correlation within seeds; sd: of their differences\n"
            "alone: unpaired runs per arm; 95 %: interval of pairs; at N: power of N pairs\n"
            "Holm: pairs, corrected for all cells"
        )
        table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, padding=0, show_edge=False)
        columns = ("set-up", "score", "n", "r", "sd", "alone", "pairs", "95 %", "Holm")
        for column in (*columns, *(f"at {n}" for n in needs[0].power)):
            table.add_column(column, no_wrap=True)
        for need in needs:
            counts = need.unpaired, need.needed, *need.interval, need.needed_holm
            alone, pairs, low, high, holm = (str(n) if n else "–" for n in counts)
            row = [need.setup, need.score, str(need.pairs), f"{need.correlation:.2f}", f"{need.sd:.2f}"]
            powers = [f"{power:.2f}" for power in need.power.values()]
            table.add_row(*row, alone, pairs, f"{low}–{high}", holm, *powers)
        console.print(table)
        for name, need in planning.best(needs).items():
            assert need.needed is not None
            console.print(f"{name}: {need.score} needs the fewest pairs. In the study file:")
            console.print(f'  primary = {{score = "{need.score}"}}')
            pairs_at = planning.looks(need.needed)
            terms = f"pairs = {pairs_at}, effect = {self.effect:g}, alpha = {self.alpha:g}"
            console.print(f"  looks = {{{terms}}}")


@dataclass(frozen=True)
class Compare:
    """Compare two studies, or parts of them, pairing runs by seed."""

    a: tyro.conf.Positional[str]
    """Folder of a study or a collected file; with :NAME,NAME only the runs of these set-ups, cells
    and arms, as in `pilot:layout 2,main`."""
    b: tyro.conf.Positional[str]
    """What to compare A with. Runs with the same seed form pairs."""
    score: Literal["area", "final", "converged"] = "area"
    """area: mean success over the run; final: over its last tenth; converged: the converged rate."""
    json: bool = False
    """Print JSON instead of a table."""

    def __call__(self) -> None:
        """`tactilerl study compare A B`"""
        a, b = comparing.read(self.a), comparing.read(self.b)
        rows = comparing.compare(a, b, self.score)
        differing = comparing.differing(a, b)
        if self.json:
            print(_json({"differing": differing, "rows": [one.as_dict() for one in rows]}))
            return
        columns = ("", "runs", "steps", "pairs", "difference", "p", "p, Holm")
        table = Table(*columns, title=f"{self.a} − {self.b}: {self.score}", box=box.SIMPLE_HEAD)
        for one in rows:
            gap = one.pairs.difference
            shown = f"{gap.value:+.3f} ({gap.low:+.3f}–{gap.high:+.3f})"
            sizes = f"{one.runs[0]} / {one.runs[1]}", f"{one.until:,.0f}", str(len(one.pairs) or "none")
            p_values = one.pairs.p_value, one.p_holm
            table.add_row(one.place, *sizes, shown, *(f"{p:.3f}" if p == p else "–" for p in p_values))
        console.print(table)
        console.print(f"they differ in: {'; '.join(differing) or 'nothing'}")
        if any(not len(one.pairs) for one in rows):
            console.print("note: without common seeds runs are not in pairs, and it takes more of them")


@dataclass(frozen=True)
class Collect:
    """Pack the records of a study into one file."""

    folder: tyro.conf.Positional[Path]
    """Folder of the study, or a collected file."""
    more: tyro.conf.Positional[tuple[Path, ...]] = ()
    """More folders or collected files of the same study to merge, or its study file. Of each run,
    the record that got furthest is kept."""
    out: Path | None = None
    """File to write; default: collected.csv.gz in FOLDER."""

    def __call__(self) -> None:
        """`tactilerl study collect FOLDER`"""
        if self.out is None and (self.more or os.path.isfile(self.folder)):
            found = "several folders and files" if self.more else f"the file {str(self.folder)!r}"
            raise InputError(f"study collect: found {found}, expected a study's folder, or --out FILE")
        path = records.collect(self.folder, *self.more, out=self.out)
        console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


@dataclass(frozen=True)
class Report:
    """Write tables, figures and report.html."""

    study: tyro.conf.Positional[Path]
    """Folder of the study, or the file that `collect` wrote."""
    out: Path | None = None
    """Folder for the report; default: report/ beside the runs or the collected file."""
    resamples: Annotated[int, "[100, inf)"] = 50_000
    """Resamples of every bootstrap and permutation test; fewer are faster and less exact."""

    def __call__(self) -> None:
        """`tactilerl study report FOLDER`"""
        try:
            from ..study import analysis, report, summary
        except ModuleNotFoundError as error:
            needed = f"study report needs {error.name}, which is not installed"
            raise InputError(f"{needed}: pip install 'tactilerl[study]'") from error
        found = analysis.analyse(*records.load(self.study), self.resamples)
        out = self.out or (self.study if os.path.isdir(self.study) else self.study.parent) / "report"
        try:
            path = report.write(found, out)
        except OSError as error:
            raise InputError(f"cannot write the report into {str(out)!r}: {error.strerror}") from error
        for sentence in summary.answers(found):
            console.print(sentence)
        for warning in summary.warnings(found):
            console.print(f"note: {warning}")
        console.print(f"{path} (tables and figures beside it)")


KINDS: tuple[Any, ...] = (Run, Status, Plan, Compare, Collect, Report)
PARTS = {kind.__name__.lower(): kind for kind in KINDS}


def main(args: list[str]) -> int:
    """`tactilerl study PART`"""
    about = {name: str(kind.__doc__) for name, kind in PARTS.items()}
    if not args or args[0] in ("-h", "--help", "--help-all"):
        lines = [f"  {name:9}{text[0].lower()}{text[1:-1]}" for name, text in about.items()]
        lines += ["", "tactilerl study PART --help lists a part's options."]
        print("\n".join(["usage: tactilerl study PART [OPTIONS]", "", "parts:", *lines]))
        return 0 if args else 2
    name, *rest = args
    if name not in PARTS:
        raise InputError(f"study: found {name!r}, allowed: {', '.join(PARTS)}")
    part = flags.parse(PARTS[name], rest, f"tactilerl study {name}", about=About(about[name]))
    code: int = part() or 0
    return code
