"""The tables of docs/results.md, from the collected studies.

python -m benchmarks results
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.printing import markdown
from benchmarks.studies import answer
from benchmarks.studies.answer import estimate, mean
from tactilerl import style
from tactilerl.study import verdicts
from tactilerl.study.records import Record

ENOUGH = "steps to 0.9"
RUNS = {
    "ppo": {"PPO": ("learners", "ppo", "")},
    "updates": {
        "40 updates per cycle": ("learners", "updates", ""),
        "16 updates per cycle": ("paper", "mujoco", "main"),
    },
}
"""By set-up of `learners`: study, set-up and arm of what stands in a row."""


def learned(_: str, setup_name: str) -> None:
    """How far and how fast the runs learned; with two rows, the difference in pairs."""
    rows: list[tuple[object, ...]] = []
    areas: list[verdicts.BySeed] = []
    for title, place in RUNS[setup_name].items():
        own, measure = runs(*place)
        reached = [verdicts.scores(record, measure) for record in own]
        area, final = ([each[score] for each in reached] for score in ("area", "final"))
        areas.append({record.run.seed: value for record, value in zip(own, area, strict=True)})
        minutes = np.median([record.seconds for record in own]) / 60
        enough = steps([each[ENOUGH] for each in reached])
        rows.append((title, len(own), mean(area), mean(final), enough, f"{minutes:.1f}"))
    if len(areas) == 2:
        pairs = verdicts.in_pairs(*areas)
        difference = estimate(pairs.difference, "+.2f")
        rows.append(("their difference, in pairs", len(pairs), difference, "", "", ""))
    head = "| runs | seeds | mean success over the run | over its last tenth "
    markdown(head + "| 0.9 reached after, median | minutes, median |", rows)


def runs(name: str, setup_name: str, arm: str, layout: str = "layout 2") -> tuple[list[Record], str]:
    """The finished ones of an arm, in the study of layouts of this one; and their measure."""
    setup, found = answer.load_setup(name, setup_name)
    own = [r for r in found if r.run.setup == setup.name and verdicts.is_finished(r, setup.measure)]
    return [r for r in own if not arm or (r.run.arm, r.run.cell) == (arm, layout)], setup.measure


def steps(reached: Sequence[float]) -> str:
    """Their median, and how many got there if not all did."""
    n, median = int(np.isfinite(reached).sum()), np.median(reached)
    text = f"{median:,.0f} steps" if np.isfinite(median) else "not reached"
    return text if n in (len(reached), 0) else f"{text}, by {n}"


def critic(name: str, setup_name: str, usual: str = "handover") -> None:
    """A critic that sees the truth against one that sees what the policy sees, in each arm."""
    (setup, found), (other, sound) = (
        answer.load_setup(name, setup_name),
        answer.load_setup(usual, usual),
    )
    rows = []
    for arm in setup.arms:
        pairs = verdicts.in_pairs(
            verdicts.by_seed(found, setup, setup.cells[0], arm, "area"),
            verdicts.by_seed(sound, other, other.cells[0], arm, "area"),
        )
        means = (f"{np.mean(each):.2f}" for each in (pairs.treatment, pairs.control))
        difference = estimate(pairs.difference, "+.2f")
        rows.append((style.ROLES[arm], len(pairs), *means, difference, f"{pairs.p_value:.3f}"))
    head = "| hand | pairs | critic sees the truth | what the policy sees | difference | p |"
    markdown(head, rows)


TABLES = answer.tables(
    ("results ppo", learned, "learners", "ppo"),
    ("results updates", learned, "learners", "updates"),
    ("results critic", critic, "variants", "critic"),
    ("results fingertips", answer.layouts, "variants", "fingertips"),
)


def main() -> None:
    """All tables."""
    answer.show(TABLES)


if __name__ == "__main__":
    main()
