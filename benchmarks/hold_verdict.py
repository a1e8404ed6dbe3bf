"""How often is the early verdict "settled" of the hold test wrong, and what does it save?

Lifts the object by a trained run's policy, or at random, holds it for the full 5,000 steps,
and asks afterwards what the early verdict would have said, and when:

    python benchmarks/hold_verdict.py --run RUN --out docs/data/hold_verdict.json
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import stats

from tactilerl import envs
from tactilerl.envs.hold import LOOK_STEPS, OUT_OF_REACH, SETTLE_STEPS, HoldTest
from tactilerl.evaluate import load_policy

SEED = 40_000
RULES = [(steps, distance) for steps in (400, 800) for distance in (1e-4, 2e-4, 5e-4, 1e-3)]


@dataclass(frozen=True)
class RecordedHold(HoldTest):
    """The full test, remembering where the object was."""

    holds: list[tuple[bool, list[np.ndarray]]] = field(default_factory=list)

    def run(self, simulator: Any, joint_targets: Any, timestep: float) -> bool:
        """As the full test."""
        history = []
        for is_at_top, position in self.positions(simulator, joint_targets, timestep):
            if position[2] < -OUT_OF_REACH:
                self.holds.append((False, history))
                return False
            if is_at_top:
                history.append(position)
        self.holds.append((True, history))
        return True


def judge(rule: HoldTest, history: list[np.ndarray]) -> int | None:
    """Index at which the early verdict calls a success; None when it never does."""
    return next((k for k in range(len(history)) if rule.is_settled(history[: k + 1])), None)


def collect(name: str, run: Path | None, holds: int) -> RecordedHold:
    """Lift by policy or at random until there are `holds` holds."""
    env: Any = envs.make(name)
    policy = None
    if run is not None:
        config, policy, _ = load_policy(run)
        env = config.make_env()
    env._hold = recorder = RecordedHold(**vars(env._hold))
    rng, episode = np.random.default_rng(SEED), 0
    while len(recorder.holds) < holds:
        obs, _ = env.reset(seed=SEED + episode)
        episode, done = episode + 1, False
        while not done:
            noise = 0.05**0.5 * rng.standard_normal(env.action_space.shape)
            action = policy.act(obs) if policy else np.clip(noise, -1, 1)
            obs, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    return recorder


def main() -> None:
    """Judge every recorded hold by every rule."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="shadow", help="environment of random actions")
    parser.add_argument("--run", type=Path, help="run folder whose (noisy) policy lifts")
    parser.add_argument("--holds", type=int, default=150)
    parser.add_argument("--out", type=Path, help="write JSON here")
    options = parser.parse_args()
    test = collect(options.env, options.run, options.holds)
    holds = test.holds
    rows = []
    for steps, distance in RULES:
        window = test.settle_seconds * steps / SETTLE_STEPS
        rule = replace(test, settle_seconds=window, settle_distance=distance)
        calls = [judge(rule, history) for _, history in holds]
        wrong = sum(call is not None and not held for call, (held, _) in zip(calls, holds, strict=True))
        full = sum(len(history) for _, history in holds)
        short = sum(len(h) if call is None else call for call, (_, h) in zip(calls, holds, strict=True))
        interval = stats.binomtest(wrong, len(holds)).proportion_ci(method="wilson")
        rows.append(
            {
                "settle_steps": steps,
                "settle_distance_mm": 1e3 * distance,
                "called_early": sum(call is not None for call in calls),
                "wrong": wrong,
                "wrong_ci": [interval.low, interval.high],
                "speed": full / short,
            }
        )
    drops = [LOOK_STEPS * len(history) for held, history in holds if not held]
    result = {"holds": len(holds), "held": sum(h for h, _ in holds), "drops_at": sorted(drops)}
    result["rules"] = rows
    table = Table(
        title=f"{len(holds)} holds, {result['held']} held; drops at step {result['drops_at']}"
    )
    for column in ("steps", "mm", "called early", "wrong", "95 %", "speed of the hold"):
        table.add_column(column, justify="right")
    for row in rows:
        low, high = row["wrong_ci"]
        table.add_row(
            *(str(row["settle_steps"]), f"{row['settle_distance_mm']:.1f}", str(row["called_early"])),
            *(str(row["wrong"]), f"{100 * low:.1f}–{100 * high:.1f} %", f"{row['speed']:.1f} ×"),
        )
    Console().print(table)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
