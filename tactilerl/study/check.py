"""Could every run of a study start? Asked before the first one does."""

from __future__ import annotations

import dataclasses
from contextlib import closing

from ..algos.mpi import Communicator
from ..errors import InputError, input_errors
from ..runs import arguments as train_flags
from ..runs.config import RunConfig
from ..runs.training import check, make_algorithm
from .folder import StudyFolder
from .grid import Run


def configure(runs: list[Run]) -> dict[str, RunConfig]:
    """The configuration of every run, by name; InputError naming the first invalid run.

    Flags are read once for all runs that differ only in the seed.
    """
    read: dict[tuple[str, str, str], RunConfig] = {}
    configs: dict[str, RunConfig] = {}
    for run in runs:
        try:
            if run.combination not in read:
                flags = run.arguments
                read[run.combination] = train_flags.read(flags, train_flags.defaults(flags))[0]
            config = read[run.combination]
            config = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=run.seed))
            with input_errors():
                config.validate()
        except InputError as error:
            raise InputError(f"run {run.name}: {error}") from error
        configs[run.name] = config
    return configs


def start(runs: list[Run], configs: dict[str, RunConfig], folder: StudyFolder) -> None:
    """Make the environment and the learner of every combination that has not begun yet, as `train`
    would; InputError naming the first run for which that fails."""
    tried = set()
    for run in runs:
        if run.combination in tried or folder.files(run).exists:
            continue
        tried.add(run.combination)
        try:
            learner, pool = make_algorithm(configs[run.name], Communicator())
            with closing(pool), input_errors():
                check(learner)
        except InputError as error:
            raise InputError(f"run {run.name}: {error}") from error


def find_damage(runs: list[Run], configs: dict[str, RunConfig], folder: StudyFolder) -> dict[str, str]:
    """Run folders that cannot go on, and why, by name of the run.

    InputError where a folder holds another run than the study file now asks for.
    """
    damaged = {}
    for run in runs:
        files = folder.files(run)
        if not files.exists or files.damage():  # the latter makes room for another
            continue
        try:
            saved, _ = files.run_dir.read_config()
        except InputError as error:
            damaged[run.name] = str(error)
            continue
        if difference := saved.difference(configs[run.name].identity()):
            raise InputError(
                f"{files.base}: {difference}; give this study another --out, or move that folder away"
            )
    return damaged
