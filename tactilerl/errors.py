"""What a user can mend."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

PEERS = {
    "batch_size": ["minibatch_size"],
    "gradient_steps": ["n_batches"],
    "learning_rate": ["actor_lr", "critic_lr"],
    "log_std_init": ["action_variance"],
    "n_envs": ["workers"],
    "n_epochs": ["n_passes"],
    "n_steps": ["steps_per_epoch"],
    "num_envs": ["workers"],
    "policy_kwargs": ["hidden"],
    "progress_bar": ["progress"],
    "tau": ["polyak"],
    "tensorboard_log": ["tensorboard"],
}
"""What Stable-Baselines3 and Gymnasium call a choice -> what is nearest to it here."""


class InputError(ValueError):
    """One line: what was wrong, what was found, what is allowed. The command exits with 2."""


@contextmanager
def input_errors(where: str = "") -> Iterator[None]:
    """Turn what library code raises over bad input into an InputError."""
    try:
        yield
    except InputError:  # is one line already
        raise
    except (ValueError, OSError, ImportError, RuntimeError, OverflowError, MemoryError) as error:
        line = " ".join(str(error).split())
        raise InputError(f"{where}: {line}" if where else line) from error


def let_rank_0_speak() -> None:
    """On other ranks, wait a second: mostly rank 0 has found the same, and its end is theirs."""
    from .algos import mpi

    if mpi.launched_rank() not in (None, "0"):
        time.sleep(1.0)
