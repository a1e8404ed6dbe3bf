"""The study file: what it may say, and the list of runs that it stands for.

    name = "pilot"
    measure = "success_rate"
    score = "area"                           # optional: what a comparison is decided by

    [compare]
    touch = ["on", "off"]                    # treatment, control

    [grid]
    layout = [2, 5]
    touch = ["on", "off"]
    seed = "0-9"

    [setups.pybullet]                        # flags of `tactilerl train`
    algo = "ppo"
    env = "mpl"

A set-up may have a `measure`, `compare` and `grid` of its own instead of the study's. A
setting is one combination of the grid's values, without the seed and the compared flag;
a group is the runs of a setting that share a value of the compared flag.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

from ..envs import validation
from ..envs.validation import require_known, require_one_of
from ..errors import input_errors
from ..files import require_name
from ..runs.config import RunConfig, configure
from ..style import ROLES

MAX_SEEDS = 100_000
LONGEST_NAME = 245  # bytes; of a file with an ending, 255
MEASURES = ("success_rate", "test_success_rate")  # columns of progress.csv
KEYS = {"name", "measure", "score", "compare", "grid", "setups"}
SETUP_KEYS = {"measure", "compare", "grid"}  # of a set-up, besides flags
SEED = "seed"
RESERVED_FLAGS = {SEED, "out", "workers"}
N_TEST_EPISODES = 200  # at the end of a run, where the study does not say how many

Score = Literal["area", "last", "converged", "test"]
"""The number that a run is judged by: docs/statistics.md; test: that at its end,
without noise."""


@dataclass(frozen=True)
class Contrast:
    """Two values of one flag of the grid."""

    flag: str
    treatment: str
    control: str


@dataclass(frozen=True)
class Run:
    """One run of the grid."""

    name: str
    """Name of its folder."""
    setup: str
    setting: str
    group: str
    seed: int
    measure: str
    """The column of progress.csv that is the run's success rate."""
    flags: dict[str, Any]
    """Choices for `configure`, without the seed."""

    @property
    def place(self) -> tuple[str, str, str]:
        """Set-up, setting and group, which runs share that differ in nothing but the seed."""
        return self.setup, self.setting, self.group

    def config(self) -> RunConfig:
        """Return the configuration of the run; raise InputError naming what is wrong with it."""
        return self._config

    @cached_property
    def _config(self) -> RunConfig:
        usual = {"n_test_episodes": N_TEST_EPISODES}
        return configure({**usual, **self.flags, SEED: self.seed, "workers": 1})


@dataclass(frozen=True)
class Setup:
    """One set-up: fixed flags, and the grid of the others."""

    name: str
    flags: dict[str, Any]
    grid: dict[str, list[Any]]
    seeds: list[int]
    compare: Contrast | None
    measure: str

    @property
    def settings(self) -> list[str]:
        """The labels of all settings, in order of the grid: `layout 2`."""
        return list(dict.fromkeys(run.setting for run in self.runs(0)))

    @property
    def groups(self) -> list[str]:
        """The values of the compared flag, the treatment first; one nameless group without one."""
        if self.compare is None:
            return [""]
        pair, values = self.compare, map(text, self.grid[self.compare.flag])
        return list(dict.fromkeys([pair.treatment, pair.control, *values]))

    def label(self, group: str) -> str:
        """Return what a group is called wherever it is shown: `touch`, `polyak 0.9`."""
        return _label(self.compare.flag, group) if self.compare else group or "all"

    def runs(self, seed: int) -> Iterator[Run]:
        """Yield the runs of one seed, in order of the grid."""
        compared = self.compare.flag if self.compare else ""
        flags = sorted(self.grid, key=lambda flag: flag == compared)  # that one last
        for values in itertools.product(*(self.grid[flag] for flag in flags)):
            chosen = dict(zip(flags, values, strict=True))
            shown = {flag: text(value) for flag, value in chosen.items()}
            parts = [self.name, *map("-".join, shown.items()), f"s{seed}"]
            name = re.sub(r"[^\w.+-]+", "-", "_".join(parts))
            group = shown.pop(compared, "")
            setting = ", ".join(itertools.starmap(_label, shown.items())) or "all"
            flags_of_run = {**self.flags, **chosen}
            yield Run(name, self.name, setting, group, seed, self.measure, flags_of_run)


@dataclass(frozen=True)
class Study:
    """A checked study file."""

    name: str
    setups: list[Setup]
    score: Score = "area"
    """The score that decides a comparison; it is written down before the runs."""

    def runs(self) -> list[Run]:
        """Return all runs, seed by seed, so that a partial study stays balanced."""
        longest = max(len(setup.seeds) for setup in self.setups)
        return [
            run
            for index in range(longest)
            for setup in self.setups
            for seed in setup.seeds[index : index + 1]
            for run in setup.runs(seed)
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return dataclasses.asdict(self)


def from_dict(data: dict[str, Any]) -> Study:
    """Return the study that `as_dict` made a dictionary of."""
    setups = []
    for one in data["setups"]:
        pair = one["compare"]
        setups.append(Setup(**{**one, "compare": pair and Contrast(**pair)}))
    score = data.get("score") or data["primary"]["score"]  # as 0.5.0 has it
    return Study(data["name"], setups, "last" if score == "final" else score)


def read(path: Path) -> Study:
    """Read and check a study file; raise InputError, in one line, for what is wrong with it."""
    with input_errors():
        data = validation.read(path, "study file")
        with validation.blamed(str(path)):
            return _study(data)


def _study(data: dict[str, Any]) -> Study:
    require_known(data, KEYS)
    name, score = require_name(data.get("name"), "name"), data.get("score", "area")
    require_one_of(get_args(Score), score, "score")
    setups = []
    for setup in validation.require_type(data.get("setups"), dict, "setups"):
        with validation.blamed(f"setups.{setup}"[:60]):
            table = validation.table(data["setups"], setup)
            setups.append(_setup(require_name(setup, "name"), table, data))
    if not setups:
        raise ValueError("setups: found none, allowed one or more")
    study = Study(name, setups, score)
    if score == "test" and any(
        run.flags.get("n_test_episodes") == 0 for run in study.runs()
    ):
        raise ValueError("score: found test, but n_test_episodes is 0")
    for name, times in Counter(run.name for run in study.runs()).items():
        if (n := len(name.encode())) > LONGEST_NAME:
            raise ValueError(
                f"grid: found a name of {n} bytes for a run, allowed {LONGEST_NAME}: {name[:60]!r}...; "
                "give its files shorter paths"
            )
        if times > 1:
            raise ValueError(
                f"grid: {times} runs would be called {name!r}; values must differ more"
            )
    return study


def _setup(name: str, table: dict[str, Any], study: dict[str, Any]) -> Setup:
    parts = {"measure": MEASURES[0], **study, **table}
    flags = {flag: value for flag, value in table.items() if flag not in SETUP_KEYS}
    grid = {flag: _as_list(x) for flag, x in validation.table(parts, "grid").items()}
    seeds = _seeds(grid.pop(SEED, [0]))
    for flag in RESERVED_FLAGS & (flags.keys() | grid.keys()):
        raise ValueError(
            f"{flag}: leave it out; seeds belong in the grid, the rest to `study run`"
        )
    for flag in flags.keys() & grid.keys():
        raise ValueError(f"{flag}: found in the set-up and in the grid, allowed in one")
    for flag, values in {SEED: seeds, **grid}.items():
        if not values:
            raise ValueError(f"{flag}: found no values in the grid")
    compare = _compare(validation.table(parts, "compare"), grid)
    require_one_of(MEASURES, parts["measure"], "measure")
    return Setup(name, flags, grid, seeds, compare, parts["measure"])


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _seeds(values: list[Any]) -> list[int]:
    seeds: list[int] = []
    for part in ",".join(map(str, values)).split(","):
        first, _, last = part.partition("-")
        try:
            begin, end = int(first), int(last or first) + 1
        except ValueError:
            raise ValueError(
                f'seed: found {part[:60]!r}, expected numbers and ranges, such as "0-9"'
            ) from None
        if end - begin > MAX_SEEDS:
            raise ValueError(f"seed: found {part!r}, allowed {MAX_SEEDS:,} seeds")
        seeds += range(begin, end)
    return seeds


def _compare(table: dict[str, Any], grid: dict[str, list[Any]]) -> Contrast | None:
    if not table:
        return None
    (flag, pair), *others = table.items()
    values = [*map(text, _as_list(pair))]
    if others or len(values) != 2 or len({*values}) != 2:
        raise ValueError(
            f"compare: found {table!r}, expected one flag with [treatment, control], "
            'such as touch = ["on", "off"]'
        )
    require_one_of(grid, flag, "compare")
    for value in values:
        require_one_of(map(text, grid[flag]), value, f"compare: {flag}")
    return Contrast(flag, *values)


def text(value: Any) -> str:
    """Return a value of the grid as it is shown."""
    if isinstance(value, bool):
        return str(value).lower()
    return " ".join(map(text, value)) if isinstance(value, list) else str(value)


def _label(flag: str, value: str) -> str:
    """Return a flag with its value, in words."""
    words = f"{flag.replace('_', ' ')} {value}"
    return ROLES.get(value, words) if flag == "touch" else words
