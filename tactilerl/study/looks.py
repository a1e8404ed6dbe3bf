"""Runs a study look by look, and no further than its answers need."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from . import records, summary, verdicts
from .grid import Run, Study
from .records import Record
from .runner import PATIENCE, Ending, RunJob
from .verdicts import Verdict

Found = Mapping[str, Mapping[str, Verdict]]
"""Comparisons by set-up and cell."""
RunAll = Callable[[list[RunJob]], dict[str, Ending]]
"""`engine.run_all`, given its pool and who watches."""


def run(
    study: Study,
    folder: Path,
    jobs: Mapping[str, RunJob],
    run_all: RunAll,
    say: Callable[[str], None],
) -> dict[str, Ending]:
    """Run jobs, by name of their run, up to one look after the other; how they ended, by name.

    What belongs to comparisons that have ended is left out. A look waits for runs that others train.
    """
    assert study.looks is not None
    endings: dict[str, Ending] = {}
    waiting = dict(jobs)

    def now() -> Found:
        return judge(study, records.load(folder)[1])

    for n in study.looks.pairs:
        is_last, found = n == study.looks.pairs[-1], now()
        due = [
            r
            for r in study.runs()
            if r.name in waiting and _is_due(study, r, n, is_last, found)
        ]
        batch = [waiting.pop(r.name) for r in due]
        endings |= run_all(batch)
        while busy := [job for job in batch if endings[job.run.name] == "busy"]:
            time.sleep(PATIENCE)
            endings |= run_all(busy)
        if batch or (is_last and not endings):
            for sentence in answers(study, now()):
                say(sentence)
    return endings


def judge(study: Study, found: Sequence[Record]) -> Found:
    """All primary comparisons."""
    return {setup.name: verdicts.judge(study, setup, found) for setup in study.setups}


def answers(study: Study, found: Found) -> list[str]:
    """A sentence for each comparison."""
    score = study.primary.score
    return [
        summary.answer(one, v, score)
        for one in study.setups
        for v in found[one.name].values()
    ]


def have_ended(found: Found) -> bool:
    """Has a look ended every comparison?"""
    stages = [verdict.stage for cells in found.values() for verdict in cells.values()]
    return bool(stages) and all(stage is not None and stage.ending for stage in stages)


def _is_due(study: Study, run: Run, n: int, is_last: bool, found: Found) -> bool:
    """Is a run needed for the look at `n` pairs? What is in no comparison goes on while any does."""
    setup = next(one for one in study.setups if one.name == run.setup)
    own = found[setup.name].get(run.cell)
    is_open = not have_ended({setup.name: {run.cell: own}} if own else found)
    return is_open and (
        setup.seeds.index(run.seed) < n or (is_last and setup.compare is None)
    )
