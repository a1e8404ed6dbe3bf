"""Do policies learn to let the object fall, for the reward of a failed attempt?

Lift-and-hold pays 5 each time that the object falls back to the ground before it counts as lifted, as
often as that happens. This trains the paper's scene (MPL hand, PPO, here in MuJoCo with hold verdicts
"settled") and counts the falls of every training episode.

    nice python -m benchmarks bounces --seeds 2 --out docs/data/bounces.json

Every run is written as soon as it ends, and a second call goes on from there.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from tactilerl import envs
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs.tasks import OUTCOMES
from tactilerl.style import ROLES

from benchmarks.command import run_contenders
from benchmarks.peers.contenders import learn
from benchmarks.printing import markdown

STEPS = 36_000
PARTS = 10  # of a run
SCENE = {"simulator": "mujoco", "hold_verdict": "settled"}
TOUCH = ("on", "off")


class Falls(gym.Wrapper[Any, Any, Any, Any]):
    """Notes each step's outcome in `outcomes`, which all environments of a run share."""

    def __init__(self, touch: str, outcomes: list[float]) -> None:
        super().__init__(envs.make("mpl", touch=touch, **SCENE))
        self.outcomes = outcomes

    def step(self, action: Any) -> Any:
        """A step as usual."""
        result = self.env.step(action)
        self.outcomes.append(float(result[0]["achieved_goal"][-1]))
        return result


def run(touch: str, task: str, seed: int) -> dict[str, Any]:
    """Of each part of one run: episodes, successes, and falls back to the ground."""
    outcomes: list[float] = []
    for _ in learn(PPO, PPOConfig(), partial(Falls, touch, outcomes), seed, STEPS):
        pass
    found = np.array(outcomes)
    names = {"falls": "fell_back", "held": "held", "dropped": "dropped", "timed_out": "timed_out"}
    parts = [
        {name: int((part == np.float32(OUTCOMES[o])).sum()) for name, o in names.items()}
        for part in np.array_split(found, PARTS)
    ]
    return {"steps": len(found), "parts": parts}


def show(content: dict[str, Any]) -> None:
    """Falls per episode in each part, and the share of the last part's episodes that end with a held
    object; as Markdown."""
    rows = []
    for name, found in content["runs"].items():
        episodes = [p["held"] + p["dropped"] + p["timed_out"] for p in found["parts"]]
        falls = [f"{p['falls'] / n:.2f}" for p, n in zip(found["parts"], episodes, strict=True)]
        touch, _, seed = name.split()
        run = f"{ROLES[touch]}, seed {seed}"
        rows.append((run, *falls, f"{found['parts'][-1]['held'] / episodes[-1]:.2f}"))
    tenths = " | ".join(map(str, range(1, PARTS + 1)))
    markdown(f"| run | {tenths} | held at the end |", rows)


def main() -> None:
    """What is missing of all runs."""
    about = {"scene": SCENE, "steps": STEPS}
    show(run_contenders(__doc__, about, run, TOUCH, ("mpl",), first_seed=0, jobs=1))
