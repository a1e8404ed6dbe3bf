"""How fast is DDPG+HER: updates and samples against Stable-Baselines3, where time goes, two ranks?

One thread, one process, the contenders in turn; what counts are the ratios, of medians over
rounds. Scaling starts itself under mpirun. Prints tables and writes JSON:

    python benchmarks/speed_ddpg.py --out docs/data/speed_ddpg.json
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from speed import rounds, show

from tactilerl import envs
from tactilerl.algos import Transition, mpi
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.envs.vector import Envs

OBS, GOAL, ACTIONS, STEPS = 197, 3, 23, 100  # observation and goal together: 200
EPISODES = 50
CYCLES = 3  # of the real run that is taken apart
REPEATS = 3  # of each number of ranks


class RandomGoals(gym.Env[Any, Any]):
    """A goal environment of random numbers, by default in the shapes of the benchmark."""

    max_episode_steps, n_boolean = STEPS, 0

    def __init__(self, n_obs: int = OBS, n_actions: int = ACTIONS) -> None:
        sizes = {"observation": n_obs, "achieved_goal": GOAL, "desired_goal": GOAL}
        boxes = {k: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for k, n in sizes.items()}
        self.observation_space = gym.spaces.Dict(boxes)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (n_actions,), np.float32)
        self.rng, self.steps = np.random.default_rng(0), 0

    def _obs(self) -> dict[str, Any]:
        shapes = {key: box.shape for key, box in self.observation_space.items()}
        return {k: self.rng.standard_normal(shape, dtype=np.float32) for k, shape in shapes.items()}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """A random observation."""
        self.steps = 0
        return self._obs(), {}

    def step(self, action: Any) -> Any:
        """Another, with its reward."""
        self.steps += 1
        obs = self._obs()
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}))
        return Transition(obs, reward, False, self.steps >= STEPS, {})

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        """Sparse."""
        return (np.linalg.norm(achieved - desired, axis=-1) < 1.0) - 1.0


def ours() -> DDPGHER:
    """Our learner with a replay of `EPISODES` random episodes."""
    pool = Envs(RandomGoals, 1)
    learner = DDPGHER(DDPGHERConfig(n_rollouts=EPISODES), pool, mpi.Communicator(), 0, 1)
    learner.collect()
    return learner


def theirs() -> Any:
    """Stable-Baselines3's with the same networks, batch and replay contents."""
    import stable_baselines3 as sb3

    model = sb3.DDPG(
        "MultiInputPolicy", RandomGoals(), replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4}, batch_size=256, buffer_size=100_000,
        learning_starts=EPISODES * STEPS, policy_kwargs={"net_arch": [256] * 3}, device="cpu",
    )  # fmt: skip
    model.learn(EPISODES * STEPS + 1)
    return model


def matrix_products(n: int = 40) -> Callable[[], int]:
    """The matrix products that an update cannot do without."""
    batch, width = 256, 256
    actor, critic = [OBS + GOAL, width, width, width, ACTIONS], [OBS + GOAL + ACTIONS, *[width] * 3, 1]
    # (networks, forward passes, gradients of weights, gradients of inputs)
    work = [(actor, 2, 1, 1), (critic, 3, 1, 2)]
    tensors = {
        (i, o): (torch.randn(batch, i), torch.randn(o, i), torch.randn(batch, o))
        for sizes, *_ in work
        for i, o in itertools.pairwise(sizes)
    }

    def run() -> int:
        for _ in range(n):
            for sizes, forward, of_weights, of_inputs in work:
                for layer, shape in enumerate(itertools.pairwise(sizes)):
                    x, weight, grad = tensors[shape]
                    for _ in range(forward):
                        x @ weight.T
                    for _ in range(of_weights):
                        grad.T @ x
                    for _ in range(of_inputs if layer else of_inputs - 1):
                        grad @ weight
        return n

    return run


def updates_and_samples() -> tuple[dict[str, Any], dict[str, Any]]:
    """Updates and relabelled transitions per second."""
    learner, model = ours(), theirs()

    def sb3_updates() -> int:
        model.train(40, 256)
        return 40

    def sb3_samples() -> int:
        for _ in range(40):
            model.replay_buffer.sample(256)
        return 40 * 256

    rates = rounds(
        {
            "tactilerl": lambda: int(learner.update()["updates"]),
            "stable-baselines3": sb3_updates,
            "matrix products": matrix_products(),
        }
    )
    samples = rounds(
        {
            "tactilerl": lambda: len(learner.replay.sample(40 * 256, 0.8).reward),
            "stable-baselines3": sb3_samples,
        }
    )
    return (
        {"updates_per_s": rates, "ratios": _against(rates)},
        {"transitions_per_s": samples, "ratios": _against(samples)},
    )


def _against(rates: dict[str, float]) -> dict[str, float]:
    return {
        f"tactilerl / {name}": rates["tactilerl"] / rate
        for name, rate in rates.items()
        if name != "tactilerl"
    }


# -- a real run, taken apart -----------------------------------------------------------------


class Watches:
    """Seconds spent in some methods; what one of them spends in another counts for both."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def watch(self, name: str, thing: Any, method: str) -> None:
        """Count the time of `thing.method` as `name`."""
        run = getattr(thing, method)
        self.seconds.setdefault(name, 0.0)

        def timed(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            try:
                return run(*args, **kwargs)
            finally:
                self.seconds[name] += time.perf_counter() - started

        setattr(thing, method, timed)


def worker() -> None:
    """Some cycles on the Shadow Hand on each rank; rank 0 prints where its time went."""
    comm = mpi.world()
    pool = Envs(lambda: envs.make("shadow", task="reach-goal"), 2)
    learner = DDPGHER(DDPGHERConfig(), pool, comm, 0, 1)
    learner.collect()
    learner.update()
    watches = Watches()
    for env in pool.envs:
        watches.watch("physics", env.simulator, "step")  # type: ignore[attr-defined]
    watches.watch("collecting", learner, "collect")
    watches.watch("sampling", learner.replay, "sample")
    watches.watch("all-reduce", learner.adam, "reduce")
    watches.watch("optimiser", learner.adam, "step")
    watches.watch("updating", learner, "update")
    comm.average(0.0)  # start together
    started = time.perf_counter()
    for _ in range(CYCLES):
        sampled = watches.seconds["sampling"]
        learner.collect()
        watches.seconds["sampling"] = sampled  # the normaliser's samples are part of collecting
        learner.update()
    comm.average(0.0)  # and end together
    seconds = time.perf_counter() - started
    s = watches.seconds
    rest = s["updating"] - s["sampling"] - s["all-reduce"] - s["optimiser"]
    shares = {
        "physics": s["physics"],
        "rest of the environment and acting": s["collecting"] - s["physics"],
        "sampling": s["sampling"],
        "normaliser, forward and backward": rest,
        "all-reduce, with waiting": s["all-reduce"],
        "optimiser": s["optimiser"],
    }
    config = learner.config
    updates = CYCLES * config.n_batches
    steps = comm.size * CYCLES * config.n_rollouts * learner.replay.max_steps
    if comm.rank == 0:
        result = {
            "transitions_per_s": comm.size * updates * config.batch_size / s["updating"],
            "env_steps_per_s": steps / seconds,
            "shares": {name: part / seconds for name, part in shares.items()},
        }
        print(json.dumps(result))
    pool.close()


def scaling() -> dict[str, Any]:
    """The same work for each of one and two ranks, in turn."""
    found: dict[int, list[dict[str, Any]]] = {1: [], 2: []}
    for _ in range(REPEATS):
        for ranks, results in found.items():
            command = [str(Path(sys.executable).with_name("mpirun")), "-n", str(ranks)]
            command += [sys.executable, __file__, "--worker"]
            output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            results.append(json.loads(output.strip().splitlines()[-1]))
    result: dict[str, Any] = {"ratios": {}}
    for key in ("transitions_per_s", "env_steps_per_s"):
        rates = {n: statistics.median(r[key] for r in results) for n, results in found.items()}
        result[key] = {f"{n} ranks" if n > 1 else "1 rank": rate for n, rate in rates.items()}
        result["ratios"][f"{key}: 2 ranks / 1 rank"] = rates[2] / rates[1]
    for ranks, results in found.items():
        names = results[0]["shares"]
        result[f"shares at {ranks}"] = {
            name: statistics.median(r["shares"][name] for r in results) for name in names
        }
    return result


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="write JSON here")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    if options.worker:
        worker()
        return
    packages = ("mujoco", "torch", "numpy", "stable_baselines3", "mpi4py")
    result: dict[str, Any] = {
        "machine": {"processor": platform.processor() or platform.machine(), "threads": 1},
        "versions": {name: version(name) for name in packages},
    }
    result["updates"], result["samples"] = updates, samples = updates_and_samples()
    title = f"updates: batch 256, observation and goal {OBS + GOAL}, action {ACTIONS}"
    show(title, updates["updates_per_s"], updates["ratios"])
    show("relabelled transitions", samples["transitions_per_s"], samples["ratios"])
    result["ranks"] = ranks = scaling()
    show("transitions learned from", ranks["transitions_per_s"], ranks["ratios"])
    table = Table("share of time on the Shadow Hand", "1 rank", "2 ranks")
    for name, share in ranks["shares at 1"].items():
        table.add_row(name, f"{share:.3f}", f"{ranks['shares at 2'][name]:.3f}")
    Console().print(table)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
