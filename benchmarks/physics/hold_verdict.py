"""How often is the early verdict "settled" of the hold test wrong, and what does it save?

Lifts the object, with exploration noise, by trained runs and by disturbed scripted grasps of both
hands in both simulators. Every lift is made twice, in environments that are alike up to the hold
test: one holds it in full, the other until the early verdict.

    python -m benchmarks hold_verdict --run RUN [RUN ...] --out docs/data/hold_verdict.json

What the file says already of other lifts stays in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from tactilerl import envs, statistics
from tactilerl.envs import scripted
from tactilerl.envs.hands import LinearAction
from tactilerl.envs.hold import HoldTest
from tactilerl.envs.simulators import Simulator
from tactilerl.envs.state import Array, State
from tactilerl.runs.policies import read_run

from benchmarks.command import count, earlier, markdown, parser, write

SEED = 50_000
NOISE = 0.05**0.5  # standard deviation of exploration, in units of the action
MISS = 0.1  # of a whole grasp, in units of the action
GENTLE = 0.2  # up and down a full disturbance would knock the cube over
PAIRS = [(hand, simulator) for hand in ("shadow", "mpl") for simulator in ("mujoco", "pybullet")]
Act = Callable[[Any], Array]
Policy = Callable[[Any, np.random.Generator], Act]
"""(environment, random numbers) -> what acts for an episode."""
Source = tuple[str, dict[str, Any], Policy]
"""(hand, its scene's choices, policy)."""


@dataclass
class Watched:
    """Hold tests of an environment by other parameters, with the last verdict and its seconds."""

    env: Any
    fields: dict[str, Any]
    """Of HoldTest."""
    held: bool | None = None
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self._test: HoldTest = replace(self.env.task.hold, **self.fields)
        self.env.task.hold = self

    def run(self, simulator: Simulator, state: State) -> bool:
        """Run the hold test, and remember its verdict."""
        started = time.process_time()
        held = self._test.run(simulator, state)
        self.held, self.seconds = held, time.process_time() - started
        return held


class ScriptedPolicy:
    """A hand's scripted grasp in the units of the action, disturbed.

    Each step has 0.3 to 1 of a policy's exploration, and the whole grasp as much of `MISS`.
    """

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self.env, self.rng = env, rng
        grasp = scripted.grasp_for(env)
        self.targets = [*chain(*scripted.legs(env, grasp, env.config.control_dt))]
        size = env.action_space.shape[0]
        self.gentle = np.where(np.arange(size) == 2, GENTLE, 1.0)
        self.scale = rng.uniform(0.3, 1.0)
        self.miss = MISS * self.scale * rng.standard_normal(size)
        self.steps = 0

    def __call__(self, obs: Any) -> Array:
        """Return the next action."""
        target = self.targets[min(self.steps, len(self.targets) - 1)]
        self.steps += 1
        noise = NOISE * self.scale * self.rng.standard_normal(len(self.miss))
        return np.clip(self._exact(target) + self.gentle * (self.miss + noise), -1.0, 1.0)

    def _exact(self, target: Array) -> Array:
        """Return the action that asks for the target."""
        does = self.env.hand.action_map
        if isinstance(does, LinearAction):
            return (target - does.centre) / does.half_range
        step = [*does.slide_step, *[does.closing_step] * len(does.groups)]
        return (does.commands(target) - does.commands(self.env.state.targets)) / step


def trained(run: Path) -> Source:
    """Return the policy of a run folder."""
    loaded = read_run(run)

    def policy(env: Any, rng: np.random.Generator) -> Act:
        return partial(loaded.policy.act, deterministic=False, rng=rng)

    return loaded.config.run.env, asdict(loaded.config.scene), policy


def disturbed(hand: str, simulator: str) -> Source:
    """Return a hand's scripted grasp."""
    return hand, {"simulator": simulator, "max_episode_steps": 25}, ScriptedPolicy


def measure(
    hand: str, choices: dict[str, Any], policy: Policy, holds: int, tests: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return verdicts and times of `holds` lifts by `tests`, which have fields of HoldTest."""
    world = [Watched(envs.make(hand, **choices), test) for test in tests.values()]
    rows: list[dict[str, Any]] = []
    playing, seed = 0.0, SEED
    while len(rows) < holds:
        playing += lift(world, policy, seed)
        held = [one.held is not None for one in world]
        if held[0]:
            if not all(held):
                raise RuntimeError(f"episode {seed - SEED}: not all environments held the object")
            playing -= world[0].seconds
            rows.append(dict(zip(tests, ((one.held, one.seconds) for one in world), strict=True)))
        seed += 1
    for one in world:
        one.env.close()
    return summary(rows, playing)


def lift(world: list[Watched], policy: Policy, seed: int) -> float:
    """Play an episode in all environments, by the actions in the first; return its seconds."""
    first, *others = world
    obs, _ = first.env.reset(seed=seed)
    for other in others:
        other.env.reset(seed=seed)
    act, done, seconds = policy(first.env, np.random.default_rng([SEED, seed - SEED])), False, 0.0
    for one in world:
        one.held = None
    while not done:
        started = time.process_time()
        action = act(obs)
        obs, _, terminated, truncated, _ = first.env.step(action)
        seconds += time.process_time() - started
        for other in others:
            other.env.step(action)
        done = terminated or truncated
    return seconds


def summary(rows: list[dict[str, Any]], playing: float) -> dict[str, Any]:
    """Return a row of the table from verdicts and seconds."""
    held = {name: np.array([row[name][0] for row in rows]) for name in rows[0]}
    seconds = {name: sum(row[name][1] for row in rows) for name in rows[0]}
    changed = int((held["early"] != held["full"]).sum())
    return {
        "holds": len(rows),
        "held": int(held["full"].sum()),
        "changed": changed,
        "changed_ci": list(statistics.wilson_interval(changed, len(rows))),
        "called_held": int((held["early"] & ~held["full"]).sum()),
        "hold_ratio": seconds["early"] / seconds["full"],
        "share_full": seconds["full"] / (seconds["full"] + playing),
        "share_early": seconds["early"] / (seconds["early"] + playing),
    }


def show(results: dict[str, dict[str, Any]]) -> None:
    """Print the table."""
    rows = []
    for name, row in results.items():
        low, high = row["changed_ci"]
        changed = f"{row['changed']} ({low:.1%} to {high:.1%})"
        shares = (f"{row[share]:.2f}" for share in ("share_full", "share_early"))
        counts = row["holds"], row["held"], changed, row["called_held"]
        rows.append((name, *counts, f"{row['hold_ratio']:.1%}", *shares))
    markdown(
        "| lifts | holds | held in full | verdicts changed (95 %) | of these called held "
        "| time of a hold, relative to full | holds' share of collecting, full | settled |",
        rows,
    )


def main() -> None:
    """Measure every source; write after each."""
    flags = parser(__doc__)
    flags.add_argument("--run", type=Path, nargs="*", default=[], help="folders of trained runs")
    pairs = [f"{hand}/{simulator}" for hand, simulator in PAIRS]
    flags.add_argument("--scripted", nargs="*", default=pairs, choices=pairs, metavar="HAND/SIMULATOR")
    flags.add_argument("--holds", type=count, default=150)
    options = flags.parse_args()
    tests = {"full": {"verdict": "full"}, "early": {"verdict": "settled"}}
    sources = {f"run {run.name}": partial(trained, run) for run in options.run}
    for pair in options.scripted:
        sources[f"scripted {pair}"] = partial(disturbed, *pair.split("/"))
    for name, source in sources.items():
        result = measure(*source(), options.holds, tests)
        results = earlier(options.out) | {name: result}
        show(results)
        write(options.out, results)
