"""How often is the early verdict "settled" of the hold test wrong, and what does it save?

Lifts the object, with exploration noise, by trained runs and by disturbed scripted grasps of both
hands in both simulators. Every lift is made twice, in environments that are alike up to the hold
test: one holds it in full, the other until the early verdict. With --push a third holds it in full
after the hand has moved 1 µm aside, which shows how many verdicts chance alone changes.

    python -m benchmarks hold_verdict --push --run RUN [RUN ...] --out docs/data/hold_verdict.json

What the file says already of other lifts stays in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import stats

from benchmarks.command import count, earlier, parser, write
from tactilerl import envs
from tactilerl.envs import scripted
from tactilerl.envs.hands import Array, ClosingAction
from tactilerl.envs.hold import HoldTest
from tactilerl.runs.policies import read_run

SEED = 50_000
PUSH = 1e-6  # m
NOISE = 0.05**0.5  # standard deviation of exploration, in units of the action
MISS = 0.1  # of a whole grasp, in units of the action
GENTLE = 0.2  # up and down a full disturbance would knock the cube over
PAIRS = [(hand, simulator) for hand in ("shadow", "mpl") for simulator in ("mujoco", "pybullet")]
Act = Callable[[Any], Array]


@dataclass
class Watched:
    """The hold tests of an environment, by other parameters; remembers the last verdict and what it
    took."""

    env: Any
    fields: dict[str, Any]
    """Of HoldTest."""
    aside: float = 0.0
    """By how much the hand moves along x when a test begins, m."""
    held: bool | None = None
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self._hold, self.env._hold = self.env._hold, self.run

    def run(self, test: HoldTest) -> bool:
        """As the environment does."""
        self.env._targets = self.env._targets.copy()
        self.env._targets[0] += self.aside
        started = time.process_time()
        held = self._hold(replace(test, **self.fields))
        self.held, self.seconds = held, time.process_time() - started
        return held


class ScriptedPolicy:
    """A hand's scripted grasp in the units of the action, disturbed by 0.3 to 1 of a policy's
    exploration at every step and by as many `MISS` as a whole."""

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self.env, self.rng = env, rng
        grasp = scripted.grasp_for(env)
        self.targets = list(scripted.ramps(env, grasp, env.config.control_dt))
        size = env.action_space.shape[0]
        self.gentle = np.where(np.arange(size) == 2, GENTLE, 1.0)
        self.scale = rng.uniform(0.3, 1.0)
        self.miss = MISS * self.scale * rng.standard_normal(size)
        self.steps = 0

    def __call__(self, obs: Any) -> Array:
        """The next action."""
        target = self.targets[min(self.steps, len(self.targets) - 1)]
        self.steps += 1
        noise = NOISE * self.scale * self.rng.standard_normal(len(self.miss))
        return np.clip(self._exact(target) + self.gentle * (self.miss + noise), -1.0, 1.0)

    def _exact(self, target: Array) -> Array:
        mapping, now = self.env.hand.action_map, self.env._targets
        if not isinstance(mapping, ClosingAction):
            return (target - mapping.centre) / mapping.half_range
        first = [group[0] for group in mapping.groups]
        way = (mapping.closed - mapping.open)[first]
        closing = (target - now)[first] / way / mapping.closing_step
        return np.concatenate([(target - now)[:3] / mapping.slide_step, closing])


def trained(run: Path) -> tuple[str, dict[str, Any], Callable[[Any, int], Act]]:
    """(hand, its scene's choices, policy of an episode) of a run folder."""
    found = read_run(run)

    def policy(env: Any, episode: int) -> Act:
        return partial(
            found.policy.act, deterministic=False, rng=np.random.default_rng([SEED, episode])
        )

    return found.config.run.env, asdict(found.config.scene), policy


def disturbed(hand: str, simulator: str) -> tuple[str, dict[str, Any], Callable[[Any, int], Act]]:
    """The same of the hand's scripted grasp."""
    return (
        hand,
        {"simulator": simulator, "max_episode_steps": 25},
        lambda env, episode: ScriptedPolicy(env, np.random.default_rng([SEED, episode])),
    )


def measure(
    hand: str,
    choices: dict[str, Any],
    policy: Callable[[Any, int], Act],
    holds: int,
    tests: dict[str, tuple[dict[str, Any], float]],
) -> dict[str, Any]:
    """Verdicts and times of `holds` lifts by `tests`: each has fields of HoldTest and a push."""
    world = [Watched(envs.make(hand, **choices), *test) for test in tests.values()]
    rows: list[dict[str, Any]] = []
    playing, episode = 0.0, 0
    while len(rows) < holds:
        first, *others = world
        obs, _ = first.env.reset(seed=SEED + episode)
        for other in others:
            other.env.reset(seed=SEED + episode)
        act, done = policy(first.env, episode), False
        for one in world:
            one.held = None
        episode += 1
        while not done:
            started = time.process_time()
            action = act(obs)
            obs, _, terminated, truncated, _ = first.env.step(action)
            playing += time.process_time() - started
            for other in others:
                other.env.step(action)
            done = terminated or truncated
        if first.held is not None:
            if any(one.held is None for one in others):
                raise RuntimeError(f"episode {episode - 1}: not all environments held the object")
            playing -= first.seconds
            rows.append(dict(zip(tests, ((one.held, one.seconds) for one in world), strict=True)))
    for one in world:
        one.env.close()
    return summary(rows, playing)


def summary(rows: list[dict[str, Any]], playing: float) -> dict[str, Any]:
    """What the table has, of verdicts and seconds."""
    held = {name: np.array([row[name][0] for row in rows]) for name in rows[0]}
    seconds = {name: sum(row[name][1] for row in rows) for name in rows[0]}
    changed = int((held["early"] != held["full"]).sum())
    interval = stats.binomtest(changed, len(rows)).proportion_ci(method="wilson")
    return {
        "holds": len(rows),
        "held": int(held["full"].sum()),
        "changed": changed,
        "changed_ci": [interval.low, interval.high],
        "called_held": int((held["early"] & ~held["full"]).sum()),
        "changed_by_push": int((held["pushed"] != held["full"]).sum()) if "pushed" in held else None,
        "hold_ratio": seconds["early"] / seconds["full"],
        "share_full": seconds["full"] / (seconds["full"] + playing),
        "share_early": seconds["early"] / (seconds["early"] + playing),
    }


def show(results: dict[str, dict[str, Any]]) -> None:
    """Print a table."""
    table = Table(title='The verdict "settled" against the full hold')
    columns = ("lifts", "holds", "held", "changed (95 %)", "called held", "changed by 1 µm")
    for column in (*columns, "time of a hold", "share of holds: full", "settled"):
        table.add_column(column)
    for name, row in results.items():
        low, high = (100 * bound for bound in row["changed_ci"])
        table.add_row(
            *(name, str(row["holds"]), str(row["held"])),
            *(f"{row['changed']} ({low:.1f}–{high:.1f} %)", str(row["called_held"])),
            *(
                str(row["changed_by_push"] if row["changed_by_push"] is not None else "–"),
                f"{100 * row['hold_ratio']:.1f} %",
            ),
            *(f"{row['share_full']:.2f}", f"{row['share_early']:.2f}"),
        )
    Console(width=160).print(table)


def main() -> None:
    """Measure every source; write after each."""
    flags = parser(__doc__)
    flags.add_argument("--run", type=Path, nargs="*", default=[], help="folders of trained runs")
    pairs = [f"{hand}/{simulator}" for hand, simulator in PAIRS]
    flags.add_argument("--scripted", nargs="*", default=pairs, choices=pairs, metavar="HAND/SIMULATOR")
    flags.add_argument("--holds", type=count, default=150)
    flags.add_argument("--push", action="store_true", help="hold a third time, 1 µm aside")
    flags.add_argument("--early", nargs="*", default=[], metavar="FIELD=VALUE", help="of HoldTest")
    options = flags.parse_args()
    fields = {name: float(value) for name, value in (pair.split("=") for pair in options.early)}
    tests: dict[str, tuple[dict[str, Any], float]] = {
        "full": ({"verdict": "full"}, 0.0),
        "early": ({"verdict": "settled", **fields}, 0.0),
    }
    if options.push:
        tests["pushed"] = ({"verdict": "full"}, PUSH)
    sources = {f"run {run.name}": lambda run=run: trained(run) for run in options.run}
    for pair in options.scripted:
        sources[f"scripted {pair}"] = lambda pair=pair: disturbed(*pair.split("/"))
    for name, source in sources.items():
        result = measure(*source(), options.holds, tests)
        results = earlier(options.out)
        results[name] = result
        show(results)
        write(options.out, results)
