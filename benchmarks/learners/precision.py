"""Is float32 enough? The learners' updates against the same updates in float64.

100 minibatch updates on identical data, at the sizes of the paper's scenes. Prints a table and writes
JSON:

    python -m benchmarks precision --out docs/data/precision.json
"""

from __future__ import annotations

import copy
import time
from typing import Any

import numpy as np
import torch
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.networks import FlatAdam
from tactilerl.algos.ppo import PPO, PPOConfig, Transitions
from tactilerl.style import NAMES

from benchmarks.command import run_parts
from benchmarks.learners.random_goals import fed
from benchmarks.printing import markdown

UPDATES = 100
SEEDS = range(5)


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
        learner._update_critic(Transitions(*minibatch))
        learner._update_actor(Transitions(*minibatch))
    else:
        learner._minibatch(*minibatch)


def drift(learner: Any, minibatches: list[tuple[torch.Tensor, ...]]) -> dict[str, tuple[float, float]]:
    """How far parameters end from float64's, relative to the way these went; and how fast."""
    ends, seconds = {}, {}
    for name, dtype in {"float64": torch.float64, "float32": torch.float32}.items():
        twin, adams = twin_of(learner, dtype)
        start = torch.cat([adam.vector.detach().double().clone() for adam in adams])
        data = [tuple(part.to(dtype) for part in minibatch) for minibatch in minibatches]
        started = time.process_time()
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
        found = [drift(*make(seed)) for seed in SEEDS]
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
    markdown("| updates | in | error, median | worst | speed |", rows)


def main() -> None:
    """Both learners."""
    run_parts(__doc__, {"learners": (learners, show_learners)}, "torch", "numpy")
