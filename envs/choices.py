"""Names that somebody chose."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

PEERS: dict[str, tuple[str, str]] = {
    "batch_size": ("minibatch_size", ""),
    "blind": ("run_type", "with off, all taxels read zero"),
    "clip_range_vf": ("", "value updates are not clipped"),
    "cuda": ("device", "cuda is a GPU"),
    "deterministic": ("", "evaluate is deterministic unless --stochastic is given"),
    "ent_coef": ("exploration", "there is no entropy bonus"),
    "env_id": ("env", ""),
    "env_name": ("env", ""),
    "eval_episodes": ("episodes", ""),
    "gpu": ("device", "cuda is a GPU"),
    "gradient_steps": ("n_batches", "per cycle"),
    "hand": ("env", ""),
    "learning_rate": ("actor_lr critic_lr", ""),
    "log_std_init": ("action_variance", "the variance is exp(2 log_std)"),
    "lr": ("actor_lr critic_lr", ""),
    "n_envs": ("workers", "results do not depend on it"),
    "n_epochs": ("n_passes", ""),
    "n_eval_episodes": ("episodes", ""),
    "n_steps": ("steps_per_epoch", ""),
    "net_arch": ("hidden", ""),
    "no_taxels": ("run_type", "with off, all taxels read zero"),
    "no_touch": ("run_type", "with off, all taxels read zero"),
    "num_envs": ("workers", "results do not depend on it"),
    "num_timesteps": ("total_timesteps", ""),
    "policy_kwargs": ("hidden", ""),
    "progress_bar": ("progress", ""),
    "robot": ("env", ""),
    "taxels": ("run_type", "with off, all taxels read zero"),
    "tau": ("polyak", "polyak is 1 - tau"),
    "tensorboard_log": ("tensorboard", ""),
    "timesteps": ("total_timesteps", ""),
    "verbose": ("", "train shows its progress; in Python, learn(progress=True) does"),
    "vf_coef": ("critic_lr", "the critic has a network and a step size of its own"),
}
"""What people type, mostly names of Stable-Baselines3 and Gymnasium -> what is nearest to it here, and
how it differs."""
SAME = {"batch_size": "minibatch_size", "n_epochs": "n_passes", "n_steps": "steps_per_epoch"}
"""Of these, flags that the command takes under either name."""


def require_known(names: Iterable[str], known: Iterable[str]) -> None:
    """ValueError naming the first of `names` that is not known, what may have been meant, and all that
    are known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            likely, why = meant(name, known)
            hint = f"did you mean {' or '.join(likely)}? " if likely else ""
            reason = f"({why}) " if why else ""
            raise ValueError(f"{name}: unknown; {hint}{reason}allowed: {', '.join(known)}")


def meant(name: str, known: Collection[str]) -> tuple[list[str], str]:
    """Those of `known` that somebody may have meant by `name`, and how they differ from it."""
    peers, why = PEERS.get(name, ("", ""))
    if likely := [own for own in peers.split() if own in known]:
        return likely, why
    if name in PEERS and not peers:
        return [], why
    longer = [own for own in known if own.startswith(name)] if len(name) > 2 else []
    return longer[:1] or difflib.get_close_matches(name.lower(), known, 1, cutoff=0.7), ""


def nearest(name: str, known: Iterable[str]) -> str:
    """A question for whoever mistyped one of `known`, or nothing."""
    likely, _ = meant(name, list(known))
    return f"did you mean {likely[0]}? " if likely else ""
