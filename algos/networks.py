"""Multilayer perceptrons whose parameters lie in one vector, and Adam on that vector.

One vector makes the optimiser step, the gradient's norm and the reduction over ranks one
operation each, instead of one for every layer's weight and bias.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from .mpi import Communicator

TINY = np.finfo(np.float32).tiny  # below it, numbers have not all of float32's digits
MOST_UNITS, MOST_WEIGHTS = (
    100_000,
    10**8,
)  # of hidden layers: more is a slip, and takes all memory


def require_hidden(hidden: Sequence[int]) -> None:
    """ValueError for hidden layers that are none, or too large."""
    if not hidden or not 1 <= min(hidden) <= max(hidden) <= MOST_UNITS:
        raise ValueError(
            f"hidden: found {hidden}, allowed one or more sizes from 1 to {MOST_UNITS}"
        )
    if sum(a * b for a, b in itertools.pairwise(hidden)) > MOST_WEIGHTS:
        raise ValueError(
            f"hidden: found {hidden}, allowed up to {MOST_WEIGHTS} weights between them"
        )


class MLP(nn.Sequential):
    """Linear layers with ReLU between them, and optionally Tanh at the end.

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
        """`inputs` are the names of what it sees; without them inputs go by their numbers."""
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            linear = nn.utils.skip_init(nn.Linear, fan_in, fan_out)  # type: ignore[no-untyped-call]
            bound = 1.0 / math.sqrt(fan_in)
            own, names = (generator, None) if layers else (_spawn(generator), inputs)
            with torch.no_grad():
                linear.weight.copy_(
                    _columns(linear.weight, own, names, Tensor.uniform_) * 2 - 1
                )
                linear.weight.mul_(bound)
            nn.init.uniform_(linear.bias, -bound, bound, generator=generator)
            layers += [linear, nn.ReLU()]
        layers[-1:] = [nn.Tanh()] if tanh else []
        super().__init__(*layers)
        self._shape = tuple(sizes), tanh
        self.linears = [layer for layer in layers if isinstance(layer, nn.Linear)]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles as sizes and numbers: the parameters may be views of much more."""
        values = [parameter.detach().cpu().numpy() for parameter in self.parameters()]
        return _restored, (*self._shape, values)

    def __deepcopy__(self, memo: dict[int, Any]) -> MLP:
        """A copy on the same device, likewise by sizes and numbers."""
        return _restored(
            *self._shape, [parameter.detach() for parameter in self.parameters()]
        )


def _spawn(generator: torch.Generator) -> torch.Generator:
    """A generator of its own: how much is drawn from it moves nothing else."""
    seed = int(torch.randint(2**62, (), generator=generator))
    return torch.Generator().manual_seed(seed)


def _columns(
    like: Tensor,
    generator: torch.Generator,
    names: Sequence[str] | None,
    draw: Callable[..., Tensor],
) -> Tensor:
    """Numbers (outputs, inputs), of which those of an input follow from its name or number alone."""
    n_out, n_in = like.shape
    if names is None:
        return draw(torch.empty(n_in, n_out), generator=generator).T
    base, columns = generator.initial_seed(), []
    for name in names:
        digest = hashlib.blake2b(f"{base} {name}".encode(), digest_size=7).digest()
        own = torch.Generator().manual_seed(int.from_bytes(digest, "big"))
        columns.append(draw(torch.empty(n_out), generator=own))
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
        is_first, is_last = (linear is network.linears[i] for i in (0, -1))
        gain = last_gain if is_last else math.sqrt(2.0)
        if is_first:
            drawn = _columns(linear.weight, _spawn(generator), inputs, Tensor.normal_)
            gain *= min(1.0, math.sqrt(linear.out_features / linear.in_features))
            linear.weight.copy_(functional.normalize(drawn, dim=0) * gain)
        else:
            nn.init.orthogonal_(linear.weight, gain, generator)
        nn.init.zeros_(linear.bias)


def _restored(sizes: Sequence[int], tanh: bool, values: Sequence[Any]) -> MLP:
    """A network with copies of these parameters, arrays or tensors."""
    tensors = [torch.asarray(value, copy=True) for value in values]
    network = MLP(sizes, torch.Generator(), tanh).to(tensors[0].device)
    for parameter, tensor in zip(network.parameters(), tensors, strict=True):
        parameter.data = tensor
    return network


def flatten(*modules: nn.Module) -> nn.Parameter:
    """Move all parameters of `modules` into one vector, of which they become views.

    The vector's gradient is likewise made of the parameters' gradients. Returns the vector.
    """
    parameters = [parameter for module in modules for parameter in module.parameters()]
    vector = nn.Parameter(torch.cat([p.detach().reshape(-1) for p in parameters]))
    vector.grad = torch.zeros_like(vector)
    sizes = [parameter.numel() for parameter in parameters]
    parts = zip(
        parameters,
        torch.split(vector.data, sizes),
        torch.split(vector.grad, sizes),
        strict=True,
    )
    for parameter, values, gradient in parts:
        parameter.data, parameter.grad = (
            values.view_as(parameter),
            gradient.view_as(parameter),
        )
    return vector


class FlatAdam:
    """Adam (Kingma & Ba 2014) on all parameters of modules as one vector.

    Each module comes with its learning rate.
    """

    def __init__(self, *modules: tuple[nn.Module, float]) -> None:
        self.vector = flatten(*(module for module, _ in modules))
        assert self.vector.grad is not None
        self.gradient = self.vector.grad
        self._moments = {
            name: torch.zeros_like(self.vector.data)
            for name in ("exp_avg", "exp_avg_sq")
        }
        self._steps = torch.zeros(len(modules), device=self.vector.device)
        self._lrs = [lr for _, lr in modules]
        sizes = [sum(p.numel() for p in module.parameters()) for module, _ in modules]
        whole = (self.vector.data, self.gradient, *self._moments.values())
        parameters, states = [], []
        for values, gradient, mean, square, step in zip(
            *(torch.split(tensor, sizes) for tensor in whole),
            self._steps.unbind(),
            strict=True,
        ):
            parameters.append(nn.Parameter(values))
            parameters[-1].grad = gradient
            states.append({"step": step, "exp_avg": mean, "exp_avg_sq": square})
        groups = [
            {"params": [p], "lr": lr}
            for p, lr in zip(parameters, self._lrs, strict=True)
        ]
        self._adam = torch.optim.Adam(
            groups, fused=self.vector.device.type in ("cpu", "cuda")
        )
        self._adam.state.update(zip(parameters, states, strict=True))

    def scale_lr(self, lr_factor: float) -> None:
        """From here on each learning rate is this fraction of what it was at the start."""
        for group, lr in zip(self._adam.param_groups, self._lrs, strict=True):
            group["lr"] = lr_factor * lr

    def reduce(self, comm: Communicator, how: Literal["mean", "sum"] = "sum") -> None:
        """Replace the gradient by its sum or mean over ranks: one message."""
        comm.sum_(self.gradient)
        if how == "mean" and comm.size > 1:
            self.gradient.div_(comm.size)

    def clip(self, max_norm: float) -> None:
        """Scale the gradient down to `max_norm` where it is longer."""
        norm = torch.linalg.vector_norm(self.gradient)
        scale = max_norm / (norm + 1e-6)
        self.gradient.mul_(scale.clamp(max=1.0))

    def step(self) -> None:
        """One step along the gradient."""
        # Moments of units that are never active fade until they are denormal, and slow: zero then.
        before = bool(
            TINY * np.float32(0.5) == 0
        )  # PyTorch sets it and does not tell it
        torch.set_flush_denormal(True)
        try:
            self._adam.step()
        finally:
            torch.set_flush_denormal(before)  # whoever steps physics must not notice

    def state_dict(self) -> dict[str, Any]:
        """Moments (n,) and steps (modules,). The parameters belong to the modules, learning
        rates to the configuration."""
        return {"steps": self._steps, **self._moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, values in self.state_dict().items():
            values.copy_(state[name])
