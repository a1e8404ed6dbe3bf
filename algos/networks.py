"""Multilayer perceptrons: how they are built and how their weights start."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

# Below it, numbers have not all of float32's digits.
FLOAT32_TINY = np.finfo(np.float32).tiny


class MLP(nn.Sequential):
    """Stack linear layers with ReLU between them, and optionally Tanh at the end.

    Weights and biases start uniform in ±1/sqrt(fan-in) (PyTorch's own default), drawn
    from `generator`, so that no global random state is involved.
    """

    def __init__(
        self, sizes: Sequence[int], generator: torch.Generator, tanh: bool = False
    ):
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            linear = nn.utils.skip_init(nn.Linear, fan_in, fan_out)  # type: ignore[no-untyped-call]
            bound = 1.0 / math.sqrt(fan_in)
            for values in linear.parameters():
                nn.init.uniform_(values, -bound, bound, generator=generator)
            layers += [linear, nn.ReLU()]
        layers[-1:] = [nn.Tanh()] if tanh else []
        super().__init__(*layers)
        self.linears = [layer for layer in layers if isinstance(layer, nn.Linear)]

    @torch.no_grad()
    def scale_outputs(self, factor: float) -> None:
        """Multiply what the last layer returns by `factor`, through its weights and bias."""
        for values in self.linears[-1].parameters():
            values.mul_(factor)


@torch.no_grad()
def start_orthogonal(
    network: MLP, last_gain: float, generator: torch.Generator
) -> None:
    """Draw orthogonal weights with gain sqrt(2), in the last layer `last_gain`; biases are zero."""
    for linear in network.linears:
        is_last = linear is network.linears[-1]
        gain = last_gain if is_last else math.sqrt(2.0)
        nn.init.orthogonal_(linear.weight, gain, generator)
        nn.init.zeros_(linear.bias)


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Treat denormal numbers as zero inside, in this thread.

    Adam's moments of units that are never active fade until they are denormal, and
    slow. Whoever steps physics outside must not notice.
    """
    before = bool(
        FLOAT32_TINY * np.float32(0.5) == 0
    )  # PyTorch can set it, but not tell it
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
