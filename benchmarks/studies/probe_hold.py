"""How often does the probe's early verdict "settled" differ from the full hold, and what does it save?

Plays the same perturbed scripted grasps twice in PyBullet.
Prints a table and writes JSON:

    python -m benchmarks probe_hold --grasps 300 --out docs/data/probe_hold.json
"""

from __future__ import annotations

import time
from contextlib import closing

from benchmarks.command import count, parser, write
from benchmarks.printing import markdown
from tactilerl import statistics
from tactilerl.envs.grasp import setup
from tactilerl.probe.grasps import Scenes, ScriptedGrasps
from tactilerl.probe.options import GraspFlags
from tactilerl.style import NAMES

SEED = 20_000  # not that of any probe that is reported


def compare(hand: str, n: int) -> dict[str, float]:
    """Verdicts and processor time of `n` grasps, both ways in turn."""
    drawn = GraspFlags(env=hand).perturbation
    held: dict[str, list[bool]] = {"full": [], "settled": []}
    seconds = dict.fromkeys(held, 0.0)
    with closing(Scenes(hand, setup(hand, simulator="pybullet"), drawn.variants())) as scenes:
        for number in range(n):
            for verdict in ("full", "settled"):
                started = time.process_time()
                record = ScriptedGrasps(drawn, SEED, verdict)(scenes, number, lambda: True)  # type: ignore[arg-type]
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
