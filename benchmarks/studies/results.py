"""The tables of docs/results.md, from the collected studies.

python -m benchmarks results
"""

from __future__ import annotations

import numpy as np
from tactilerl import style
from tactilerl.study import verdicts
from tactilerl.study.tables import median_steps

from benchmarks.printing import markdown
from benchmarks.studies import study_tables
from benchmarks.studies.study_tables import estimate, mean

RUNS = {
    ("learners", "ppo"): {"PPO": ("learners", "ppo", "layout 4", "")},
    ("learners", "updates"): {
        "40 updates per cycle": ("learners", "updates", "layout 2", ""),
        "16 updates per cycle": ("paper", "mujoco", "layout 2", "main"),
    },
}
"""By study and set-up: what stands in a row, and its study, set-up, cell and arm."""


def learned(*of: str) -> None:
    """How far and how fast the runs learned; with two rows, of the seeds that both have, and their
    difference in pairs."""
    rows: list[tuple[object, ...]] = []
    areas: list[verdicts.BySeed] = []
    places = RUNS[of[0], of[1]]
    is_alone = len(places) == 1  # runs of two studies were not timed on one machine
    loaded = {}
    for title, (name, setup_name, cell, arm) in places.items():
        setup, found = study_tables.load_setup(name, setup_name)
        loaded[title] = verdicts.runs_of(found, setup, cell, arm)
    seeds = set.intersection(*({one.run.seed for one in runs} for runs in loaded.values()))
    groups = [[one for one in runs if one.run.seed in seeds] for runs in loaded.values()]
    scored = [verdicts.scored(score, *groups) for score in ("area", "final", "steps to 0.9")]
    for title, runs, area, final, enough in zip(loaded, groups, *scored, strict=True):
        minutes = np.median([one.seconds for one in runs]) / 60
        steps = median_steps(np.array(list(enough.values())))
        row = title, len(area), mean(area.values()), mean(final.values()), steps, f"{minutes:.1f}"
        rows.append(row if is_alone else row[:-1])
        areas.append(area)
    if len(areas) == 2:
        pairs = verdicts.in_pairs(areas)
        difference = estimate(pairs.difference, "+.2f")
        rows.append(("their difference, in pairs", len(pairs), difference, "", ""))
    head = "| runs | seeds | mean success over the run | over its last tenth "
    head += "| steps to 0.9 (median; reached by) |"
    markdown(head + " minutes, median |" * is_alone, rows)


def critic(name: str, setup_name: str, usual: str = "handover") -> None:
    """A critic that sees the truth against one that sees what the policy sees, in each arm."""
    setup, found = study_tables.load_setup(name, setup_name)
    other, sound = study_tables.load_setup(usual, usual)
    rows = []
    for arm in setup.arms:
        seeing = verdicts.runs_of(found, setup, setup.cells[0], arm)
        usual_runs = verdicts.runs_of(sound, other, other.cells[0], arm)
        pairs = study_tables.paired(seeing, usual_runs)
        rows.append((style.ROLES[arm], *study_tables.compared(pairs)))
    markdown("| hand | pairs | critic sees the truth | what the policy sees | difference | p |", rows)


TABLES = study_tables.tables(
    ("results ppo", learned, "learners", "ppo"),
    ("results updates", learned, "learners", "updates"),
    ("results critic", critic, "variants", "critic"),
    ("results fingertips", study_tables.layouts, "variants", "fingertips"),
)
