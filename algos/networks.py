"""Multilayer perceptrons whose parameters lie in one vector, and Adam on that vector.

One vector makes the optimiser step, the gradient's norm and the reduction over ranks one
operation each, instead of one for every layer's weight and bias.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.adam import adam

from . import DivergenceError
from .mpi import Communicator

Precision = Literal["float32", "bfloat16"]
MOST_UNITS, MOST_WEIGHTS = 100_000, 10**8  # of hidden layers: more is a slip, and takes all memory
FUSED_ADAM: Any = getattr(torch, "_fused_adam_", None)


@contextmanager
def matrix_products(precision: Precision) -> Iterator[None]:
    """Matrix products of float32 numbers multiply them in float32 or rounded to bfloat16 (8 bits
    of precision instead of 24); sums and results are float32 all the same. Of the whole process."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium" if precision == "bfloat16" else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def has_bfloat16() -> bool:
    """Does this processor multiply bfloat16 itself? With AVX512-BF16 alone PyTorch would go on with
    float32."""
    return bool(getattr(torch.cpu, "_is_amx_tile_supported", bool)())  # there is no public question


def require_hidden(hidden: Sequence[int]) -> None:
    """ValueError for hidden layers that are none, or too large."""
    if not hidden or not 1 <= min(hidden) <= max(hidden) <= MOST_UNITS:
        raise ValueError(f"hidden: found {hidden}, allowed one or more sizes from 1 to {MOST_UNITS}")
    if sum(a * b for a, b in itertools.pairwise(hidden)) > MOST_WEIGHTS:
        raise ValueError(f"hidden: found {hidden}, allowed up to {MOST_WEIGHTS} weights between them")


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
                linear.weight.copy_(_columns(linear.weight, own, names, Tensor.uniform_) * 2 - 1)
                linear.weight.mul_(bound)
            nn.init.uniform_(linear.bias, -bound, bound, generator=generator)
            layers += [linear, nn.ReLU()]
        layers[-1:] = [nn.Tanh()] if tanh else []
        super().__init__(*layers)
        self._shape = tuple(sizes), tanh
        self.linears = [layer for layer in layers if isinstance(layer, nn.Linear)]

    # -- learning, by hand: small batches leave autograd's bookkeeping no time to hide in --------

    @torch.no_grad()
    def run(self, inputs: Tensor) -> list[Tensor]:
        """What each linear layer sees (n, size), the inputs first, and the outputs (n, sizes[-1])."""
        (*_, last), (_, tanh), values = self.linears, self._shape, [inputs]
        for linear in self.linears:
            values.append(functional.linear(values[-1], linear.weight, linear.bias))
            if linear is not last:
                values[-1].relu_()
            elif tanh:
                values[-1].tanh_()
        return values

    @torch.no_grad()
    def deltas(self, values: Sequence[Tensor], gradient: Tensor) -> list[Tensor]:
        """Gradients (n, size) of a loss by what each linear layer gives, before its ReLU or Tanh.

        `values` are what `run` returned, `gradient` (n, sizes[-1]) is the loss's by the outputs.
        """
        _, tanh = self._shape
        found = [gradient * (1.0 - values[-1].square()) if tanh else gradient]
        for linear, hidden in zip(self.linears[:0:-1], values[-2:0:-1], strict=True):
            delta = found[-1] @ linear.weight
            torch.ops.aten.threshold_backward(delta, hidden, 0.0, grad_input=delta)  # ReLU's, in place
            found.append(delta)
        return found[::-1]

    @torch.no_grad()
    def backward(self, values: Sequence[Tensor], gradient: Tensor) -> None:
        """Write a loss's gradient by the parameters into their `grad`; arguments as of `deltas`."""
        deltas = self.deltas(values, gradient)
        for linear, inputs, delta in zip(self.linears, values[:-1], deltas, strict=True):
            weight, bias = linear.weight.grad, linear.bias.grad
            torch.mm(delta.t(), inputs, out=weight)
            torch.sum(delta, dim=0, out=bias)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles as sizes and numbers: the parameters may be views of much more."""
        values = [parameter.detach().cpu().numpy() for parameter in self.parameters()]
        return _restored, (*self._shape, values)

    def __deepcopy__(self, memo: dict[int, Any]) -> MLP:
        """A copy on the same device, likewise by sizes and numbers."""
        return _restored(*self._shape, [parameter.detach() for parameter in self.parameters()])


def _spawn(generator: torch.Generator) -> torch.Generator:
    """A generator of its own: how much is drawn from it moves nothing else."""
    seed = int(torch.randint(2**62, (), generator=generator))
    return torch.Generator().manual_seed(seed)


def _columns(
    like: Tensor, generator: torch.Generator, names: Sequence[str] | None, draw: Callable[..., Tensor]
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


@contextmanager
def _denormals_flushed() -> Iterator[None]:
    """Numbers too small for all of float32's digits are zero, in this thread."""
    smallest = np.finfo(np.float32).tiny
    before = bool(smallest * np.float32(0.5) == 0)  # PyTorch sets it and does not tell it
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def flatten(*modules: nn.Module) -> nn.Parameter:
    """Move all parameters of `modules` into one vector, of which they become views.

    The vector's gradient is likewise made of the parameters' gradients. Returns the vector.
    """
    parameters = [parameter for module in modules for parameter in module.parameters()]
    vector = nn.Parameter(torch.cat([p.detach().reshape(-1) for p in parameters]))
    vector.grad = torch.zeros_like(vector)
    sizes = [parameter.numel() for parameter in parameters]
    parts = zip(
        parameters, torch.split(vector.data, sizes), torch.split(vector.grad, sizes), strict=True
    )
    for parameter, values, gradient in parts:
        parameter.data, parameter.grad = values.view_as(parameter), gradient.view_as(parameter)
    return vector


def _fused_adam(
    lr: float, vector: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, steps: Tensor
) -> None:
    """The kernel of torch.optim.Adam(fused=True); where PyTorch hides it elsewhere, by its public
    function, which counts the steps itself and takes longer."""
    run, counts = FUSED_ADAM, [steps]
    if run is None:
        run, counts = partial(adam, fused=True), [steps - 1]
    run(
        [vector], [gradient], [mean], [square], [], counts, lr=lr, beta1=0.9, beta2=0.999,
        weight_decay=0.0, eps=1e-8, amsgrad=False, maximize=False,
    )  # fmt: skip


class FlatAdam:
    """Adam (Kingma & Ba 2014) on all parameters of modules as one vector.

    Each module comes with its step size.
    """

    def __init__(self, *modules: tuple[nn.Module, float]) -> None:
        self.vector = flatten(*(module for module, _ in modules))
        assert self.vector.grad is not None
        self.gradient = self.vector.grad
        self._moments = {name: torch.zeros_like(self.vector.data) for name in ("exp_avg", "exp_avg_sq")}
        self._steps = torch.zeros(len(modules), device=self.vector.device)
        self._lrs = [lr for _, lr in modules]
        self.share = 1.0  # of the step sizes, where they fall over a run
        sizes = [sum(p.numel() for p in module.parameters()) for module, _ in modules]
        whole = (self.vector.data, self.gradient, *self._moments.values())
        parts = (*(torch.split(values, sizes) for values in whole), self._steps.unbind())
        self._parts: list[Any] = list(zip(*parts, strict=True))

    def reduce(self, comm: Communicator, how: Literal["mean", "sum"] = "sum") -> None:
        """Replace the gradient by its sum or mean over ranks: one message."""
        comm.sum_(self.gradient)
        if how == "mean" and comm.size > 1:
            self.gradient.div_(comm.size)

    def clip(self, max_norm: float) -> None:
        """Scale the gradient down to `max_norm` where it is longer."""
        norm = torch.linalg.vector_norm(self.gradient)  # torch.dot would round to bfloat16
        scale = max_norm / (norm + 1e-6)
        self.gradient.mul_(scale.clamp(max=1.0))

    def step(self) -> None:
        """One step along the gradient."""
        self._steps += 1
        # Moments of units that are never active fade until they are denormal, and slow: zero then.
        with _denormals_flushed():  # whoever steps physics must not notice
            for parts, lr in zip(self._parts, self._lrs, strict=True):
                _fused_adam(self.share * lr, *parts)

    def state_dict(self) -> dict[str, Any]:
        """Moments (n,) and steps (modules,). The parameters belong to the modules, step sizes and
        eps to the configuration."""
        return {"steps": self._steps, **self._moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, values in self.state_dict().items():
            values.copy_(state[name])


def require_finite(adams: Sequence[FlatAdam], losses: Tensor, env_steps: int) -> None:
    """DivergenceError, rather than going on from losses or parameters that are not finite."""
    if not all(torch.isfinite(values).all() for values in (losses, *(adam.vector for adam in adams))):
        raise DivergenceError(
            f"a loss or a parameter is not finite after {env_steps} steps "
            f"(losses {[f'{x:.3g}' for x in losses.tolist()]})"
        )
