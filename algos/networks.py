"""Multilayer perceptrons: how they are built and how their weights start."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

# Below it, numbers have not all of float32's digits.
FLOAT32_TINY = np.finfo(np.float32).tiny
# Of hidden layers: more is a slip and takes all memory.
MAX_UNITS, MAX_WEIGHTS = 100_000, 10**8


def require_hidden(hidden: Sequence[int]) -> None:
    """Raise ValueError for hidden layers that are none, or too large."""
    if not hidden or not 1 <= min(hidden) <= max(hidden) <= MAX_UNITS:
        raise ValueError(
            f"hidden: found {hidden}, allowed one or more sizes from 1 to {MAX_UNITS}"
        )
    if sum(a * b for a, b in itertools.pairwise(hidden)) > MAX_WEIGHTS:
        raise ValueError(
            f"hidden: found {hidden}, allowed up to {MAX_WEIGHTS} weights between them"
        )


class MLP(nn.Sequential):
    """Stack linear layers with ReLU between them, and optionally Tanh at the end.

    Weights and biases start uniform in ±1/sqrt(fan-in) (PyTorch's own default), drawn from
    `generator`, so that no global random state is involved. Networks with other inputs, drawn from
    the same generator, start alike but for that bound: the same weights belong to the same input.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        generator: torch.Generator,
        tanh: bool = False,
        inputs: Sequence[str] | None = None,
    ):
        """Draw the weights. `inputs` names what it sees; without names, inputs go by number."""
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            linear = nn.utils.skip_init(nn.Linear, fan_in, fan_out)  # type: ignore[no-untyped-call]
            bound = 1.0 / math.sqrt(fan_in)
            source, names = (generator, None) if layers else (_spawn(generator), inputs)
            with torch.no_grad():
                drawn = _columns(linear.weight, source, names, Tensor.uniform_)
                linear.weight.copy_((drawn * 2 - 1) * bound)
            nn.init.uniform_(linear.bias, -bound, bound, generator=generator)
            layers += [linear, nn.ReLU()]
        layers[-1:] = [nn.Tanh()] if tanh else []
        super().__init__(*layers)
        self.linears = [layer for layer in layers if isinstance(layer, nn.Linear)]

    @torch.no_grad()
    def scale_outputs(self, factor: float) -> None:
        """Multiply what the last layer returns by `factor`, through its weights and bias."""
        for values in self.linears[-1].parameters():
            values.mul_(factor)


def _spawn(generator: torch.Generator) -> torch.Generator:
    """Return a separate generator: how much is drawn from it does not move the first one."""
    seed = int(torch.randint(2**62, (), generator=generator))
    return torch.Generator().manual_seed(seed)


def _columns(
    like: Tensor,
    generator: torch.Generator,
    names: Sequence[str] | None,
    draw: Callable[..., Tensor],
) -> Tensor:
    """Draw numbers (outputs, inputs); those of an input follow from its name or number alone."""
    n_out, n_in = like.shape
    if names is None:
        return draw(torch.empty(n_in, n_out), generator=generator).T
    base, columns = generator.initial_seed(), []
    for name in names:
        digest = hashlib.blake2b(f"{base} {name}".encode(), digest_size=7).digest()
        source = torch.Generator().manual_seed(int.from_bytes(digest, "big"))
        columns.append(draw(torch.empty(n_out), generator=source))
    return torch.stack(columns, dim=1)


@torch.no_grad()
def start_orthogonal(
    network: MLP,
    last_gain: float,
    generator: torch.Generator,
    inputs: Sequence[str] | None = None,
) -> None:
    """Draw orthogonal weights with gain sqrt(2), in the last layer `last_gain`; biases are zero.

    The first layer's columns are drawn each by its input alone, and are orthogonal as nearly as
    that allows. Networks with other `inputs` so start alike, but for the length of these columns
    where there are more inputs than units.
    """
    for linear in network.linears:
        gain = last_gain if linear is network.linears[-1] else math.sqrt(2.0)
        if linear is network.linears[0]:
            columns = _columns(linear.weight, _spawn(generator), inputs, Tensor.normal_)
            gain *= min(1.0, math.sqrt(linear.out_features / linear.in_features))
            linear.weight.copy_(functional.normalize(columns, dim=0) * gain)
        else:
            nn.init.orthogonal_(linear.weight, gain, generator)
        nn.init.zeros_(linear.bias)


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Treat denormal numbers as zero inside, in this thread.

    Adam's moments of units that are never active fade until they are denormal, and slow. Whoever
    steps physics outside must not notice.
    """
    before = bool(
        FLOAT32_TINY * np.float32(0.5) == 0
    )  # PyTorch can set it, but not tell it
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
