"""Does a taxel fire whose link does not touch the object? By overlap alone, and by the rule "skin".

Perturbed scripted grasps of every hand in every simulator, read by all six layouts at once. A bit is
false when it is on and the simulator's own distance between its link and the object is above 0.5 mm.

    python -m benchmarks touch_rules --out docs/data/touch_rules.json
"""

from __future__ import annotations

import itertools
import time
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
from tactilerl import envs
from tactilerl.envs import hands, layouts, scripted, simulators, touch
from tactilerl.envs.grasp import GraspEnv
from tactilerl.envs.state import State

from benchmarks.command import count, parser, write
from benchmarks.physics.contacts import distances
from benchmarks.printing import markdown
from benchmarks.timing import rounds

SEED = 60_000
HOLD = 1.0  # s
PHASES = ("approach", "closing", "lift", "hold")
RULES = ("overlap", "skin")
REPEATS = 100  # readings in a row when they are timed


class Overlap:
    """The rule before: on when the taxel's sphere overlaps the object."""

    def __init__(self, taxels: layouts.Taxels) -> None:
        self.points, self.squared_radii = touch.taxel_points(taxels), taxels.radii**2

    def read(self, state: State) -> np.ndarray:
        """bool (n,), as `SkinTouch.read`."""
        return state.shape.squared_distance(self.points.local(state)) <= self.squared_radii


def phases(env: GraspEnv, start: scripted.Offsets) -> Any:
    """Perform a grasp; the name of its phase after each step."""
    dt = scripted.period(env.config.timestep)
    n = [round(seconds / dt) for seconds in (scripted.APPROACH, scripted.CLOSE, scripted.LIFT, HOLD)]
    targets = list(scripted.ramps(env, scripted.grasp_for(env), dt))
    targets += [targets[-1]] * n[-1]
    scripted.place(env, start)
    for phase, target in zip(np.repeat(PHASES, n), targets, strict=True):
        env.simulator.step(target, round(dt / env.config.timestep))
        yield str(phase)


def cost(env: GraspEnv, rules: dict[str, Any]) -> dict[str, float]:
    """Processor time of one reading in layout 1, as a share of a control step's."""
    state = env.simulator.state()

    def read(rule: Any) -> int:
        for _ in range(REPEATS):
            rule.read(state)
        return REPEATS

    def step() -> int:
        env.simulator.step(env.hand.start_targets(), env.config.n_substeps)
        return 1

    contenders = {name: partial(read, rule) for name, rule in rules.items()}
    rates = rounds({**contenders, "step": step}, time.process_time)
    return {name: rates["step"] / rates[name] for name in rules}


def examine(hand: str, simulator: str, grasps: int) -> dict[str, Any]:
    """Bits on, false bits and steps by layout, rule and phase; and what reading costs."""
    with closing(envs.make(hand, simulator=simulator, layout="1")) as env:
        assert isinstance(env, GraspEnv)
        rules: dict[tuple[str, str], Any] = {}
        taxels = {name: layouts.load(name).place(env.hand) for name in layouts.PAPER}
        for name, placed in taxels.items():
            rules[name, "overlap"] = Overlap(placed)
            rules[name, "skin"] = touch.SkinTouch(placed, env.hand)
        counts = {key: {phase: np.zeros(3, int) for phase in PHASES} for key in rules}
        for start in scripted.perturbed_starts(env, SEED, grasps):
            for phase in phases(env, start):
                links = env.taxels.links  # the same in all six
                state = env.simulator.state()
                far = distances(env, links) > touch.SKIN
                for (name, rule), reader in rules.items():
                    on = reader.read(state)
                    false = on & far[taxels[name].link_index]
                    counts[name, rule][phase] += (on.sum(), false.sum(), 1)
        share = cost(env, {rule: rules["1", rule] for rule in RULES})
    rows = [
        {"layout": name, "rule": rule, "phase": phase}
        | dict(zip(("bits", "false", "steps"), numbers.tolist(), strict=True))
        for (name, rule), phases_ in counts.items()
        for phase, numbers in phases_.items()
    ]
    return {"grasps": grasps, "cost_of_control_step": share, "rows": rows}


def cell(row: dict[str, Any]) -> str:
    """Mean bits and the share of false ones, in %."""
    false = f"{100 * row['false'] / row['bits']:.1f}" if row["bits"] else "–"
    return f"{row['bits'] / row['steps']:.2f}, {false}"


def main() -> None:
    """All hands in all simulators."""
    flags = parser(__doc__)
    flags.add_argument("--grasps", type=count, default=20)
    options = flags.parse_args()
    results, columns = {}, list(itertools.product(PHASES, RULES))
    for pair in itertools.product(hands.HANDS, simulators.SIMULATORS):
        title = " in ".join(pair)
        result = results[title] = examine(*pair, options.grasps)
        cells = {(row["layout"], row["phase"], row["rule"]): cell(row) for row in result["rows"]}
        rows = [(name, *(cells[name, *column] for column in columns)) for name in layouts.PAPER]
        shares = {k: f"{100 * v:.2f} %" for k, v in result["cost_of_control_step"].items()}
        print(f"{title}: mean bits, % of them false; a reading {shares}")
        markdown(f"| layout | {' | '.join(map(': '.join, columns))} |", rows)
    write(options.out, results)
