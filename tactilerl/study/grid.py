"""The study file: what it may say, and the list of runs that it stands for.

    name = "pilot"
    measure = "success_rate"

    [compare]
    touch = ["on", "off"]                    # treatment, control

    [grid]
    layout = [2, 5]
    touch = ["on", "off"]
    seed = "0-9"

    [setups.pybullet]                        # flags of `tactilerl train`
    algo = "ppo"
    env = "mpl"

    [primary]                                # optional: what the treatments are judged by
    score = "area"

    [looks]                                  # optional: stop as soon as the answer is there
    pairs = [6, 9, 12, 16]

A set-up may have a `measure`, `compare` and `grid` of its own instead of the study's.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from ..envs import validation
from ..envs.validation import require_one_of
from ..errors import InputError, input_errors
from ..files import require_name
from ..style import ROLES

MEASURES = (
    "success_rate",
    "test_success_rate",
)  # columns of progress.csv that are shares
KEYS = {"name", "measure", "compare", "primary", "looks", "grid", "setups"}
OWN_KEYS = {"measure", "compare", "grid"}  # of a set-up, besides flags
SEED, IMPORT = "seed", "import"
TAKEN = {SEED, "out", "resume", "workers", "threads", "tensorboard", "trust", "help"}
TOUCH = ("touch", "run_type")  # the second up to 0.3.0
FLAG = re.compile(r"[a-z][a-z0-9_-]*")
NUMBER = re.compile(r"-\.?\d.*")  # begins as a flag does, but is none
MOST_RUNS = 10_000  # a slip in a grid multiplies

Score = Literal["area", "final", "converged"]
"""What one run reached: docs/statistics.md."""
SCORES: tuple[str, ...] = get_args(Score)


@dataclass(frozen=True)
class Primary:
    """What decides a comparison; written down before the runs."""

    score: Score = "area"


@dataclass(frozen=True)
class Looks:
    """When a study looks at its primary comparisons, and what ends one."""

    pairs: tuple[int, ...] = (6, 9, 12, 16)
    """Seeds that have been run by then; the last look is at all of them."""
    alpha: Annotated[float, "(0, 1)"] = 0.05
    """Error of all looks together; as much of it may be spent as seeds have been run (`spent`)."""
    effect: Annotated[float, "(0, 1)"] = 0.1
    """A comparison ends, too, where a difference of so much is ruled out, either way."""

    def validate(self) -> None:
        """ValueError unless the looks follow one another."""
        if (
            sorted(set(self.pairs)) != list(self.pairs)
            or min(self.pairs, default=0) < 2
        ):
            found = f"found {list(self.pairs)}"
            raise ValueError(
                f"looks: pairs: {found}, allowed increasing numbers, such as [6, 9, 12, 16]"
            )

    def spent(self, n_comparisons: int) -> list[float]:
        """Error of one of so many comparisons (Bonferroni) up to each look: in proportion to the pairs
        (Kim and DeMets 1987)."""
        return [self.alpha / n_comparisons * n / self.pairs[-1] for n in self.pairs]


Part = TypeVar("Part", Primary, Looks)


@dataclass(frozen=True)
class Contrast:
    """Two values of one flag of the grid."""

    flag: str
    treatment: str
    control: str


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
    def cells(self) -> list[str]:
        """The labels of all cells, in order of the grid: `layout 2`."""
        return list(dict.fromkeys(run.cell for run in self.runs(0)))

    @property
    def arms(self) -> list[str]:
        """The values of the compared flag, the treatment first; one nameless arm without one."""
        if self.compare is None:
            return [""]
        first = [self.compare.treatment, self.compare.control]
        rest = [
            text(value)
            for value in self.grid[self.compare.flag]
            if text(value) not in first
        ]
        return first + rest

    @property
    def is_touch(self) -> bool:
        """Are hands with touch compared with hands without?"""
        return self.compare is not None and self.compare.flag in TOUCH

    def label(self, arm: str) -> str:
        """What an arm is called wherever it is shown: `touch`, `polyak 0.9`."""
        return _told(self.compare.flag, arm) if self.compare else arm or "all"

    def runs(self, seed: int) -> Iterator[Run]:
        """Those of one seed, in order of the grid."""
        compared = self.compare.flag if self.compare else ""
        flags = sorted(
            self.grid, key=lambda flag: flag == compared
        )  # the compared one last
        for values in itertools.product(*(self.grid[flag] for flag in flags)):
            chosen = dict(zip(flags, values, strict=True))
            shown = {flag: text(value) for flag, value in chosen.items()}
            parts = [self.name, *map("-".join, shown.items()), f"s{seed}"]
            name = re.sub(r"[^\w.+-]+", "-", "_".join(parts))
            arm = shown.pop(compared, "")
            cell = ", ".join(_told(flag, value) for flag, value in shown.items())
            flags_of = {**self.flags, **chosen}
            yield Run(name, self.name, cell or "all", arm, seed, self.measure, flags_of)

    def names(self, run: Run) -> list[str]:
        """Of the set-up, cell and arm of a run, those that somebody chose."""
        names = [self.name, run.cell, self.label(run.arm) if self.compare else ""]
        return [name for name in names if name not in ("", "all")]


@dataclass(frozen=True)
class Run:
    """One run of the grid."""

    name: str
    """Of its folder."""
    setup: str
    cell: str
    arm: str
    seed: int
    measure: str
    """Of the set-up: the column of progress.csv that is the run's success rate."""
    flags: dict[str, Any]
    """Of `tactilerl train`, without the seed."""

    @property
    def combination(self) -> tuple[str, str, str]:
        """What it shares with the runs that differ in nothing but the seed."""
        return self.setup, self.cell, self.arm

    @property
    def arguments(self) -> list[str]:
        """The command line of `tactilerl train`, without where it is written and what is imported
        first; one core to itself."""
        flags = {flag: value for flag, value in self.flags.items() if flag != IMPORT}
        return ["--workers", "1", *to_arguments(flags), "--seed", str(self.seed)]

    @property
    def modules(self) -> list[str]:
        """What is imported first, as by `train --import`."""
        return [str(name) for name in _as_list(self.flags.get(IMPORT, []))]


@dataclass(frozen=True)
class Study:
    """A checked study file."""

    name: str
    setups: list[Setup]
    primary: Primary = field(default_factory=Primary)
    looks: Looks | None = None

    def runs(self) -> list[Run]:
        """All runs, seed by seed, so that a partial study stays balanced."""
        longest = max(len(setup.seeds) for setup in self.setups)
        runs = [
            run
            for index in range(longest)
            for setup in self.setups
            for seed in setup.seeds[index : index + 1]
            for run in setup.runs(seed)
        ]
        name, times = Counter(run.name for run in runs).most_common(1)[0]
        if times > 1:
            raise ValueError(
                f"grid: {times} runs would be called {name!r}; their values must differ more"
            )
        return runs

    def choose(self, chosen: str, where: object) -> dict[str, tuple[str, ...]]:
        """The runs that have all names of `NAME,NAME` (set-ups, cells, arms), with their other names;
        InputError for a name that no run has."""
        setups = {setup.name: setup for setup in self.setups}
        own = {run.name: setups[run.setup].names(run) for run in self.runs()}
        known = dict.fromkeys(itertools.chain.from_iterable(own.values()))
        names = [name.strip() for name in chosen.split(",") if name.strip()]
        for name in names:
            if name not in known:
                allowed = ", ".join(known)[:300]
                raise InputError(
                    f"{where}: found no {name!r} in it, allowed: {allowed}"
                )
        return {
            run: tuple(name for name in told if name not in names)
            for run, told in own.items()
            if set(names) <= set(told)
        }

    def validate(self) -> None:
        """ValueError naming the first thing that the parts allow, but not together."""
        require_name(self.name, "name")
        if self.looks:
            self.looks.validate()
        for setup in self.setups:
            if (
                self.looks
                and setup.compare
                and len(setup.seeds) != self.looks.pairs[-1]
            ):
                raise ValueError(
                    f"looks: pairs: found {list(self.looks.pairs)}, but {setup.name} has "
                    f"{len(setup.seeds)} seeds; the last look is at all of them"
                )
        n_runs = sum(
            len(one.seeds) * math.prod(map(len, one.grid.values()))
            for one in self.setups
        )
        if n_runs > MOST_RUNS:
            allowed = f"allowed are up to {MOST_RUNS:,} runs in a study"
            raise ValueError(f"setups: found {n_runs:,} runs, {allowed}")
        for run in self.runs():  # of which no two have the same name
            require_name(run.name, "the name of a run")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)


def from_dict(data: Any) -> Study:
    """The study that `as_dict` was made from; what is no such dictionary is an error of any kind.

    Anybody may have written it: it is read as the study file that says the same.
    """
    tables = {}
    for one in data["setups"]:
        setup = Setup(
            **{**one, "compare": one["compare"] and Contrast(**one["compare"])}
        )
        for part in filter(None, (setup, setup.compare)):
            validation.require(type(part), vars(part))
        pair = setup.compare and {
            setup.compare.flag: [setup.compare.treatment, setup.compare.control]
        }
        grid = {**setup.grid, SEED: list(setup.seeds)}
        parts = {"measure": setup.measure, "compare": pair or {}, "grid": grid}
        tables[setup.name] = {**setup.flags, **parts}
    if len(tables) < len(data["setups"]):
        raise ValueError("setups: found one twice")
    known = {
        key: data[key] for key in ("primary", "looks") if data.get(key) is not None
    }
    return _study(
        {"name": data["name"], "setups": tables, **known}
    )  # 0.2.0 had neither of `known`


def read(path: Path) -> Study:
    """Read and check a study file; InputError, one line, for everything that is wrong with it."""
    with input_errors():
        data = validation.read(path, "study file")
        with validation.blamed(str(path)):
            return _study(data)


def _study(data: dict[str, Any]) -> Study:
    validation.only(data, KEYS, "study file")
    setups = validation.table(data, "setups")
    if not setups:
        raise ValueError(
            "setups: found none, expected one or more tables [setups.NAME]"
        )
    found = []
    for name in setups:
        with validation.blamed(f"setups.{name}"[:60]):
            found.append(_setup(name, validation.table(setups, name), data))
    looks = _part(Looks, data, "looks") if "looks" in data else None
    study = Study(data.get("name"), found, _part(Primary, data, "primary"), looks)  # type: ignore[arg-type]
    study.validate()
    return study


def _part(kind: type[Part], data: dict[str, Any], key: str) -> Part:
    """A table that has a dataclass of its own."""
    given = validation.table(data, key, validation.names(kind))
    with validation.blamed(key):
        return validation.make(kind, vars(kind()) | given, key)


def _setup(name: str, own: dict[str, Any], study: dict[str, Any]) -> Setup:
    require_name(name, "name")
    grid = _grid(validation.table(own if "grid" in own else study, "grid"))
    seeds = _seeds(grid.pop(SEED, [0]))
    flags = _flags(
        {key: value for key, value in own.items() if key not in OWN_KEYS}, TAKEN
    )
    if both := sorted(flags.keys() & grid.keys()):
        raise ValueError(
            f"{both[0]}: found in the set-up and in its grid, allowed in one"
        )
    measure = own.get("measure", study.get("measure", MEASURES[0]))
    require_one_of(MEASURES, measure, "measure")
    compare = _compare(
        validation.table(own if "compare" in own else study, "compare"), grid
    )
    return Setup(name, flags, grid, seeds, compare, measure)


def _flags(table: dict[str, Any], taken: set[str]) -> dict[str, Any]:
    """Values by the names of their flags, with underscores, as in config.json."""
    flags = {}
    for key, value in table.items():
        flag = _flag(key)
        if flag in taken:
            decided = "is decided by `tactilerl study`; leave it out"
            raise ValueError(
                f"{key}: {'belongs in the grid' if flag == SEED else decided}"
            )
        if flag in flags:
            raise ValueError(f"{key}: found twice, with a dash and with an underscore")
        _require_values(value, key)
        flags[flag] = value
    return flags


def _grid(table: dict[str, Any]) -> dict[str, list[Any]]:
    taken = (TAKEN | {IMPORT}) - {SEED}
    grid = {flag: _as_list(value) for flag, value in _flags(table, taken).items()}
    for flag, values in grid.items():
        if not values:
            raise ValueError(f"grid: {flag}: found no values, expected one or more")
        (label, times), *_ = Counter(map(text, values)).most_common(1)
        if times > 1:
            raise ValueError(f"grid: {flag}: found {label[:60]} twice")
    return grid


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _seeds(values: list[Any]) -> list[int]:
    seeds: list[int] = []
    for part in ",".join(map(str, values)).split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if last < first:
            raise ValueError(
                f'seed: found {part!r}, expected numbers and ranges, such as "0-9"'
            )
        if len(seeds) + last - first >= MOST_RUNS:
            raise ValueError(f"seed: found {part!r}, allowed up to {MOST_RUNS:,} seeds")
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"seed: found a seed twice in {values!r}")
    return seeds


def _compare(table: dict[str, Any], grid: dict[str, list[Any]]) -> Contrast | None:
    if not table:
        return None
    (key, pair), *others = table.items()
    if others or not isinstance(pair, list) or len(pair) != 2:
        raise ValueError(
            f"compare: found {table!r}, expected one flag with [treatment, control], "
            'such as touch = ["on", "off"]'
        )
    flag, (treatment, control) = _flag(key), map(text, pair)
    if flag not in grid:
        raise ValueError(f"compare: found {key!r}, which is not in the grid")
    for value in (treatment, control):
        require_one_of(map(text, grid[flag]), value, f"compare: {key}")
    if treatment == control:
        raise ValueError(
            f"compare: {key}: found {control!r} as treatment and as control"
        )
    return Contrast(flag, treatment, control)


def _flag(key: str) -> str:
    """A flag's name with underscores, as in config.json; dashes are read as well."""
    if not FLAG.fullmatch(key):
        raise ValueError(
            f"found {key[:60]!r}, expected the name of a flag, such as layout"
        )
    return key.replace("-", "_")


def _require_values(value: Any, where: str) -> None:
    """ValueError unless it is a value of a flag, or a list of such; a text like a flag is none."""
    if isinstance(value, list):
        for one in value:
            _require_values(one, where)
    elif not isinstance(value, bool | int | float | str):
        found = type(value).__name__
        raise ValueError(
            f"{where}: found a {found}, expected a value, or a list of them"
        )
    elif (
        isinstance(value, str) and value.startswith("-") and not NUMBER.fullmatch(value)
    ):
        raise ValueError(f"{where}: found {value[:60]!r}, expected a value, not a flag")


def text(value: Any) -> str:
    """A value of the grid as it is shown."""
    if isinstance(value, bool):
        return str(value).lower()
    return " ".join(map(text, value)) if isinstance(value, list) else str(value)


def _told(flag: str, value: str) -> str:
    """A flag with its value, in words."""
    default = f"{flag.replace('_', ' ')} {value}"
    return ROLES.get(value, default) if flag in TOUCH else default


def to_arguments(flags: dict[str, Any]) -> list[str]:
    """Flags with their values as a command line."""
    arguments: list[str] = []
    for flag, value in flags.items():
        name = flag.replace("_", "-")
        if isinstance(value, bool):
            arguments.append(f"--{name}" if value else f"--no-{name}")
        else:
            arguments += [f"--{name}", *map(text, _as_list(value))]
    return arguments
