"""Does the paper's first set-up learn with two values of its source? Tables of the collected study.

python -m benchmarks paper_source

The questions stand in studies/paper_source.toml. Runs of independent seeds are not compared in pairs.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from tactilerl.statistics import Array
from tactilerl.study.analysis import scored
from tactilerl.study.records import Record
from tactilerl.study.report import p_value

from benchmarks.command import markdown
from benchmarks.studies.layouts_study import contrast
from benchmarks.studies.study_tables import estimate, last_test, load, part

STUDY, LIST = "paper_source", "paper"
TOUCH = {"touch": 1.0, "no touch": -1.0}
SOURCE = {"touch": 0.5, "no touch": 0.5, "list: touch": -0.5, "list: no touch": -0.5}
SCORES = ("last test", "converged success", "mean over the run")


@cache
def groups() -> dict[str, list[Record]]:
    """Return the finished runs with touch and without, and those of the paper's list alone."""
    found = {}
    for prefix, study in (("", STUDY), ("list: ", LIST)):
        runs = [run for run in load(study)[1] if run.run.setup == "pybullet" and run.is_finished]
        for name, touch in (("touch", "on"), ("no touch", "off")):
            chosen = {"layout": "2", "touch": touch}
            found[prefix + name] = [
                run for run in runs if {k: str(run.run.flags[k]) for k in chosen} == chosen
            ]
    return found


def cells(score: str) -> dict[str, Array]:
    """Return a score of the runs (n,) of each group that has it."""
    if score == "converged success":
        by_seed = scored("converged", *groups().values())
        return {name: np.array([*of.values()]) for name, of in zip(groups(), by_seed, strict=True)}
    of_run = last_test if score == "last test" else partial(part, begin=0.0)
    return {name: np.array([*map(of_run, runs)]) for name, runs in groups().items()}


def spread(values: Array) -> str:
    """Return the mean of runs, and the lowest and the highest of them."""
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"


def show() -> None:
    """Print what touch adds, and what the two values do."""
    rows = []
    for score in SCORES:
        of = cells(score)
        levels = [spread(of[name]) for name in TOUCH]
        (touch, p), (source, _) = (
            contrast({("ppo", "mpl"): of}, weights) for weights in (TOUCH, SOURCE)
        )
        is_old = score == "last test"  # of which the older runs have none
        levels += [estimate(touch, "+.2f"), p_value(p)]
        older = [f"{of[name].mean():.2f}" for name in SOURCE if name not in TOUCH]
        rows.append([score, *levels, *(["", "", ""] if is_old else [*older, estimate(source, "+.2f")])])
    head = "| score | touch (lowest to highest run) | no touch | touch − no touch | p |"
    head += " the list alone: touch | no touch |"
    markdown(f"{head} source − list |", rows)


def show_rise() -> None:
    """Print how far updates move the policy, and whether success still rises, in the last fifth."""
    rows = []
    for prefix, title in (("", "both values"), ("list: ", "the list alone")):
        runs = [run for name in TOUCH for run in groups()[prefix + name]]
        last, before, kl = (
            np.array([part(run, *window) for run in runs])
            for window in ((0.8,), (0.6, 0.8), (0.8, 1.0, "kl"))
        )
        rise, _ = contrast({("ppo", "mpl"): {"rise": last - before}}, {"rise": 1.0})
        rows.append([title, len(runs), f"{np.median(kl):.3f}", spread(last), estimate(rise, "+.3f")])
    head = "| | runs | KL divergence of an update (median) | success (lowest to highest run) |"
    markdown(f"{head} − the fifth before |", rows)


TABLES = {"paper source": show, "paper source rise": show_rise}
