"""What the studies found: the tables of docs/study.md, from the collected data beside it.

python -m benchmarks study_tables
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tactilerl import statistics, style
from tactilerl.statistics import Array, Estimate
from tactilerl.study import records, verdicts
from tactilerl.study.grid import Setup, Study
from tactilerl.study.records import Record

from benchmarks.command import DATA, earlier
from benchmarks.printing import interval, markdown
from benchmarks.studies import gates
from benchmarks.studies.agreement import agreement_of, predicts_order

CHOSEN = re.compile(r"layout \S*_(\d+)\.toml")
COLOURS = dict(zip(("main", "control"), style.ARMS, strict=False))
SIGHTED = "no touch, but sight"
PAIR = "MPL, MuJoCo"  # of the probe's results: the hand and simulator of the handover scenes
BETWEEN = {
    ("2", "4"): "places of the 79 taxels",
    ("2", "3"): "the 15 taxels in the middle of phalanges",
    ("1", "2"): "60 more taxels",
    ("2", "5"): "60 more taxels",
    ("6", "5"): "radius of the 19 taxels",
    ("1", "6"): "120 more taxels, but smaller ones",
}
"""Layouts that the paper compares, or that differ in one thing."""
SETUPS = {
    "mujoco": "Shadow Hand, MuJoCo, DDPG+HER",
    "pybullet": "MPL hand, PyBullet, PPO",
}
"""The paper's, as the tables call them."""
FAULTS = {"dead": "a fifth of the taxels dead", "late": "readings one step (0.1 s) late"}


@cache
def load(name: str) -> tuple[Study, list[Record]]:
    """A collected study with its runs."""
    return records.load(DATA / f"{name}.tar.gz")


def load_setup(name: str, setup_name: str = "") -> tuple[Setup, list[Record]]:
    """One set-up of a collected study, by default its only one, with the study's runs."""
    study, found = load(name)
    (setup,) = (one for one in study.setups if setup_name in ("", one.name))
    return setup, found


def label(cell: str) -> str:
    """A cell as the tables call it: `layout 2`, `layout of the probe's 5`."""
    found = CHOSEN.fullmatch(cell)
    return f"layout of the probe's {found[1]}" if found else cell


def decides(name: str = "handover") -> None:
    """Every arm."""
    study, found = load(name)
    main, *sighted = study.setups
    (cell,) = main.cells
    arms = {style.ROLES[each]: (main, cell, each) for each in main.arms}
    if sighted:
        arms[SIGHTED] = sighted[0], sighted[0].cells[0], ""
    groups = [verdicts.runs_of(found, *place) for place in arms.values()]
    both = (verdicts.scored(score, *groups) for score in ("area", "final"))
    rows = [
        (title, len(area), mean(area.values()), mean(final.values()))
        for title, area, final in zip(arms, *both, strict=True)
    ]
    markdown("| hand | runs | mean success over the run | over its last tenth |", rows)


def worth(name: str = "handover") -> None:
    """Differences within pairs, and the share of the headroom."""
    study, found = load(name)
    setup, (cell,) = study.setups[0], study.setups[0].cells
    rows: list[tuple[object, ...]] = []
    for other in setup.arms[1:]:
        runs = [verdicts.runs_of(found, setup, cell, arm) for arm in (setup.arms[0], other)]
        area, final = (paired(*runs, score) for score in ("area", "final"))
        gaps = (estimate(pairs.difference, "+.2f") for pairs in (area, final))
        title = f"{style.ROLES['on']} − {style.ROLES[other]}"
        rows.append((title, len(area), next(gaps), f"{area.p_value:.3f}", next(gaps)))
    share = verdicts.headroom(study, setup, cell, found, statistics.N_RESAMPLES)
    if share is not None:
        rows.append(("sight − no touch", share.n, estimate(share.room, "+.2f"), "", ""))
        rows.append(
            ("what touch gives of what sight gives", share.n, estimate(share.share, ".2f"), "", "")
        )
    markdown("| difference within pairs | pairs | mean success over the run | p | last tenth |", rows)


def layouts(name: str, setup_name: str = "") -> None:
    """Each layout against its control, and what a scripted hand does with it where that is known."""
    setup, found = load_setup(name, setup_name)
    scripted = reflexes(name)
    rows = []
    for cell, verdict in verdicts.judge(load(name)[0], setup, found).items():
        pairs, where = verdict.pairs, label(cell)
        finals, _ = verdicts.both_arms(found, setup, cell, "final")
        means = (f"{np.mean(v):.2f}" if len(v) else "" for v in (pairs.treatment, pairs.control))
        row = [where.removeprefix("layout "), len(pairs), *means]
        row += [estimate(pairs.difference, "+.2f"), p_value(verdict), mean(finals.values())]
        reflex = f"{scripted[where]:.2f}" if where in scripted else ""
        rows.append([*row, reflex] if scripted else row)
    head = "| layout | pairs | touch | no touch | difference | p, corrected | last tenth, touch |"
    markdown(head + " scripted hand |" * bool(scripted), rows)


def over_layouts(name: str) -> None:
    """What touch adds in each set-up: the mean over its layouts within each seed."""
    study, found = load(name)
    rows, p_values = [], []
    for setup in study.setups:
        seeds, arms = both_by_seed(found, setup)
        if seeds:
            means = arms.mean(axis=1)
            pairs = verdicts.in_pairs([dict(zip(seeds, map(float, one), strict=True)) for one in means])
            rows.append((SETUPS[setup.name], *compared(pairs)))
            p_values.append(pairs.p_value)
    corrected = [f"{p:.3f}" for p in statistics.holm(p_values)]
    head = "| set-up | seeds | touch | no touch | difference | p | p, Holm |"
    markdown(head, [(*row, p) for row, p in zip(rows, corrected, strict=True)])


def both_by_seed(found: list[Record], setup: Setup) -> tuple[list[int], Array]:
    """Seeds that every cell has with touch and without, and what both reach, (2, cells, seeds)."""
    cells = [verdicts.both_arms(found, setup, cell, "area") for cell in setup.cells]
    seeds, scores = in_common([arm for arms in zip(*cells, strict=True) for arm in arms])
    return seeds, scores.reshape(2, len(cells), len(seeds))


def in_common(groups: Sequence[verdicts.BySeed]) -> tuple[list[int], Array]:
    """Seeds that all groups of runs have, and their scores, (groups, seeds)."""
    seeds = sorted(set.intersection(*map(set, groups)))
    return seeds, np.array([[scores[seed] for seed in seeds] for scores in groups])


def agreement(name: str) -> None:
    """Do the set-ups put the layouts into the same order?"""
    study, found = load(name)
    arms = [both_by_seed(found, setup)[1] for setup in study.setups]
    rows = [
        (by, estimate(agreement_of(each), ".2f"))
        for by, each in (
            ("mean with touch", [touch for touch, _ in arms]),
            ("touch − no touch", [touch - control for touch, control in arms]),
        )
    ]
    markdown("| layouts ordered by | rank correlation of the set-ups |", rows)


def between(name: str, setup_name: str = "") -> None:
    """Layouts with touch against each other, in pairs: what the paper says of them."""
    setup, found = load_setup(name, setup_name)
    runs = {cell: verdicts.runs_of(found, setup, cell, "main") for cell in setup.cells}
    pairs = [paired(runs[f"layout {a}"], runs[f"layout {b}"]) for a, b in BETWEEN]
    corrected = statistics.holm([each.p_value for each in pairs])
    rows = [
        (f"{a} − {b}", what, len(each), estimate(each.difference, "+.2f"), f"{p:.3f}")
        for ((a, b), what), each, p in zip(BETWEEN.items(), pairs, corrected, strict=True)
    ]
    markdown("| layouts | they differ in | pairs | difference | p, Holm |", rows)


def trained_with(name: str = "faults", without: str = "handover") -> None:
    """Hands that learned with faulty touch, in pairs with those whose touch was sound or silent."""
    study, found = load(name)
    others, sound = load(without)
    place = others.setups[0], others.setups[0].cells[0]
    rows = []
    for setup in study.setups:
        own = verdicts.runs_of(found, setup, setup.cells[0], "")
        pairs = [paired(own, verdicts.runs_of(sound, *place, arm)) for arm in ("main", "control")]
        differences = (estimate(each.difference, "+.2f") for each in pairs)
        rows.append((FAULTS[setup.name], len(pairs[0]), mean(pairs[0].treatment), *differences))
    head = "| trained with | pairs | mean success | − touch without faults | − no touch |"
    markdown(head, rows)


def p_value(verdict: verdicts.Verdict) -> str:
    """Corrected for cells and looks, or what a look has not decided."""
    if verdict.stage is not None and not verdict.stage.ending:
        return "not decided"
    return f"{verdict.p_holm:.3f}"


def senses(name: str = "senses") -> None:
    """What touch adds, by sight and error of the joints."""
    study, found = load(name)
    cells = study.setups[0].cells
    rows = []
    for setup in study.setups:
        row = [re.sub(r"noisy_(\d)cm", r"error of \1 cm", setup.name)]
        for cell in cells:
            pairs = verdicts.in_pairs(verdicts.both_arms(found, setup, cell, "area"))
            row.append(estimate(pairs.difference, "+.2f") if len(pairs) else "")
        rows.append(row)
    noises = (f"joint error {cell.removeprefix('joint noise held ')} rad" for cell in cells)
    markdown(f"| sight | {' | '.join(noises)} |", rows)


def orders(name: str, setup_name: str = "", pair: str = PAIR) -> None:
    """Do scripted hands and the probe predict the order of layouts in learning?"""
    setup, found = load_setup(name, setup_name)
    runs = {label(cell): verdicts.runs_of(found, setup, cell, "main") for cell in setup.cells}
    runs = {cell: own for cell, own in runs.items() if own}
    areas = dict(zip(runs, verdicts.scored("area", *runs.values()), strict=True))
    seeds, learned = in_common([*areas.values()])
    predictors = {
        "scripted hand with touch, same scene": reflexes(name),
        "probe, gain over joints": probed(pair),
    }
    rows = []
    for title, predictor in predictors.items():
        known = [i for i, cell in enumerate(areas) if cell in predictor]
        if known:
            values = np.array([predictor[cell] for cell in np.array(list(areas))[known]])
            found_order = predicts_order(values, learned[known])
            rows.append((title, len(known), len(seeds), estimate(found_order, ".2f")))
    order = "rank correlation with the mean success over the run"
    markdown(f"| predictor | layouts | seeds | {order} |", rows)


def reflexes(scene: str) -> dict[str, float]:
    """Success of the best scripted hand with touch, by layout."""
    rows = earlier(DATA / "gates.json")["layouts"]
    return {
        f"layout {each}": rows[f"{scene}, layout {each}"]["reflexes"]["touch"]["rate"]
        for each in gates.LAYOUTS
        if f"{scene}, layout {each}" in rows
    }


def probed(pair: str) -> dict[str, float]:
    """Gain in AUC over noisy joint angles, by layout."""
    result = earlier(DATA / "probe.json")[pair]
    gains = {
        f"layout {row['layout']}": row["gain"]
        for row in result["table"]
        if (row["question"], row["metric"], row["joint_noise"]) == ("hold", "auc", 0.05)
        and row["told"] == "joints+taxels"
    }
    chosen = {row["taxels"]: row["gain"] for row in result["selection"]["curve"]}
    return gains | {f"layout of the probe's {n}": chosen[n] for n in (5, 10) if n in chosen}


def mean(values: Iterable[float], form: str = ".2f") -> str:
    """With its interval over runs, or over differences within pairs."""
    found = np.array(list(values))
    return estimate(statistics.mean(found, verdicts.resamples(len(found))), form) if len(found) else ""


def paired(a: list[Record], b: list[Record], score: str = "area") -> verdicts.Pairs:
    """The runs of both that have the same seed, by a score."""
    return verdicts.in_pairs(verdicts.scored(score, a, b))


def compared(pairs: verdicts.Pairs) -> tuple[object, ...]:
    """Their number, both means, the difference and p."""
    means = (f"{np.mean(each):.2f}" for each in (pairs.treatment, pairs.control))
    return len(pairs), *means, estimate(pairs.difference, "+.2f"), f"{pairs.p_value:.3f}"


def estimate(found: Estimate, form: str) -> str:
    """A number with its interval."""
    return interval(*found, form, " to ").replace("-", "−")


def number(value: float, form: str) -> str:
    """With a minus sign, as `estimate` has it."""
    return f"{value:{form}}".replace("-", "−")


def draw(folder: Path) -> None:
    """Learning curves where touch decides (study.png), and what each layout reaches where they decide
    (study_layouts.png)."""
    pictures = {
        "study": (_curves, "handover", 3, "MPL hand in MuJoCo, PPO, layout 2, 30,000 steps"),
        "study_layouts": (_layouts, "handover_fingers", 2, "MPL hand in MuJoCo, PPO, 30,000 steps"),
    }
    for name, (fill, study, columns, title) in pictures.items():
        picture = Figure(figsize=(7, 3.5), layout="constrained")
        fill(picture.subplots(), *load(study))
        picture.suptitle(title, **style.HEAD)
        picture.legend(loc="outside lower center", ncols=columns)
        picture.savefig(folder / f"{name}.png", dpi=style.DPI, metadata={"Software": None})


def _curves(axes: Axes, study: Study, found: list[Record]) -> None:
    """Every run thin, their mean thick."""
    setup = study.setups[0]
    for run_type in setup.arms[:2]:
        runs = [one.curve for one in verdicts.runs_of(found, setup, setup.cells[0], run_type)]
        steps = np.linspace(max(x[0] for x, _ in runs), min(x[-1] for x, _ in runs), 60)
        curves = np.array([np.interp(steps, *run) for run in runs])
        axes.plot(steps, curves.T, color=COLOURS[run_type], lw=0.8, alpha=0.6)
        label = f"{style.ROLES[run_type]}, mean of {len(runs)} runs"
        axes.plot(steps, curves.mean(axis=0), color=COLOURS[run_type], lw=2.5, label=label)
    axes.plot([], [], color=style.INK, lw=0.8, alpha=0.7, label="a run")
    axes.set(title="Handover to the palm", xlabel="environment steps", ylabel="success rate")
    axes.set_ylim(0, 1.02)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _layouts(axes: Axes, study: Study, found: list[Record]) -> None:
    """Success over the last tenth, each run and their mean."""
    (setup,) = study.setups
    labels = [label(cell).removeprefix("layout ").replace("of the ", "") for cell in setup.cells]
    for arm, (run_type, aside) in enumerate(zip(setup.arms, (-0.13, 0.13), strict=True)):
        colour, named = COLOURS[run_type], style.ROLES[run_type]
        for place, cell in enumerate(setup.cells):
            rates = list(verdicts.both_arms(found, setup, cell, "final")[arm].values())
            x, is_first = place + aside, place == 0
            axes.plot(
                [x] * len(rates), rates, "o", color=colour, ms=4, alpha=0.45, mew=0, clip_on=False,
                label=f"{named}, a run" * is_first,
            )  # fmt: skip
            axes.plot(
                [x - 0.12, x + 0.12], [np.mean(rates)] * 2, color=colour, lw=2.5,
                label=f"{named}, mean" * is_first,
            )  # fmt: skip
    axes.set_xticks(range(len(labels)), labels)
    axes.set(title="Handover to the fingers", xlabel="layout", ylim=(0, 1.02))
    axes.set_ylabel("success rate, last tenth of training")
    axes.grid(axis="x", visible=False)


def tables(*rows: tuple[Any, ...]) -> dict[str, partial[None]]:
    """By what the docs call them: what prints each table. A row has the name, a function, and its
    arguments."""
    return {name: partial(show, *of) for name, show, *of in rows}


TABLES = tables(
    ("study arms", decides, "handover"),
    ("study worth", worth, "handover"),
    ("study shuffled", decides, "shuffled"),
    ("study shuffled, in pairs", worth, "shuffled"),
    ("study fingers", layouts, "handover_fingers"),
    ("study palm", layouts, "handover_layouts"),
    ("study orders", orders, "handover_fingers"),
    ("study senses", senses, "senses"),
    ("study between", between, "handover_fingers"),
    ("study trained with faults", trained_with, "faults"),
    ("study paper", over_layouts, "paper"),
    ("study paper, agreement", agreement, "paper"),
    ("study paper, ddpg_her", layouts, "paper", "mujoco"),
    ("study paper, ddpg_her, between", between, "paper", "mujoco"),
    ("study paper, ddpg_her, orders", orders, "paper", "mujoco", "Shadow, MuJoCo"),
    ("study paper, ppo", layouts, "paper", "pybullet"),
    ("study paper, ppo, between", between, "paper", "pybullet"),
    ("study paper, ppo, orders", orders, "paper", "pybullet", "MPL, PyBullet"),
)
