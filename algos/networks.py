"""Multilayer perceptrons whose parameters lie in one vector, and Adam on that vector.

One vector makes the optimiser step, the gradient's norm and the reduction over ranks one
operation each, instead of one for every layer's weight and bias.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from . import DivergenceError
from .mpi import Communicator


class MLP(nn.Sequential):
    """Linear layers with ReLU between them, and optionally Tanh at the end.

    Weights and biases start uniform in ±1/sqrt(fan-in) (PyTorch's own default), drawn from
    `generator`, so that no global random state is involved.
    """

    def __init__(self, sizes: Sequence[int], generator: torch.Generator, tanh: bool = False):
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            linear = nn.Linear(fan_in, fan_out)
            bound = 1.0 / math.sqrt(fan_in)
            for parameter in linear.parameters():
                nn.init.uniform_(parameter, -bound, bound, generator=generator)
            layers += [linear, nn.ReLU()]
        layers[-1:] = [nn.Tanh()] if tanh else []
        super().__init__(*layers)
        self._shape = tuple(sizes), tanh

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles and copies as sizes and numbers: the parameters may be views of much more."""
        values = [parameter.detach().cpu().numpy() for parameter in self.parameters()]
        return _with_parameters, (*self._shape, values)


def _with_parameters(sizes: Sequence[int], tanh: bool, values: Sequence[Any]) -> MLP:
    network = MLP(sizes, torch.Generator(), tanh)
    for parameter, value in zip(network.parameters(), values, strict=True):
        parameter.data = torch.from_numpy(value.copy())
    return network


def flatten(*modules: nn.Module) -> nn.Parameter:
    """Move all parameters of `modules` into one vector, of which they become views.

    The vector's gradient is likewise made of the parameters' gradients. Returns the vector.
    """
    parameters = [parameter for module in modules for parameter in module.parameters()]
    vector = nn.Parameter(torch.cat([p.detach().reshape(-1) for p in parameters]))
    vector.grad = torch.zeros_like(vector)
    start = 0
    for parameter in parameters:
        end = start + parameter.numel()
        parameter.data = vector.data[start:end].view_as(parameter)
        parameter.grad = vector.grad[start:end].view_as(parameter)
        start = end
    return vector


class FlatAdam:
    """Adam (Kingma & Ba 2014) on all parameters of modules as one vector.

    Each module comes with its step size.
    """

    def __init__(self, *modules: tuple[nn.Module, float], eps: float = 1e-8) -> None:
        self.vector = flatten(*(module for module, _ in modules))
        assert self.vector.grad is not None
        self.gradient = self.vector.grad
        self._moments = {name: torch.zeros_like(self.vector.data) for name in ("exp_avg", "exp_avg_sq")}
        self._steps = torch.zeros(len(modules), device=self.vector.device)
        sizes = [sum(p.numel() for p in module.parameters()) for module, _ in modules]
        slices = [slice(*ends) for ends in itertools.pairwise((0, *itertools.accumulate(sizes)))]
        parts = [nn.Parameter(self.vector.data[part]) for part in slices]
        groups = [{"params": [p], "lr": lr} for p, (_, lr) in zip(parts, modules, strict=True)]
        self._adam = torch.optim.Adam(groups, eps=eps, fused=True)
        for i, (parameter, part) in enumerate(zip(parts, slices, strict=True)):
            parameter.grad = self.gradient[part]
            moments = {name: values[part] for name, values in self._moments.items()}
            self._adam.state[parameter] = {"step": self._steps[i], **moments}

    def set_lr(self, lr: float) -> None:
        """Change the step size of all modules."""
        for group in self._adam.param_groups:
            group["lr"] = lr

    def zero_grad(self) -> None:
        """Set the gradient to zero, in place: the parameters' gradients are views of it."""
        self.gradient.zero_()

    def reduce(self, comm: Communicator, how: Literal["mean", "sum"] = "sum") -> None:
        """Replace the gradient by its sum or mean over ranks: one message."""
        comm.sum_(self.gradient)
        if how == "mean" and comm.size > 1:
            self.gradient.div_(comm.size)

    def clip(self, max_norm: float) -> None:
        """Scale the gradient down to `max_norm` where it is longer."""
        scale = max_norm / (torch.linalg.vector_norm(self.gradient) + 1e-6)
        self.gradient.mul_(scale.clamp(max=1.0))

    def step(self) -> None:
        """One step along the gradient."""
        self._adam.step()

    def is_finite(self) -> bool:
        """Are all parameters finite?"""
        return bool(torch.isfinite(self.vector).all())

    def state_dict(self) -> dict[str, Any]:
        """Moments (n,) and steps (modules,). The parameters belong to the modules, step sizes and
        eps to the configuration."""
        return {"steps": self._steps, **self._moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for name, values in self.state_dict().items():
            values.copy_(state[name])


def require_finite(adams: Sequence[FlatAdam], losses: Tensor, env_steps: int) -> None:
    """DivergenceError, rather than going on from losses or parameters that are not finite."""
    if not (bool(torch.isfinite(losses).all()) and all(adam.is_finite() for adam in adams)):
        raise DivergenceError(
            f"a loss or a parameter is not finite after {env_steps} steps "
            f"(losses {[f'{x:.3g}' for x in losses.tolist()]})"
        )
