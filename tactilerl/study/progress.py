"""How far a study is: counts of its runs, the time that is left, and a line for each that ends."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from ..terminal.progress_bar import duration
from .records import STATES, Record, StudyFiles
from .runner import Ending, RunJob


def counts(records: Iterable[Record]) -> dict[str, int]:
    """Runs in each state."""
    states = [record.state for record in records]
    return {state: states.count(state) for state in STATES}


def eta(records: Sequence[Record], parallel: int) -> float | None:
    """Seconds until all is done with so many runs side by side; None while nobody can know.

    A run is taken to be as long as the others of its set-up; of set-ups of which nothing has run yet,
    as those of the others.
    """
    overall = _seconds_per_run(records)
    left = 0.0
    for setup in {record.run.setup for record in records}:
        some = [record for record in records if record.run.setup == setup]
        is_open = sum(1 - one.fraction for one in some if not one.has_ended)
        left += (_seconds_per_run(some) or overall or 0.0) * is_open
    return left / max(1, parallel) if overall else None


def _seconds_per_run(records: Iterable[Record]) -> float | None:
    begun = [(one.fraction, one.seconds) for one in records]
    begun = [
        (fraction, seconds)
        for fraction, seconds in begun
        if fraction > 0 and seconds > 0
    ]
    return sum(s for _, s in begun) / sum(f for f, _ in begun) if begun else None


def table(title: str, records: Iterable[Record]) -> Table:
    """Set-ups by states."""
    found: dict[str, list[Record]] = {}
    for record in records:
        found.setdefault(record.run.setup, []).append(record)
    made = Table("set-up", *STATES, title=title)
    for setup, some in found.items():
        made.add_row(setup, *map(str, counts(some).values()))
    return made


class Watch:
    """Shows a study while it runs: a bar on a terminal, and a line for each run that ends."""

    def __init__(
        self,
        files: StudyFiles,
        records: Mapping[str, Record],
        parallel: Callable[[], int],
    ) -> None:
        self.files, self.records, self.parallel = files, dict(records), parallel
        self.console = Console(highlight=False, soft_wrap=True, markup=False)
        self._seen: dict[str, Ending] = {}
        columns = BarColumn(), TextColumn("{task.description}")
        self._bar = Progress(
            *columns, console=self.console, disable=not self.console.is_terminal
        )
        self._task = self._bar.add_task("", total=1.0)

    def __enter__(self) -> Watch:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, running: list[RunJob], endings: dict[str, Ending]) -> None:
        """What runs now, and what has ended: `engine.run_all` calls it."""
        for name, ending in endings.items():
            if self._seen.get(name) != ending:
                self._seen[name] = ending
                record = self.records[name] = self.files.record(self.records[name].run)
                spent = duration(record.seconds)
                self.console.print(
                    f"[{self._ended}] {name} {record.state} {spent}  {self._left}"
                )
        if self.console.is_terminal:
            for job in running:
                self.records[job.run.name] = self.files.record(job.run)
            done = sum(
                1 if one.has_ended else one.fraction for one in self.records.values()
            )
            text = f"{self._ended} runs, {len(running)} running, {self._left}"
            self._bar.update(
                self._task, completed=done / len(self.records), description=text
            )

    @property
    def _ended(self) -> str:
        return (
            f"{sum(one.has_ended for one in self.records.values())}/{len(self.records)}"
        )

    @property
    def _left(self) -> str:
        found = list(self.records.values())
        left = duration(eta(found, self.parallel()))
        return f"failed {counts(found)['failed']}  ETA {left}"
