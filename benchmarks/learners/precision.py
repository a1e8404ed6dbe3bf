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

from benchmarks.command import Part, run_parts
from benchmarks.learners.random_goals import fed
from benchmarks.printing import markdown
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.networks import FlatAdam, Precision, has_bfloat16, matrix_products
from tactilerl.algos.ppo import PPO, PPOConfig, Transitions
from tactilerl.runs.evaluation import mean_interval
from tactilerl.style import NAMES

UPDATES = 100
SCORES = np.array([0.31, 0.44, 0.47, 0.66, 0.85])
RESAMPLES = (100, 1_000, 9_999, 50_000)
LEARNERS, BOOTSTRAPS = range(5), range(10)  # seeds


Updates = tuple[Any, list[tuple[torch.Tensor, ...]]]
"""(learner, minibatches)"""


def ppo(seed: int) -> Updates:
    """At the sizes of the MPL hand, layout 2."""
    learner = fed(PPO, PPOConfig(), 94, 7, seed)
    batch, rng = learner._batch(), np.random.default_rng(seed)
    minibatches: list[tuple[torch.Tensor, ...]] = []
    while len(minibatches) < UPDATES:
        minibatches += batch.minibatches(torch.from_numpy(rng.permutation(len(batch.obs))), 6)
    return learner, minibatches[:UPDATES]


def ddpg(seed: int) -> Updates:
    """At the sizes of the Shadow Hand, layout 2."""
    learner = fed(DDPGHER, DDPGHERConfig(buffer_size=4000), 140, 23, seed)
    for _ in range(19):
        learner.collect()
    minibatches = []
    for _ in range(UPDATES):
        sample = learner.replay.sample(learner.config.batch_size, learner.config.replay_p)
        tensors = type(sample)(*map(torch.from_numpy, sample))
        with torch.no_grad():
            minibatches.append(learner._prepared(tensors))
    return learner, minibatches


def twin_of(learner: Any, dtype: torch.dtype) -> tuple[Any, list[FlatAdam]]:
    """A learner of the same weights in another type, and its optimisers."""
    twin, config = copy.copy(learner), learner.config
    twin.actor, twin.critic = (copy.deepcopy(net).to(dtype) for net in (learner.actor, learner.critic))
    actor, critic = (twin.actor, config.actor_lr), (twin.critic, config.critic_lr)
    if isinstance(learner, PPO):
        twin.actor_adam, twin.critic_adam = FlatAdam(actor), FlatAdam(critic)
        return twin, [twin.actor_adam, twin.critic_adam]
    twin.adam = FlatAdam(actor, critic)
    return twin, [twin.adam]


def step(learner: Any, minibatch: tuple[torch.Tensor, ...]) -> None:
    """Of actor and critic."""
    if isinstance(learner, PPO):
        learner._improve_critic(Transitions(*minibatch))
        learner._improve_actor(Transitions(*minibatch))
    else:
        learner._minibatch(*minibatch)


PRODUCTS: dict[str, tuple[torch.dtype, Precision]] = {
    "float64": (torch.float64, "float32"),
    "float32": (torch.float32, "float32"),
    "bfloat16": (torch.float32, "bfloat16"),
}
"""What multiplies: type of everything else, products of float32."""


def drift(learner: Any, minibatches: list[tuple[torch.Tensor, ...]]) -> dict[str, tuple[float, float]]:
    """How far parameters end from float64's, relative to the way these went; and how fast."""
    ends, seconds = {}, {}
    for name in PRODUCTS if has_bfloat16() else ("float64", "float32"):
        dtype, products = PRODUCTS[name]
        twin, adams = twin_of(learner, dtype)
        start = torch.cat([adam.vector.detach().double().clone() for adam in adams])
        data = [tuple(part.to(dtype) for part in minibatch) for minibatch in minibatches]
        started = time.process_time()
        with matrix_products(products):
            for minibatch in data:
                step(twin, minibatch)
        seconds[name] = time.process_time() - started
        ends[name] = torch.cat([adam.vector.detach().double() for adam in adams])
    exact = ends.pop("float64")
    way = (exact - start).norm()
    return {
        name: (float((end - exact).norm() / way), seconds["float64"] / seconds[name])
        for name, end in ends.items()
    }


def learners() -> dict[str, Any]:
    """Both, from several first weights."""
    result: dict[str, Any] = {"ppo": {}, "ddpg_her": {}}
    for rows, make in zip(result.values(), (ppo, ddpg), strict=True):
        found = [drift(*make(seed)) for seed in LEARNERS]
        for name in found[0]:
            errors, speeds = zip(*(one[name] for one in found), strict=True)
            rows[name] = {
                "parameter_error_median": float(np.median(errors)),
                "parameter_error_worst": max(errors),
                "speed": float(np.median(speeds)),
            }
    return result


def show_learners(found: dict[str, Any]) -> None:
    """One table."""
    rows = [
        (NAMES[learner], name,
         *(f"{row[f'parameter_error_{which}']:.2g}" for which in ("median", "worst")),
         f"{row['speed']:.1f}")
        for learner, of in found.items()
        for name, row in of.items()
    ]  # fmt: skip
    markdown("| updates | products | error, median | worst | speed |", rows)


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
    contenders: dict[str, Callable[[int, int], Any]] = {
        "evaluate": lambda resamples, seed: mean_interval(SCORES, resamples, seed),
        "rliable": rliable_interval,
    }
    result: dict[str, Any] = {name: {} for name in contenders}
    for resamples, (name, interval) in itertools.product(RESAMPLES, contenders.items()):
        started = time.process_time()
        found = [interval(resamples, seed) for seed in BOOTSTRAPS]
        ms = 1e3 * (time.process_time() - started) / len(BOOTSTRAPS)
        result[name][str(resamples)] = {"error": float(np.abs(found - exact).mean()), "ms": ms}
    return result


def show_bootstrap(found: dict[str, Any]) -> None:
    """One table."""
    head = "| resamples |" + "".join(f" {name}: mean error of an end | ms |" for name in found)
    rows = []
    for n in RESAMPLES:
        of = [of[str(n)] for of in found.values()]
        cells = [cell for row in of for cell in (f"{row['error']:.2g}", f"{row['ms']:,.1f}")]
        rows.append((f"{n:,}", *cells))
    markdown(head, rows)


PARTS: dict[str, Part] = {
    "learners": (learners, show_learners),
    "bootstrap": (bootstrap, show_bootstrap),
}


def main() -> None:
    """All parts or one."""
    run_parts(__doc__, PARTS, "torch", "numpy", "scipy", "rliable", "arch")
