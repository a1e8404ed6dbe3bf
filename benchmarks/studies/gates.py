"""What can touch win in each scene, and in a handover with each hand, simulator and layout?

Prints the tables of docs/gates.md and writes JSON; what is in the file already is not played again:

    python -m benchmarks gates --out docs/data/gates.json
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

from tactilerl.envs import scenes, tasks
from tactilerl.envs.grasp import setup
from tactilerl.machine import free_cores
from tactilerl.scripted import gate

from benchmarks.command import count, earlier, interval, markdown, parser, write

HANDS, SIMULATORS = ("mpl", "shadow", "allegro"), ("mujoco", "pybullet")
LAYOUTS = tuple("123456")
LAYOUT_SCENES = ("handover", "handover_fingers")
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
    results = gate.examine(env, config, starts, search, 0, free_cores(), senses=senses)
    rates = {each.name: dataclasses.asdict(each) for each in results}
    whole = {"gate": gate.verdict(results)} if set(rates) >= {"touch", "sighted"} else {}
    return {"scene": name, "env": env, "choices": choices, "reflexes": rates, **whole}


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
        "layouts": [
            (f"{name}, layout {layout}", name, {"layout": layout})
            for name, layout in itertools.product(LAYOUT_SCENES, LAYOUTS)
        ],
    }


def show(table: str, known: dict[str, dict[str, Row]]) -> None:
    """Print a table."""
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
                senses = ("touch",) if table == "layouts" else tuple(gate.SENSES)
                rows[key] = examine(name, options.starts, options.search, senses, **choices)
                write(options.out, known)
        show(table, known)
