"""Print what the committed studies found: tables of the docs, from docs/data.

python -m benchmarks study_tables
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tactilerl import statistics, style
from tactilerl.runs.config import FINAL_TEST
from tactilerl.statistics import Array, Estimate
from tactilerl.study import analysis as study_pairs
from tactilerl.study import records
from tactilerl.study.analysis import BySeed, Pairs
from tactilerl.study.grid import Setup, Study
from tactilerl.study.records import Record

from benchmarks.command import DATA, data, interval, markdown

EARLIER = re.compile(r"layout \S*mpl_mujoco_(\d+)\.toml")
BETWEEN = {
    ("2", "4"): "places of the 79 taxels",
    ("2", "3"): "the 15 taxels in the middle of phalanges",
    ("1", "2"): "60 more taxels",
    ("2", "5"): "60 more taxels",
    ("6", "5"): "radius of the 19 taxels",
    ("1", "6"): "120 more taxels, but smaller ones",
}
"""Layouts that the paper compares, or that differ in one thing."""
SETUPS = {"mujoco": "Shadow Hand, MuJoCo, DDPG+HER", "pybullet": "MPL hand, PyBullet, PPO"}
"""The paper's set-ups, as the tables call them."""
PAPER = {
    "pybullet": "0.65 0.60  0.66 0.61  0.58 0.62  0.59 0.63  0.58 0.58  0.64 0.56",
    "mujoco": "0.82 0.85  0.88 0.81  0.87 0.83  0.80 0.81  0.70 0.84  0.73 0.80",
}
"""Means of the paper's Tables 1 and 2 by layout: converged rate with touch, and without."""
ELSEWHERE = {
    "lift_shadow": "lift, Shadow Hand",
    "lift_shadow_quiet": "the same, persistent with `--action-variance 0.05`",
    "lift_mpl": "lift, MPL hand",
    "lift_mpl_quiet": "the same, persistent with `--action-variance 0.05`",
    "pendulum": "Pendulum-v1",
    "reacher": "Reacher-v5",
}
"""Tasks that the recipes for handovers were not made for."""
FAULTS = {"dead": "a fifth of the taxels dead", "late": "readings one step (0.1 s) late"}


@cache
def load(name: str) -> tuple[Study, list[Record]]:
    """Return a collected study and its runs."""
    return records.load(DATA / f"{name}.tar.gz")


def load_setup(name: str, setup_name: str = "") -> tuple[Setup, list[Record]]:
    """Return a set-up of a study, by default its only one, and the study's runs."""
    study, runs = load(name)
    (setup,) = (one for one in study.setups if setup_name in ("", one.name))
    return setup, runs


def both(runs: list[Record], setup: Setup, setting: str) -> list[list[Record]]:
    """Return the runs of treatment and control in a setting."""
    return [study_pairs.runs_of(runs, setup, setting, group) for group in setup.groups[:2]]


def scored(score: str, *groups: Sequence[Record]) -> list[BySeed]:
    """Return a score of each run, by group and seed; "final" is the mean over the last tenth."""
    if score != "final":
        return study_pairs.scored(score, *groups)
    common = study_pairs.span(itertools.chain(*groups))
    rates = [{one.run.seed: study_pairs.within(one, *common)[1] for one in group} for group in groups]
    return [{seed: statistics.end_rate(y, 0.1) for seed, y in of.items()} for of in rates]


def part(record: Record, begin: float, end: float = 1.0, column: str = "success_rate") -> float:
    """Return a column's mean between two fractions of the steps; a row is of those up to its own."""
    steps, values = record.column("env_steps"), record.column(column)
    before = np.r_[0.0, steps[:-1]]
    until, since = np.minimum(steps, end * steps[-1]), np.maximum(before, begin * steps[-1])
    return float(np.average(values, weights=np.clip(until - since, 0.0, None)))


def last_test(record: Record) -> float:
    """Return the success of a run's last policy, without noise."""
    return float(record.column(FINAL_TEST)[-1])


def label(setting: str) -> str:
    """Return the name of a setting in tables: `2`, `5 of 0.3`."""
    match = EARLIER.fullmatch(setting)
    return f"{match[1]} of 0.3" if match else setting.removeprefix("layout ")


# -- the handover studies ----------------------------------------------------------------


def group_means() -> None:
    """Print what each group of runs reached."""
    study, runs = load("handover")
    main, sighted = study.setups
    groups = {style.ROLES[group]: (main, main.settings[0], group) for group in main.groups}
    groups["no touch, but sight"] = sighted, sighted.settings[0], ""
    by_group = [study_pairs.runs_of(runs, *place) for place in groups.values()]
    areas, finals = (scored(score, *by_group) for score in ("area", "final"))
    rows = [
        (group, len(area), mean(area.values()), mean(final.values()))
        for group, area, final in zip(groups, areas, finals, strict=True)
    ]
    markdown("| hand | runs | mean success over the run | over its last tenth |", rows)


def worth() -> None:
    """Print differences within pairs of touch and each kind of no touch."""
    study, runs = load("handover")
    setup = study.setups[0]
    touch, *others = (study_pairs.runs_of(runs, setup, setup.settings[0], a) for a in setup.groups)
    rows = []
    for group, control in zip(setup.groups[1:], others, strict=True):
        area, final = (paired(touch, control, score) for score in ("area", "final"))
        difference = estimate(area.difference, "+.2f")
        last = estimate(final.difference, "+.2f")
        rows.append(
            (f"touch − {style.ROLES[group]}", len(area), difference, f"{area.p_value:.3f}", last)
        )
    head = "| difference within pairs | pairs | mean success over the run | p | last tenth |"
    markdown(head, rows)


def layouts(name: str, setup_name: str = "") -> None:
    """Print each layout with touch against the same layout without."""
    setup, runs = load_setup(name, setup_name)
    pairs, finals = {}, {}
    for setting in setup.settings:
        groups = both(runs, setup, setting)
        pairs[setting] = paired(*groups)
        finals[setting] = scored("final", *groups)[0]
    scripted = reflexes(name)
    corrected = holm(pairs.values())
    rows = []
    for (setting, pair), p in zip(pairs.items(), corrected, strict=True):
        means = f"{np.mean(pair.treatment):.2f}", f"{np.mean(pair.control):.2f}"
        last = mean(finals[setting].values())
        difference = estimate(pair.difference, "+.2f")
        row = [label(setting), len(pair), *means, difference, f"{p:.3f}", last]
        if scripted:
            rate = scripted.get(label(setting))
            row.append("" if rate is None else f"{rate:.2f}")
        rows.append(row)
    head = "| layout | pairs | touch | no touch | difference | p, Holm | last tenth, touch |"
    markdown(head + (" scripted hand |" if scripted else ""), rows)


def reflexes(scene: str) -> dict[str, float]:
    """Return the success of the best scripted hand with touch, by layout."""
    return {
        key.rpartition(" ")[2]: row["reflexes"]["touch"]["rate"]
        for key, row in data("gates")["layouts"].items()
        if re.fullmatch(rf"{scene}, layout \d", key)
    }


def between() -> None:
    """Print layouts with touch against each other, in pairs."""
    setup, runs = load_setup("handover_fingers")
    by_layout = {
        label(setting): study_pairs.runs_of(runs, setup, setting, "on") for setting in setup.settings
    }
    pairs = [paired(by_layout[a], by_layout[b]) for a, b in BETWEEN]
    rows = [
        (f"{a} − {b}", what, len(pair), estimate(pair.difference, "+.2f"), f"{p:.3f}")
        for ((a, b), what), pair, p in zip(BETWEEN.items(), pairs, holm(pairs), strict=True)
    ]
    markdown("| layouts | they differ in | pairs | difference | p, Holm |", rows)


def trained_with() -> None:
    """Print hands that learned with faulty touch against hands with sound and with no touch."""
    study, runs = load("faults")
    sound, sound_runs = load("handover")
    place = sound.setups[0], sound.setups[0].settings[0]
    rows = []
    for setup in study.setups:
        faulty = study_pairs.runs_of(runs, setup, setup.settings[0], "")
        pairs = [
            paired(faulty, study_pairs.runs_of(sound_runs, *place, group)) for group in ("on", "off")
        ]
        differences = (estimate(pair.difference, "+.2f") for pair in pairs)
        success = mean(pairs[0].treatment)
        rows.append((FAULTS[setup.name], len(pairs[0]), success, *differences))
    head = "| trained with | pairs | mean success | − touch without faults | − no touch |"
    markdown(head, rows)


def senses() -> None:
    """Print what touch adds, by sight and by error of the joints."""
    study, runs = load("senses")
    settings = study.setups[0].settings
    rows = []
    for setup in study.setups:
        row = [re.sub(r"noisy_(\d)cm", r"error of \1 cm", setup.name)]
        for setting in settings:
            row.append(estimate(paired(*both(runs, setup, setting)).difference, "+.2f"))
        rows.append(row)
    noises = (f"joint error {setting.removeprefix('joint noise held ')} rad" for setting in settings)
    markdown(f"| sight | {' | '.join(noises)} |", rows)


# -- the paper's scenes ------------------------------------------------------------------


def over_layouts() -> None:
    """Print what touch adds in each set-up: the mean over its layouts within each seed."""
    study, runs = load("paper")
    rows, pairs = [], []
    for setup in study.setups:
        settings = [scored("area", *both(runs, setup, setting)) for setting in setup.settings]
        seeds, scores = in_common([group for groups in zip(*settings, strict=True) for group in groups])
        means = scores.reshape(2, len(settings), len(seeds)).mean(axis=1)
        pair = study_pairs.in_pairs([dict(zip(seeds, group, strict=True)) for group in means])
        levels = (f"{group.mean():.2f}" for group in means)
        rows.append((SETUPS[setup.name], len(pair), *levels, estimate(pair.difference, "+.2f")))
        pairs.append(pair)
    head = "| set-up | seeds | touch | no touch | difference | p | p, Holm |"
    rows = [
        (*row, f"{pair.p_value:.3f}", f"{p:.3f}")
        for row, pair, p in zip(rows, pairs, holm(pairs), strict=True)
    ]
    markdown(head, rows)


def converged(setup_name: str) -> None:
    """Print the paper's means of the converged rates beside ours."""
    setup, runs = load_setup("paper", setup_name)
    rates = iter(PAPER[setup_name].split())
    rows = []
    for setting in setup.settings:
        theirs = next(rates), next(rates)
        ours = (np.mean([*one.values()]) for one in scored("converged", *both(runs, setup, setting)))
        rows.append((label(setting), *theirs, *(f"{rate:.2f}" for rate in ours)))
    markdown("| layout | paper: touch | no touch | ours: touch | no touch |", rows)


def in_common(by_group: Sequence[BySeed]) -> tuple[list[int], Array]:
    """Return the seeds that all groups have, and their scores, (groups, seeds)."""
    seeds = sorted(set.intersection(*map(set, by_group)))
    return seeds, np.array([[scores[seed] for seed in seeds] for scores in by_group])


def holm(pairs: Iterable[Pairs]) -> Sequence[float]:
    """Return p-values corrected for their number (Holm)."""
    return statistics.holm([pair.p_value for pair in pairs])


def mean(values: Iterable[float]) -> str:
    """Return a mean with its interval, as text."""
    return estimate(average(values), ".2f")


def average(values: Iterable[float]) -> Estimate:
    """Return a mean with its interval over runs, or over differences within pairs."""
    scores = np.array(list(values))
    return statistics.mean(scores, study_pairs.resamples(len(scores)))


def paired(a: list[Record], b: list[Record], score: str = "area") -> study_pairs.Pairs:
    """Return the runs of both groups that have the same seed, by a score."""
    return study_pairs.in_pairs(scored(score, a, b))


def estimate(value: Estimate | list[float], form: str) -> str:
    """Return a number with its interval, as text."""
    return interval(*value, form, " to ").replace("-", "−")


def picture() -> Figure:
    """Draw what each layout reaches where places decide, over the last tenth of the steps."""
    setup, runs = load_setup("handover_fingers")
    levels: dict[str, list[Estimate]] = {style.ROLES[group]: [] for group in setup.groups}
    for setting in setup.settings:
        reached_by = scored("final", *both(runs, setup, setting))
        for of_group, reached in zip(levels.values(), reached_by, strict=True):
            of_group.append(average(reached.values()))
    names = [f"layout {label(setting)}" for setting in setup.settings]
    figure = drawn(levels, names, style.GROUPS)
    figure.axes[0].set(xlabel="success rate, last tenth of training", xlim=(0, 1))
    figure.suptitle("Handover to the fingers: MPL hand, PPO, 30,000 steps", **style.HEAD)
    return figure


def drawn(levels: dict[str, Sequence[Estimate]], names: list[str], colours: Sequence[str]) -> Figure:
    """Return a figure with a row for each name, and in it each level with its interval."""
    figure = Figure(figsize=(7, 0.5 + max(0.55, 0.11 * len(levels)) * len(names)), layout="constrained")
    axes, rows = figure.subplots(), np.arange(len(names))
    for i, (label, of_label) in enumerate(levels.items()):
        means, low, high = np.transpose([(one.value, one.low, one.high) for one in of_label])
        places = rows + 0.65 / len(levels) * (i - (len(levels) - 1) / 2)
        shown: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1.5, "color": colours[i], "label": label}
        axes.errorbar(means, places, xerr=(means - low, high - means), **shown)
    axes.set_yticks(rows, names)
    axes.invert_yaxis()
    axes.margins(y=0.1)
    axes.grid(axis="y", visible=False)
    figure.legend(loc="outside lower center", ncols=5)
    return figure


# -- recipes -----------------------------------------------------------------------------


def elsewhere() -> None:
    """Print PPO's recipe `persistent` against `steady` in other tasks, in pairs of one seed."""
    success = {"last test": last_test, "success over the run": partial(part, begin=0.0)}
    returns = {"return over the run": partial(part, begin=0.0, column="mean_return")}
    runs, rows = [record for record in load("persistent")[1] if record.state == "done"], []
    for setup, task in ELSEWHERE.items():
        groups = [
            [run for run in runs if (run.run.setup, run.run.flags["recipe"]) == of]
            for of in ((setup.removesuffix("_quiet"), "steady"), (setup, "persistent"))
        ]
        scores, form = (success, ".2f") if setup.startswith("lift") else (returns, ".1f")
        for score, of_run in scores.items():
            by_seed = [{run.run.seed: of_run(run) for run in group} for group in groups]
            seeds, (a, b) = in_common(by_seed)
            if seeds:  # the lifts of the MPL hand have not been run
                levels = estimate(average(a), form), estimate(average(b), form)
                difference = estimate(average(b - a), f"+{form}")
                rows.append((task, score, len(seeds), *levels, difference))
    markdown("| task | score | pairs | steady | persistent | persistent − steady |", rows)


TABLES = {
    "study groups": group_means,
    "study worth": worth,
    "study fingers": partial(layouts, "handover_fingers"),
    "study palm": partial(layouts, "handover_layouts"),
    "study between": between,
    "study senses": senses,
    "study trained with faults": trained_with,
    "study elsewhere": elsewhere,
    "paper": over_layouts,
    "paper table 1": partial(converged, "pybullet"),
    "paper table 2": partial(converged, "mujoco"),
    "paper ddpg_her": partial(layouts, "paper", "mujoco"),
    "paper ppo": partial(layouts, "paper", "pybullet"),
}
