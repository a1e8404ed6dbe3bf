"""How much do two arms of one seed have in common? Correlation of their areas over 40 seeds.

    nice python -m benchmarks pair_correlation --out docs/data/pair_correlation.json    # ten minutes
    python -m benchmarks pair_correlation --as "before"    # the same, with other code in PYTHONPATH

Toys: a point is to be brought to rest (PPO) or to a goal (DDPG+HER). One arm also observes numbers
that mean nothing, at the end and each by its name, as it is with layouts of other sizes.
"""

from __future__ import annotations

import itertools
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks import printing
from benchmarks.command import earlier, on_one_thread, parser, write
from tactilerl import statistics
from tactilerl.algos import recipes
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO
from tactilerl.envs import vector
from tactilerl.envs.toy import LQREnv, PointReachEnv
from tactilerl.runs import training

N_SEEDS = 40
FIRST_SEED = 10_000
ARMS = (0, 6)  # numbers without a meaning
STEADY = recipes.recipe("ppo", "steady")
SMALL = {"hidden": (32, 32)}
HER = DDPGHERConfig(**SMALL, n_cycles=5, n_batches=20, batch_size=128, n_test_rollouts=10, polyak=0.8)
LEARNERS = {
    "ppo": (PPO, LQREnv, replace(STEADY, **SMALL, orthogonal_init=False), 12_000, "mean_return"),
    "ppo, orthogonal start": (PPO, LQREnv, replace(STEADY, **SMALL), 12_000, "mean_return"),
    "ddpg_her": (DDPGHER, PointReachEnv, HER, 8_000, "test_success_rate"),
}
"""Learner, toy, configuration, steps, and what the area is of."""


class NamedBox(gym.spaces.Box):
    """A Box that says what its entries are."""

    def __init__(self, names: list[str]) -> None:
        super().__init__(-np.inf, np.inf, (len(names),), np.float32)
        self.names = names


class Distracted(gym.ObservationWrapper):
    """A toy with `n` more entries of the observation, drawn apart from its starts."""

    side_by_side = "in turn"

    def __init__(self, toy: type[gym.Env], n: int) -> None:
        super().__init__(toy())
        self.n, self.max_episode_steps = n, toy.max_episode_steps
        space = self.env.observation_space
        self.is_dict = isinstance(space, gym.spaces.Dict)
        (size,) = (space["observation"] if self.is_dict else space).shape
        box = NamedBox([*(f"toy {i}" for i in range(size)), *(f"noise {i}" for i in range(n))])
        self.observation_space = box
        if self.is_dict:
            self.observation_space = gym.spaces.Dict({**space.spaces, "observation": box})
            self.compute_reward = self.env.compute_reward

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.noise = np.random.default_rng([seed or 0, 1])
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Any) -> Any:
        if self.is_dict:
            return {**observation, "observation": self._longer(observation["observation"])}
        return self._longer(observation)

    def _longer(self, seen: Any) -> Any:
        return np.append(seen, self.noise.standard_normal(self.n)).astype(np.float32)


def area(name: str, n: int, seed: int) -> float:
    """Mean success or return over a run's steps."""
    kind, toy, config, total, measure = LEARNERS[name]
    with closing(vector.start(partial(Distracted, toy, n))) as workers:
        learner = kind(config, workers, Communicator(), seed, total)
        rows = list(training.epochs(learner))
    steps, rates = (np.array([row[key] for row in rows], float) for key in ("env_steps", measure))
    return float(statistics.area_under_curve(steps, rates[None])[0])


def measure(name: str) -> dict[str, Any]:
    """Areas of both arms by seed, their correlation with its interval, the spread of differences."""
    started, seeds = time.perf_counter(), range(FIRST_SEED, FIRST_SEED + N_SEEDS)
    places = list(itertools.product(seeds, ARMS))
    found = [area(name, n, seed) for seed, n in printing.progress(places, name)]
    a, b = np.array(found).reshape(-1, len(ARMS)).T
    picks = np.random.default_rng(0).integers(N_SEEDS, size=(10_000, N_SEEDS))
    drawn = np.array([np.corrcoef(a[pick], b[pick])[0, 1] for pick in picks])
    return {
        "correlation": float(np.corrcoef(a, b)[0, 1]),
        "interval": list(statistics.percentile_interval(drawn)),
        "sd": float(np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / 2)),
        "sd of differences": float((a - b).std(ddof=1)),
        "areas": [a.tolist(), b.tolist()],
        "seconds": time.perf_counter() - started,
    }


ABOUT = {
    "ppo": "PPO (`steady`, but uniform initial weights), a point to rest",
    "ppo, orthogonal start": "PPO (`steady`), a point to rest",
    "ddpg_her": "DDPG+HER, a point to a goal",
}


def markdown(content: dict[str, Any]) -> None:
    """What `main` wrote of the code before and after, for the docs."""
    rows = []
    for name, about in ABOUT.items():
        found = content[name].values()
        cells = [printing.interval(one["correlation"], *one["interval"], to=" to ") for one in found]
        spreads = " → ".join(f"{one['sd of differences']:.3g}" for one in found)
        rows.append((about, *(cell.replace("-", "−") for cell in cells), spreads))
    codes = " | ".join(f"correlation, {code}" for code in content["ppo"])
    printing.markdown(f"| learner and toy | {codes} | spread of differences |", rows)


def main() -> None:
    """Measure this code; what was measured of other code stays in the file."""
    flags = parser(__doc__)
    flags.add_argument("--as", dest="code", default="now", help="what to call this code")
    flags.add_argument("--only", choices=LEARNERS, help="one learner instead of both")
    options = flags.parse_args()
    on_one_thread()
    result = earlier(options.out)
    for name in [options.only] if options.only else LEARNERS:
        found = measure(name)
        result.setdefault(name, {})[options.code] = found
        low, high = found["interval"]
        print(
            f"{name}, {options.code}: r {found['correlation']:.2f} ({low:.2f}–{high:.2f}), sd of an "
            f"arm {found['sd']:.3f}, of differences {found['sd of differences']:.3f}"
        )
        write(options.out, result)
