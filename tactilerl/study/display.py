"""How far a study is: a live table on a terminal, a line per run elsewhere."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from ..errors import InputError
from ..runs.files import damage_named
from ..terminal.progress_bar import duration
from .folder import STATES, RunFiles, State, StudyFolder, seconds_spent
from .grid import Run
from .runner import Ending, Job

SHOWN_RUNS = 12  # running ones below the live table


@dataclass(frozen=True)
class Standing:
    """Where one run stands."""

    state: State
    fraction: float
    """Of its steps."""
    seconds: float
    """Spent on them."""

    @classmethod
    def of(cls, files: RunFiles, state: State | None = None) -> Standing:
        """As its files say; `state` where one knows better."""
        state = state or files.state()
        if state in ("left", "damaged"):
            return cls(state, 0.0, 0.0)
        rows, total = files.rows(), math.inf  # of a damaged one as good as nothing is done
        if state != "done":
            with suppress(InputError), damage_named(files.run_dir.config_file):
                total = max(1, int(files.run_dir.record()["run"]["total_timesteps"]))
        steps = int(rows[-1]["env_steps"]) if rows else 0
        return cls(state, 1.0 if state == "done" else min(1.0, steps / total), seconds_spent(rows))


class Overview:
    """Standings of all runs, by name."""

    def __init__(self, folder: StudyFolder, runs: list[Run]) -> None:
        self.folder, self.runs = folder, runs
        self.standings = {run.name: Standing.of(folder.files(run)) for run in runs}

    def counts(self, setup: str | None = None) -> dict[str, int]:
        """Runs in each state, of one set-up or of all."""
        states = [self.standings[r.name].state for r in self.runs if setup in (None, r.setup)]
        return {state: states.count(state) for state in STATES}

    def eta(self, parallel: int) -> float | None:
        """Seconds until all is done with so many runs side by side; None while nobody can know.

        A run is taken to be as long as the others of its set-up; of set-ups of which nothing has
        run yet, as those of the others.
        """
        overall = _seconds_per_run(self.standings.values())
        left = 0.0
        for setup in dict.fromkeys(run.setup for run in self.runs):
            some = [self.standings[run.name] for run in self.runs if run.setup == setup]
            open_ = sum(1 - one.fraction for one in some if one.state not in ("done", "failed"))
            left += (_seconds_per_run(some) or overall or 0.0) * open_
        return left / max(1, parallel) if overall else None

    def table(self, title: str) -> Table:
        """Set-ups by states."""
        table = Table("set-up", *STATES, title=title)
        for setup in dict.fromkeys(run.setup for run in self.runs):
            table.add_row(setup, *map(str, self.counts(setup).values()))
        return table


def _seconds_per_run(standings: Iterable[Standing]) -> float | None:
    begun = [one for one in standings if one.fraction > 0 and one.seconds > 0]
    return sum(s.seconds for s in begun) / sum(s.fraction for s in begun) if begun else None


class Watch:
    """Shows a study while it runs."""

    def __init__(self, overview: Overview, parallel: int, title: str) -> None:
        self.overview, self.parallel, self.title = overview, parallel, title
        self.console = Console(highlight=False, soft_wrap=True, markup=False)
        self._names = {overview.folder.files(run).base: run.name for run in overview.runs}
        self._seen: dict[Path, Ending] = {}
        self._live = Live(console=self.console, auto_refresh=False)

    def __enter__(self) -> Watch:
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self._live.stop()

    def __call__(self, running: list[Job], endings: dict[Path, Ending]) -> None:
        """What runs now, and what has ended: `runner.run_all` calls it."""
        for base, ending in endings.items():
            if self._seen.get(base) != ending:
                self._seen[base] = ending
                self._note(self._names[base], base)
        if not self.console.is_terminal:
            return
        for job in running:
            self.overview.standings[self._names[job.base]] = Standing.of(RunFiles(job.base), "running")
        self._live.update(self._picture(running), refresh=True)

    def _note(self, name: str, base: Path) -> None:
        standing = Standing.of(RunFiles(base))
        self.overview.standings[name] = standing
        counts = self.overview.counts()
        ended = counts["done"] + counts["failed"]
        self.console.print(
            f"[{ended}/{len(self.overview.runs)}] {name} {standing.state}"
            f" {duration(standing.seconds)}  failed {counts['failed']}"
            f"  ETA {duration(self.overview.eta(self.parallel))}"
        )

    def _picture(self, running: list[Job]) -> Table:
        whole = Table.grid()
        eta = duration(self.overview.eta(self.parallel))
        whole.add_row(self.overview.table(f"{self.title}, ETA {eta}"))
        for job in running[:SHOWN_RUNS]:
            name = self._names[job.base]
            whole.add_row(f"{100 * self.overview.standings[name].fraction:5.1f} %  {name}")
        if len(running) > SHOWN_RUNS:
            whole.add_row(f"        and {len(running) - SHOWN_RUNS} more")
        return whole
