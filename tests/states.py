"""Comparing what learners save."""

import numpy as np
import torch


def flat(state):
    """A state as one comparable string: every bit of every tensor."""
    if isinstance(state, dict):
        return str({key: flat(value) for key, value in state.items()})
    if isinstance(state, torch.Tensor | np.ndarray):
        return np.asarray(state).tobytes().hex()
    return str([flat(x) for x in state]) if isinstance(state, list | tuple) else repr(state)


def vector(*networks):
    """All parameters of networks in one vector."""
    return torch.cat([p.detach().reshape(-1) for network in networks for p in network.parameters()])
