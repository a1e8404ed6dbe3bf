"""What a user can mend."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

PEERS: dict[str, tuple[str, str]] = {
    name: (ours, difference)
    for names, ours, difference in (
        ("batch_size", "minibatch_size", ""),
        ("blind no_taxels no_touch taxels", "run_type", "with off, all taxels read zero"),
        ("clip_range_vf", "", "value updates are not clipped"),
        ("cuda gpu", "device", "cuda is a GPU"),
        ("deterministic", "", "evaluate is deterministic unless --stochastic is given"),
        ("ent_coef", "exploration", "there is no entropy bonus"),
        ("env_id env_name hand robot", "env", ""),
        ("eval_episodes n_eval_episodes", "episodes", ""),
        ("gradient_steps", "n_batches", "per cycle"),
        ("learning_rate lr", "actor_lr critic_lr", ""),
        ("log_std_init", "action_variance", "the variance is exp(2 log_std)"),
        ("n_envs num_envs", "workers", "results do not depend on it"),
        ("n_epochs", "n_passes", ""),
        ("n_steps", "steps_per_epoch", ""),
        ("net_arch policy_kwargs", "hidden", ""),
        ("n_timesteps num_timesteps timesteps", "total_timesteps", ""),
        ("progress_bar", "progress", ""),
        ("tau", "polyak", "polyak is 1 - tau"),
        ("tensorboard_log", "tensorboard", ""),
        ("verbose", "", "train shows its progress; in Python, learn(progress=True) does"),
        ("vf_coef", "critic_lr", "the critic has a network and a step size of its own"),
    )
    for name in names.split()
}
"""What people type, mostly names of Stable-Baselines3 and Gymnasium -> what is nearest to it here, and
how it differs."""
SAME = {name: PEERS[name][0] for name in ("batch_size", "n_epochs", "n_steps")}
"""Of these, flags that the command takes under either name."""


BAD_INPUT, BUSY = 2, 75
"""Exit codes of commands that did nothing, since the input was wrong, or since another process is at it
(EX_TEMPFAIL of sysexits.h)."""


class InputError(ValueError):
    """One line: what was wrong, what was found, what is allowed. The command exits with 2."""


class BusyError(InputError):
    """Another process has what this one needs; the command exits with `BUSY`."""


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
