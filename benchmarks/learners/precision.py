"""Is float32 enough, and are products in bfloat16?

The learners' updates against the same updates in float64, and bootstrap intervals, ours and
rliable's, against an exact one.

100 minibatch updates on identical data, at the sizes of the paper's set-ups; then intervals of a
mean of five numbers, all of whose 3,125 resamples can be listed. Prints tables and writes JSON:

    python -m benchmarks precision --out docs/data/precision.json
"""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.command import Part, run_parts
from benchmarks.learners.random_goals import RandomGoals
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import FlatAdam, Precision, has_bfloat16, matrix_products
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector
from tactilerl.runs.evaluation import mean_interval

UPDATES = 100
SCORES = np.array([0.31, 0.44, 0.47, 0.66, 0.85])
RESAMPLES = (100, 1_000, 9_999, 50_000)
LEARNERS, BOOTSTRAPS = range(5), range(10)  # seeds


Updates = tuple[Any, list[tuple[torch.Tensor, ...]], Callable[[Any], list[FlatAdam]]]
"""(learner, minibatches, its optimisers remade)"""


def ppo(seed: int) -> Updates:
    """At the sizes of the MPL hand, layout 2."""
    workers = vector.start(lambda: RandomGoals(n_obs=94, n_actions=7))
    learner: Any = PPO(PPOConfig(), workers, Communicator(), seed, 10**6)
    learner.collect()
    batch, rng = learner._batch(), np.random.default_rng(seed)
    n = len(batch[0])
    minibatches = []
    while len(minibatches) < UPDATES:
        order = torch.from_numpy(rng.permutation(n))
        minibatches += zip(*(torch.tensor_split(part[order], 6) for part in batch), strict=True)

    def optimisers(twin: Any) -> list[FlatAdam]:
        twin.actor_adam = FlatAdam((twin.actor, twin.config.actor_lr))
        twin.critic_adam = FlatAdam((twin.critic, twin.config.critic_lr))
        return [twin.actor_adam, twin.critic_adam]

    return learner, minibatches[:UPDATES], optimisers


def ddpg(seed: int) -> Updates:
    """At the sizes of the Shadow Hand, layout 2."""
    workers = vector.start(lambda: RandomGoals(n_obs=140, n_actions=23))
    learner: Any = DDPGHER(DDPGHERConfig(buffer_size=4000), workers, Communicator(), seed, 10**6)
    for _ in range(20):
        learner.collect()
    minibatches = []
    for _ in range(UPDATES):
        sample = learner.replay.sample(learner.config.batch_size, learner.config.replay_p)
        tensors = type(sample)(*map(torch.from_numpy, sample))
        with torch.no_grad():
            minibatches.append(learner._prepared(tensors))

    def optimisers(twin: Any) -> list[FlatAdam]:
        config = twin.config
        twin.adam = FlatAdam((twin.actor, config.actor_lr), (twin.critic, config.critic_lr))
        return [twin.adam]

    return learner, minibatches, optimisers


PRODUCTS: dict[str, tuple[torch.dtype, Precision]] = {
    "float64": (torch.float64, "float32"),
    "float32": (torch.float32, "float32"),
    "bfloat16": (torch.float32, "bfloat16"),
}
"""What multiplies: type of everything else, products of float32."""


def drift(learner: Any, minibatches: list[tuple[torch.Tensor, ...]], optimisers: Any) -> dict[str, Any]:
    """How far parameters end from float64's, relative to the way these went; and how fast."""
    ends, seconds = {}, {}
    for name in PRODUCTS if has_bfloat16() else ("float64", "float32"):
        dtype, products = PRODUCTS[name]
        twin = copy.copy(learner)
        twin.actor, twin.critic = (
            copy.deepcopy(net).to(dtype) for net in (learner.actor, learner.critic)
        )
        adams = optimisers(twin)
        start = torch.cat([adam.vector.detach().double().clone() for adam in adams])
        data = [tuple(part.to(dtype) for part in minibatch) for minibatch in minibatches]
        started = time.process_time()
        with matrix_products(products):
            for minibatch in data:
                twin._minibatch(*minibatch)
        seconds[name] = time.process_time() - started
        ends[name] = torch.cat([adam.vector.detach().double() for adam in adams])
    way = (ends["float64"] - start).norm()
    return {
        name: {
            "parameter_error": float((end - ends["float64"]).norm() / way),
            "speed": seconds["float64"] / seconds[name],
        }
        for name, end in ends.items()
        if name != "float64"
    }


def learners() -> dict[str, Any]:
    """Both, from several first weights."""
    result: dict[str, Any] = {}
    for learner, make in (("ppo", ppo), ("ddpg_her", ddpg)):
        found = [drift(*make(seed)) for seed in LEARNERS]
        result[learner] = {}
        for name in found[0]:
            errors, speeds = ([row[name][key] for row in found] for key in ("parameter_error", "speed"))
            result[learner][name] = {
                "parameter_error_median": float(np.median(errors)),
                "parameter_error_worst": max(errors),
                "speed": float(np.median(speeds)),
            }
    return result


def show_learners(found: dict[str, Any]) -> None:
    """One table."""
    table = Table(f"{UPDATES} updates", "products", "error of the parameters", "worst", "speed")
    for learner, rows in found.items():
        for name, row in rows.items():
            errors = (f"{row[f'parameter_error_{which}']:.2g}" for which in ("median", "worst"))
            table.add_row(learner, name, *errors, f"{row['speed']:.2f}")
    Console().print(table)


def our_interval(resamples: int, seed: int) -> Any:
    """What `evaluate` uses."""
    return mean_interval(SCORES, resamples, seed)


def rliable_interval(resamples: int, seed: int) -> Any:
    """The stratified bootstrap of rliable, with one task."""
    from rliable import library  # takes seconds

    np.random.seed(seed)  # noqa: NPY002  rliable 1.2 draws from the global state, whatever it is given
    _, intervals = library.get_interval_estimates(
        {"": SCORES[:, None]}, lambda scores: np.array([scores.mean()]), reps=resamples
    )
    return intervals[""][:, 0]


def bootstrap() -> dict[str, Any]:
    """Percentile intervals of the mean of SCORES by library and number of resamples: mean error of
    an end over BOOTSTRAPS, against the interval of all resamples there are, and ms for one."""
    means = np.array([np.mean(draw) for draw in itertools.product(SCORES, repeat=len(SCORES))])
    exact = np.percentile(means, [2.5, 97.5])
    rliable_interval(2, 0)  # imports it
    contenders = {"evaluate": our_interval, "rliable": rliable_interval}
    result: dict[str, Any] = {name: {} for name in contenders}
    for resamples, (name, interval) in itertools.product(RESAMPLES, contenders.items()):
        started = time.process_time()
        found = [interval(resamples, seed) for seed in BOOTSTRAPS]
        ms = 1e3 * (time.process_time() - started) / len(BOOTSTRAPS)
        result[name][resamples] = {"error": float(np.abs(found - exact).mean()), "ms": ms}
    return result


def show_bootstrap(found: dict[str, Any]) -> None:
    """One table."""
    table = Table("resamples", title="bootstrap intervals: error of an end, ms")
    for name in found:
        table.add_column(name)
    for resamples in RESAMPLES:
        cells = [rows[resamples] for rows in found.values()]
        table.add_row(f"{resamples:,}", *(f"{c['error']:.5f}, {c['ms']:.1f}" for c in cells))
    Console().print(table)


# Part: what measures it, what shows it.
PARTS: dict[str, Part] = {
    "learners": (learners, show_learners),
    "bootstrap": (bootstrap, show_bootstrap),
}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "torch", "numpy", "scipy", "rliable", "arch")
