"""Runs a study look by look, and no further than its answers need."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from . import records, summary, verdicts
from .folder import StudyFolder
from .grid import Run, Study
from .runner import Ending, Job
from .verdicts import Verdict

PATIENCE = 5.0  # s between questions after runs that another process trains
Endings = dict[Path, Ending]
Found = Mapping[str, Mapping[str, Verdict]]
"""Comparisons by set-up and cell."""
RunAll = Callable[[list[Job]], Endings]
"""`runner.run_all`, given its pool and who watches."""


def run(
    study: Study,
    folder: StudyFolder,
    jobs: Mapping[str, Job],
    run_all: RunAll,
    say: Callable[[str], None],
    collected: Sequence[Path] = (),
) -> Endings:
    """Run jobs, by name of their run, up to one look after the other; how they ended, by `Job.base`.

    What belongs to comparisons that have ended is left out. A look waits for runs that others train.
    """
    assert study.looks is not None
    endings: Endings = {}
    waiting = dict(jobs)
    for n in study.looks.pairs:
        is_last = n == study.looks.pairs[-1]
        found = judge(study, folder, waiting, collected)
        due = [r for r in study.runs() if r.name in waiting and _is_due(study, r, n, is_last, found)]
        batch = [waiting.pop(r.name) for r in due]
        endings |= run_all(batch)
        while busy := [job for job in batch if endings[job.base] == "busy"]:
            time.sleep(PATIENCE)
            endings |= run_all(busy)
        if batch or (is_last and not endings):
            for sentence in answers(study, judge(study, folder, waiting, collected)):
                say(sentence)
    return endings


def judge(
    study: Study, folder: StudyFolder, waiting: Collection[str] = (), collected: Sequence[Path] = ()
) -> Found:
    """All primary comparisons; runs that are `waiting` are not done, whatever was recorded of them."""
    found = [
        replace(record, state="left") if record.run.name in waiting else record
        for record in records.load(folder.path, *collected)[1]
    ]
    return {setup.name: verdicts.judge(study, setup, found) for setup in study.setups}


def answers(study: Study, found: Found) -> list[str]:
    """A sentence for each comparison."""
    return [summary.answer(one, v) for one in study.setups for v in found[one.name].values()]


def have_ended(found: Found) -> bool:
    """Has a look ended every comparison?"""
    stages = [verdict.stage for cells in found.values() for verdict in cells.values()]
    return bool(stages) and all(stage is not None and stage.ending for stage in stages)


def _is_due(study: Study, run: Run, n: int, is_last: bool, found: Found) -> bool:
    """Is a run needed for the look at `n` pairs? What is in no comparison goes on while any does."""
    setup = next(one for one in study.setups if one.name == run.setup)
    own = found[setup.name].get(run.cell)
    is_open = not have_ended({setup.name: {run.cell: own}} if own else found)
    return is_open and (setup.seeds.index(run.seed) < n or (is_last and setup.compare is None))
