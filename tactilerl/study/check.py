"""Could every run of a study start? Asked before the first one does."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from contextlib import closing

from ..algos.mpi import Communicator
from ..errors import InputError, input_errors
from ..runs import arguments as train_flags
from ..runs.config import RunConfig
from ..runs.training import make_algorithm
from .grid import Run
from .records import Record


def configure(runs: Iterable[Run]) -> dict[str, RunConfig]:
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


def require_same(records: Iterable[Record], configs: Mapping[str, RunConfig]) -> None:
    """InputError where a folder holds another run than the study file now asks for. Values that only
    one version knows do not count."""
    for record in records:
        for part, wanted in configs[record.run.name].identity().items():
            made = (record.config or {}).get(part) or {}
            for key, value in (wanted or {}).items():
                if key in made and made[key] != value:
                    raise InputError(
                        f"run {record.run.name}: {key}: found {value!r}, the run was made with "
                        f"{made[key]!r}; give this study another --out, or move that folder away"
                    )


def start(records: Iterable[Record], configs: Mapping[str, RunConfig]) -> None:
    """Make the environment and the learner of every combination that has not begun yet, as `train`
    would; InputError naming the first run for which that fails."""
    tried = set()
    for run in (record.run for record in records if record.state == "left"):
        if run.combination not in tried:
            tried.add(run.combination)
            try:
                learner, pool = make_algorithm(configs[run.name], Communicator())
                with closing(pool), input_errors():
                    learner.check()
            except InputError as error:
                raise InputError(f"run {run.name}: {error}") from error
