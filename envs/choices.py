"""Names that somebody chose."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

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


def require_known(names: Iterable[str], known: Iterable[str]) -> None:
    """ValueError naming the first of `names` that is not known, what may have been meant, and all that
    are known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            likely = " or ".join(meant(name, known))
            hint = f"did you mean {likely}? " if likely else ""
            raise ValueError(f"{name}: unknown; {hint}allowed: {', '.join(known)}")


def meant(name: str, known: Collection[str]) -> list[str]:
    """Those of `known` that somebody may have meant by `name`."""
    by_peers = [own for own in PEERS.get(name, []) if own in known]
    return by_peers or difflib.get_close_matches(name, known, 1, cutoff=0.7)
