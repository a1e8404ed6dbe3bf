"""Do gradients by hand pay, or Adam's kernel by itself? Whole runs with them and with PyTorch's own.

    python -m benchmarks backward --out docs/data/backward.json

The run of `make train` (PPO, the handover) and DDPG+HER on the Shadow Hand (reach-goal, layout 2,
recipe `steady`). All learn on the same flat parameters from the same seed and take turns, an epoch or
ten cycles each, so that whatever else the machine does meets all alike. What counts is the processor's
time, simulation included. Fixed before the first run: gradients by hand stay in the library if they
save more than 10 % of both runs, and the private call of the kernel if it saves more than 5 %.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from functools import partial
from typing import Any

import numpy as np
import tactilerl
import torch
from tactilerl import envs
from tactilerl.algos import recipes
from tactilerl.algos.ddpg_her import DDPGHER
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import FlatAdam
from tactilerl.algos.ppo import PPO
from tactilerl.envs import vector

from benchmarks.command import Part, run_parts
from benchmarks.learners.by_hand import DDPGHERByHand, PPOByHand
from benchmarks.printing import markdown

ROUNDS = 6
PYTORCH, BY_HAND, KERNEL = "PyTorch's own", "gradients by hand", "Adam's kernel"


def kernel_step(adam: FlatAdam) -> None:
    """A step by the kernel of torch.optim.Adam(fused=True), without the optimiser around it."""
    for group in adam._adam.param_groups:
        (parameter,) = group["params"]
        state = adam._adam.state[parameter]
        state["step"] += 1
        torch._fused_adam_(
            [parameter], [parameter.grad], [state["exp_avg"]], [state["exp_avg_sq"]], [],
            [state["step"]], lr=group["lr"], beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-8,
            amsgrad=False, maximize=False,
        )  # fmt: skip


def take_turn(learner: Any, cycles: int) -> float:
    """Processor seconds of some cycles."""
    started = time.process_time()
    for _ in range(cycles):
        learner.collect()
        learner.update()
    return time.process_time() - started


def measure(kinds: tuple[Any, Any], config: Any, make: vector.Make, cycles: int) -> dict[str, Any]:
    """Seconds of each contender's turns, after one to warm up."""
    own, by_hand = kinds
    with ExitStack() as opened:
        learners = {
            name: kind(
                config, opened.enter_context(closing(vector.start(make))), Communicator(), 0, 10**5
            )
            for name, kind in ((PYTORCH, own), (BY_HAND, by_hand), (KERNEL, own))
        }
        for name in ("adam", "actor_adam", "critic_adam"):
            if adam := getattr(learners[KERNEL], name, None):
                adam.step = torch.no_grad()(partial(kernel_step, adam))
        turns = [
            {name: take_turn(learner, cycles) for name, learner in learners.items()}
            for _ in range(ROUNDS + 1)
        ][1:]
    return {
        "steps": {name: learner.env_steps for name, learner in learners.items()},
        "seconds": {name: [turn[name] for turn in turns] for name in learners},
    }


def display(name: str, result: dict[str, Any]) -> None:
    """A row for each contender: seconds, and what they save of PyTorch's, in all and turn by turn."""
    rows, own = [], np.array(result["seconds"][PYTORCH])
    for contender, seconds in result["seconds"].items():
        taken = np.array(seconds)
        saved, turns = 1 - taken.sum() / own.sum(), np.sort(1 - taken / own)
        rows.append(
            (contender, f"{taken.sum():.1f}", f"{saved:.1%}", f"{turns[0]:.1%} to {turns[-1]:.1%}")
        )
    markdown(f"| {name} | processor s | saved | in single turns |", rows)


def main() -> None:
    """Both learners."""
    ppo, ddpg = (PPO, PPOByHand), (DDPGHER, DDPGHERByHand)
    handover = partial(tactilerl.make, scene="handover")
    reach = partial(envs.make, "shadow", task="reach-goal", layout="2")
    parts: dict[str, Part] = {
        "ppo": (
            partial(measure, ppo, recipes.recipe("ppo", "steady"), handover, 1),
            partial(display, "PPO, `make train`"),
        ),
        "ddpg_her": (
            partial(measure, ddpg, recipes.recipe("ddpg_her", "steady"), reach, 10),
            partial(display, "DDPG+HER, Shadow Hand"),
        ),
    }
    run_parts(__doc__, parts, "torch")
