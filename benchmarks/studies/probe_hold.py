"""How often does the probe's early verdict "settled" differ from the full hold, and what does it save?

Plays the same perturbed scripted grasps twice in PyBullet.
Prints a table and writes JSON:

    python -m benchmarks probe_hold --grasps 300 --out docs/data/probe_hold.json
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace

from tactilerl import statistics
from tactilerl.probe import grasps
from tactilerl.probe.grasps import Scenes
from tactilerl.probe.options import GraspFlags
from tactilerl.style import NAMES

from benchmarks.command import count, parser, write
from benchmarks.printing import markdown

SEED = 20_000  # not that of any probe that is reported


def compare(hand: str, n: int) -> dict[str, float]:
    """Verdicts and processor time of `n` grasps, both ways in turn."""
    asked = GraspFlags(env=hand, simulator="pybullet", seed=SEED)
    held: dict[str, list[bool]] = {"full": [], "settled": []}
    seconds = dict.fromkeys(held, 0.0)
    with ExitStack() as opened:
        scenes = {}
        for verdict in held:
            scenes[verdict] = Scenes(replace(asked, hold_verdict=verdict))
            opened.callback(scenes[verdict].close)
        for number in range(n):
            for verdict, env in scenes.items():
                started = time.process_time()
                record = grasps.play(env, number)
                seconds[verdict] += time.process_time() - started
                held[verdict].append(bool(record["held"]))
    changed = sum(a != b for a, b in zip(*held.values(), strict=True))
    low, high = statistics.wilson_interval(changed, n)
    return {
        "grasps": n,
        "held": sum(held["full"]),
        "changed": changed,
        "changed_low": low,
        "changed_high": high,
        "time": seconds["settled"] / seconds["full"],
        "seconds_a_grasp": seconds["settled"] / n,
    }


def show(results: dict[str, dict[str, float]]) -> None:
    """As Markdown."""
    rows = []
    for hand, row in results.items():
        share = f"{row['changed']} ({row['changed_low']:.1%} – {row['changed_high']:.1%})"
        rows.append((NAMES[hand], row["grasps"], row["held"], share, f"{row['time']:.2f}"))
    markdown("| hand | grasps | held | verdicts changed (95 %) | time, of the full one's |", rows)


def main() -> None:
    """Print a table, write JSON after each hand."""
    flags = parser(__doc__)
    flags.add_argument("--hands", nargs="+", default=["shadow", "mpl"])
    flags.add_argument("--grasps", type=count, default=300)
    options = flags.parse_args()
    results = {}
    for hand in options.hands:
        results[hand] = compare(hand, options.grasps)
        write(options.out, results)
    show(results)
