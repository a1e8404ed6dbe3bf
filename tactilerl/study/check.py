"""Could every run of a study start? Asked before the first one does."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Mapping
from contextlib import closing

from ..algos import recipes
from ..algos.mpi import Communicator
from ..envs import plugins
from ..errors import InputError, input_errors
from ..runs.config import RunConfig
from ..runs.config import configure as configured
from ..runs.training import make_algorithm
from .grid import Run
from .records import Record


def configure(runs: Iterable[Run], trust: bool = True) -> dict[str, RunConfig]:
    """The configuration of every run, by name; InputError naming the first invalid run, or one that
    imports a module where the study file is not to `trust`.

    Flags are read once for all runs that differ only in the seed.
    """
    read: dict[tuple[str, str, str], RunConfig] = {}
    configs: dict[str, RunConfig] = {}
    for run in runs:
        try:
            if run.combination not in read:
                _require_trust(run.modules, trust)
                with input_errors():
                    plugins.import_modules(run.modules)
                flags = {k: v for k, v in run.flags.items() if k != "import"}
                read[run.combination] = configured({**flags, "workers": 1})
            config = read[run.combination]
            config = dataclasses.replace(
                config, run=dataclasses.replace(config.run, seed=run.seed)
            )
            with input_errors():
                config.validate()
            module, colon, _ = config.run.env.partition(":")
            _require_trust([module] if colon else [], trust)
        except InputError as error:
            raise InputError(f"run {run.name}: {error}") from error
        configs[run.name] = config
    return configs


def _require_trust(modules: list[str], trust: bool) -> None:
    if modules and not trust:
        raise InputError(
            f"it imports the module {modules[0]!r}; if you trust it, give --trust"
        )


def require_same(records: Iterable[Record], configs: Mapping[str, RunConfig]) -> None:
    """InputError where a folder holds another run than the study file now asks for. Values that only
    one version knows do not count."""
    for record in records:
        config = configs[record.run.name]
        _require_no_cut(record, config)
        for part, wanted in config.identity().items():
            made = (record.config or {}).get(part) or {}
            if part == "learner" and made:
                wanted, made = (
                    recipes.completed(config.run.algo, each) for each in (wanted, made)
                )
            for key, value in (wanted or {}).items():
                if key in made and made[key] != value:
                    raise InputError(
                        f"run {record.run.name}: {key}: found {value!r}, the run was made with "
                        f"{made[key]!r}; give this study another --out, or move that folder away"
                    )


def _require_no_cut(record: Record, config: RunConfig) -> None:
    """InputError where a run would be cut: the others would be scored over its steps alone."""
    made, wanted = (record.config or {}).get("run", {}), config.run.total_timesteps
    if wanted < (least := made.get("total_timesteps", 0)):
        raise InputError(
            f"run {record.run.name}: total_timesteps: found {wanted}, allowed {least} or more: a run "
            "can be extended, not cut"
        )


def start(
    records: Iterable[Record], configs: Mapping[str, RunConfig]
) -> dict[str, float]:
    """Make the environment and the learner of every combination that has not begun yet, as `train`
    would; InputError naming the first run for which that fails.

    Returns the seconds of a step, by set-up: those of the first cycle of one such run.
    """
    tried, seconds = set(), dict[str, float]()
    for run in (record.run for record in records if record.state == "left"):
        if run.combination not in tried:
            tried.add(run.combination)
            try:
                learner, pool = make_algorithm(configs[run.name], Communicator())
                with closing(pool), input_errors():
                    learner.check()
                    if run.setup not in seconds:
                        began = time.perf_counter()
                        learner.collect()
                        learner.update()
                        spent = time.perf_counter() - began
                        seconds[run.setup] = spent / max(1, learner.env_steps)
            except InputError as error:
                raise InputError(f"run {run.name}: {error}") from error
    return seconds
