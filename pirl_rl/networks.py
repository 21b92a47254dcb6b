"""Actor and critics: plain layer stacks, scaled to [-1, 1] by their first layer.

Every forward broadcasts over leading axes of the parameters: with weights stacked as (critics, out, in), as TorchRL's
losses hold them, one call evaluates all critics, (critics, N, 1).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pirl_rl.problem import ReachAvoidProblem


class Dense(nn.Linear):
    """x W^T + b with parameters that may be stacked: weight (*, out, in), bias (*, out), x (*, N, in)."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.matmul(input, self.weight.mT) + self.bias.unsqueeze(-2)


class Scaling(nn.Module):
    """The affine map of [low, high] to [-1, 1], axis by axis, as a layer: autograd does the chain rule."""

    def __init__(self, low: Sequence[float], high: Sequence[float]):
        super().__init__()
        low_, high_ = torch.as_tensor(low, dtype=torch.float64), torch.as_tensor(high, dtype=torch.float64)
        scale = 2 / (high_ - low_)
        self.register_buffer("scale", scale.to(torch.get_default_dtype()))
        self.register_buffer("shift", (-(low_ + high_) / 2 * scale).to(torch.get_default_dtype()))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale.unsqueeze(-2) + self.shift.unsqueeze(-2)


def _stack(problem: ReachAvoidProblem, width_in: int, hidden, width_out: int, activation, output) -> nn.Sequential:
    low, high = (0.0, *problem.states.low), (problem.horizon, *problem.states.high)
    extra = width_in - len(low)
    layers: list[nn.Module] = [Scaling((*low, *[-1.0] * extra), (*high, *[1.0] * extra))]
    for wide in hidden:
        layers += [Dense(width_in, wide), getattr(nn, activation)()]
        width_in = wide
    return nn.Sequential(*layers, Dense(width_in, width_out), getattr(nn, output)())


def _xavier(layers: nn.Sequential) -> None:
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)


class Actor(nn.Module):
    """pi(tau, x): the normalised control, (*, 1), (*, n) -> (*, m) in [-1, 1].

    Args:
        problem: gives the scaling and the sizes.
        hidden: widths of the hidden layers.
        activation: name of a module of `torch.nn`.
    """

    def __init__(self, problem: ReachAvoidProblem, hidden: Sequence[int] = (32, 32), activation: str = "ReLU"):
        super().__init__()
        inputs = 1 + problem.states.dim
        self.layers = _stack(problem, inputs, hidden, problem.controls.dim, activation, "Tanh")

    def forward(self, tau: Tensor, state: Tensor) -> Tensor:
        return self.layers(torch.cat([tau, state], -1))


class Critic(nn.Module):
    """Q(tau, x, u): a probability, (*, 1), (*, n), (*, m) -> (*, 1) in (0, 1); u normalised.

    Args:
        problem: gives the scaling and the sizes.
        hidden: widths of the hidden layers.
        activation: name of a module of `torch.nn`; C^2 where an HJB residual is taken.
    """

    def __init__(self, problem: ReachAvoidProblem, hidden: Sequence[int] = (32, 32, 32), activation: str = "Tanh"):
        super().__init__()
        inputs = 1 + problem.states.dim + problem.controls.dim
        self.layers = _stack(problem, inputs, hidden, 1, activation, "Sigmoid")
        _xavier(self.layers)

    @staticmethod
    def inputs(tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        return torch.cat([tau, state, action], -1)

    def forward(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        return self.layers(self.inputs(tau, state, action))

    def at(self, action: Tensor) -> CriticValue:
        """V(tau, x) = Q(tau, x, action) with the action (N, m) frozen."""
        return CriticValue(self, action)


class CriticValue:
    """A critic at a frozen action: V, (N,), (N, n) -> (N,), or (critics, N) with stacked parameters."""

    def __init__(self, critic: Critic, action: Tensor):
        self.critic, self.action = critic, action

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.critic(tau.unsqueeze(-1), x, self.action).squeeze(-1)
