"""What can touch win in each scene, and in a handover with each hand, simulator and layout?

Prints the tables of docs/gates.md and writes JSON; what is in the file already is not played again:

    python -m benchmarks gates --out docs/data/gates.json
"""

from __future__ import annotations

import dataclasses
import itertools
from operator import itemgetter
from typing import Any

from tactilerl.envs import scenes, tasks
from tactilerl.envs.grasp import setup
from tactilerl.machine import free_cores
from tactilerl.scripted import gate

from benchmarks.command import count, earlier, interval, markdown, parser, write

HANDS, SIMULATORS = ("mpl", "shadow", "allegro"), ("mujoco", "pybullet")
LAYOUTS = tuple("123456")
LAYOUT_SCENES = ("handover", "handover_fingers")
CHOSEN = "docs/data/chosen/anywhere_8.toml"
SIX = """
description = "six force-sensing resistors of 8 mm"

[[patch]]
digits = ["index", "middle", "ring", "little"]
segments = ["palm"]
offsets_mm = [[0, 0]]
radius_mm = 4

[[patch]]
digits = ["index", "ring"]
segments = ["proximal"]
offsets_mm = [[0, 0]]
radius_mm = 4
"""
FORCES, THRESHOLDS = (0.32, 0.64, 1.28), (0.0, 0.1, 0.3, 0.6)  # N
QUICK = {"hold_verdict": "settled"}  # the full hold of every scene that has one would take hours
Row = dict[str, Any]


def examine(name: str, starts: int, search: int, senses: tuple[str, ...], **choices: Any) -> Row:
    """Return the best scripted hands in a scene with some choices of its own."""
    named = scenes.load(name)
    env = choices.pop("env", named.env)
    config = setup(env, **{**named.on(env), **choices})
    if issubclass(tasks.TASKS[config.task], (tasks.LiftAndHold, tasks.Handover)):
        config = dataclasses.replace(config, **QUICK)
    if config.simulator == "pybullet":  # several times as slow
        starts, search = max(1, starts // 2), max(1, search // 4)
    searched, compared = gate.numbers(0, search, gate.SEARCH), gate.numbers(0, starts)
    results = gate.examine(env, config, searched, compared, free_cores(), senses=senses)
    rates = {each.name: dataclasses.asdict(each) for each in results}
    return {"scene": name, "env": env, "choices": choices, "reflexes": rates}


def tables() -> dict[str, list[tuple[str, str, dict[str, Any]]]]:
    """Return the rows of each table: (row's key, scene, choices)."""
    return {
        "scenes": [(name, name, {}) for name in scenes.names()],
        **{
            scene: [
                (f"{hand}, {simulator}", scene, {"env": hand, "simulator": simulator})
                for hand, simulator in itertools.product(HANDS, SIMULATORS)
            ]
            for scene in ("handover", "handover_anywhere")
        },
        "thresholds": [
            (
                f"{force:g} {threshold:g}",
                "handover",
                {"layout": SIX, "giver_force": force, "taxel_threshold": threshold},
            )
            for force, threshold in itertools.product(FORCES, THRESHOLDS)
        ],
        "layouts": [
            *(
                (f"{name}, layout {layout}", name, {"layout": layout})
                for name, layout in itertools.product(LAYOUT_SCENES, LAYOUTS)
            ),
            ("handover_anywhere, layout 1", "handover_anywhere", {}),
            ("handover_anywhere, 8 chosen", "handover_anywhere", {"layout": CHOSEN}),
        ],
    }


def show_thresholds(known: dict[str, dict[str, Row]]) -> None:
    """Print a row for each force of the giver."""
    rows = known.get("thresholds", {})
    columns = [("without touch", "0", gate.BLIND)]
    columns += [(f"{t:g} N" if t else "any touch", f"{t:g}", ("touch",)) for t in THRESHOLDS]
    columns.append(("sighted", "0", ("sighted",)))

    def cell(force: float, threshold: str, senses: tuple[str, ...]) -> str:
        reflexes = rows[f"{force:g} {threshold}"]["reflexes"]
        best = max((reflexes[sense] for sense in senses if sense in reflexes), key=itemgetter("rate"))
        return interval(best["rate"], *best["interval"])

    head = " | ".join(name for name, *_ in columns)
    forces = [force for force in FORCES if f"{force:g} {THRESHOLDS[-1]:g}" in rows]
    print("\n### thresholds\n")
    markdown(
        f"| giver's force | {head} |",
        ((f"{force:g} N", *(cell(force, *what) for _, *what in columns)) for force in forces),
    )


def show(table: str, known: dict[str, dict[str, Row]]) -> None:
    """Print a table."""
    if table == "thresholds":
        show_thresholds(known)
        return
    played = known.get(table, {})
    rows = {key: played[key]["reflexes"] for key, *_ in tables()[table] if key in played}
    names = [name for name in gate.SENSES if any(name in row for row in rows.values())]
    print(f"\n### {table}\n")
    markdown(f"| | {' | '.join(names)} |", ((key, *_cells(row, names)) for key, row in rows.items()))


def _cells(row: Row, names: list[str]) -> list[str]:
    results = [row.get(name) for name in names]
    return [interval(one["rate"], *one["interval"]) if one else "" for one in results]


def main() -> None:
    """Play what is missing, then print all tables."""
    flags = parser(__doc__)
    flags.add_argument("--starts", type=count, default=200)
    flags.add_argument("--search", type=count, default=20)
    options = flags.parse_args()
    known = earlier(options.out)
    for table, wanted in tables().items():
        rows = known.setdefault(table, {})
        for key, name, choices in wanted:
            if key not in rows:
                is_touch = table == "layouts" or (table == "thresholds" and key[-2:] != " 0")
                senses = ("touch",) if is_touch else tuple(gate.SENSES)
                rows[key] = examine(name, options.starts, options.search, senses, **choices)
                write(options.out, known)
        show(table, known)
