"""Actor and critics: multilayer perceptrons whose first layer scales the inputs to [-1, 1].

The parameters may have leading axes, over which `forward` broadcasts. With weights stacked as (critics, out, in), as in
TorchRL's losses, one call evaluates all critics and returns (critics, N, 1).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box

ROOT_TIME_OFFSET = 1e-4
"""tau_0 of `RootTime` as a fraction of the horizon."""


class Dense(nn.Linear):
    """x W^T + b (*, N, out) of x (*, N, in); weight (*, out, in) and bias (*, out) may be stacked."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.matmul(input, self.weight.mT) + self.bias.unsqueeze(-2)


class Scaling(nn.Module):
    """The affine map of the box [low, high] to [-1, 1]^d, for inputs (*, N, d).

    As a layer it needs no scaled copy of the physics: derivatives in physical units follow by the chain rule.

    Args:
        low: lower corner, d numbers.
        high: upper corner, d numbers.
    """

    scale: Tensor
    shift: Tensor

    def __init__(self, low: Sequence[float], high: Sequence[float]):
        super().__init__()
        low_, high_ = torch.as_tensor(low, dtype=torch.float64), torch.as_tensor(high, dtype=torch.float64)
        scale = 2 / (high_ - low_)
        self.register_buffer("scale", scale.to(torch.get_default_dtype()))
        self.register_buffer("shift", (-(low_ + high_) / 2 * scale).to(torch.get_default_dtype()))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale.unsqueeze(-2) + self.shift.unsqueeze(-2)


class RootTime(nn.Module):
    """Appends sqrt(tau + tau_0) to inputs (*, d) whose first entry is the time to go tau.

    Where the boundary data jump at tau = 0, V varies over a width proportional to sqrt(tau). As a function of the root
    of time that is a wedge, which a small network can represent up to tau = 0.

    Args:
        tau_0: in s, above 0; it bounds the slope 1/(2 sqrt(tau + tau_0)) at tau = 0.
    """

    def __init__(self, tau_0: float):
        super().__init__()
        self.tau_0 = tau_0

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, torch.sqrt(x[..., :1] + self.tau_0)], -1)


def _stack(
    problem: ReachAvoidProblem,
    controls: int,
    hidden: Sequence[int],
    outputs: int,
    activation: str,
    output: str | None,
    root_time: bool,
    box: Box,
) -> nn.Sequential:
    low, high = (0.0, *box.low), (problem.horizon, *box.high)
    low, high = (*low, *[-1.0] * controls), (*high, *[1.0] * controls)
    layers: list[nn.Module] = []
    if root_time:
        tau_0 = ROOT_TIME_OFFSET * problem.horizon
        layers.append(RootTime(tau_0))
        low, high = (*low, tau_0**0.5), (*high, (problem.horizon + tau_0) ** 0.5)
    layers.append(Scaling(low, high))
    width = len(low)
    for wide in hidden:
        layers += [Dense(width, wide), _activation("activation", activation)]
        width = wide
    return nn.Sequential(*layers, Dense(width, outputs), *([] if output is None else [_activation("output", output)]))


def _activation(argument: str, name: str) -> nn.Module:
    """The layer of `torch.nn` with this name, made without arguments.

    Raises:
        ArgumentError: `torch.nn` has no such layer; the message names `argument`.
    """
    layer = getattr(nn, name, None)
    if not (isinstance(layer, type) and issubclass(layer, nn.Module)):
        raise ArgumentError(f"{argument}: expected the name of a layer of torch.nn, got {name!r}")
    return layer()


def _xavier(layers: nn.Sequential) -> None:
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)


class Actor(nn.Module):
    """The policy pi(tau, x): maps tau (N, 1), in s, and x (N, n) to the control (N, m), normalised to [-1, 1].

    Args:
        problem: gives the numbers of states and controls, and the horizon.
        hidden: widths of the hidden layers.
        activation: name of a layer of `torch.nn`.
        scaling: box of states that the first layer maps to [-1, 1]^n; default `problem.states`.

    Raises:
        ArgumentError: `activation` is not the name of a layer of `torch.nn`.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        hidden: Sequence[int] = (32, 32),
        activation: str = "ReLU",
        scaling: Box | None = None,
    ):
        super().__init__()
        box = scaling or problem.states
        self.layers = _stack(problem, 0, hidden, problem.controls.dim, activation, "Tanh", root_time=False, box=box)

    def logits(self, tau: Tensor, state: Tensor) -> Tensor:
        """The output (N, m) before the hyperbolic tangent of the last layer."""
        return self.layers[:-1](torch.cat([tau, state], -1))

    def forward(self, tau: Tensor, state: Tensor) -> Tensor:
        return self.layers[-1](self.logits(tau, state))


class Critic(nn.Module):
    """Q(tau, x, u) or V(tau, x): maps tau (N, 1), in s, x (N, n) and the normalised u (N, m) to a probability (N, 1).

    Args:
        problem: gives the numbers of states and controls, and the horizon.
        hidden: widths of the hidden layers.
        activation: name of a layer of `torch.nn`; `PIRLLoss` needs a C^2 one.
        action_input: True makes a critic Q(tau, x, u), as in the paper. False makes a critic V(tau, x), which ignores
            the action. Its derivatives are those of the value of the policy, so that played actions must have no noise.
        root_time: whether sqrt(tau) is an input beside tau, see `RootTime`.
        output: "Sigmoid" keeps the output in (0, 1), as in the paper, but attains 0 or 1 at a face only in the limit of
            infinite weights. None is a linear output, which attains both.
        scaling: box of states that the first layer maps to [-1, 1]^n; default `problem.states`.

    Raises:
        ArgumentError: `activation` or `output` is not the name of a layer of `torch.nn`.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        hidden: Sequence[int] = (32, 32, 32),
        activation: str = "Tanh",
        action_input: bool = False,
        root_time: bool = True,
        output: Literal["Sigmoid"] | None = None,
        scaling: Box | None = None,
    ):
        super().__init__()
        self.action_input = action_input
        controls = problem.controls.dim if action_input else 0
        self.layers = _stack(problem, controls, hidden, 1, activation, output, root_time, scaling or problem.states)
        _xavier(self.layers)

    def inputs(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """The input (N, d) of the first layer: (tau, x, u), or (tau, x) for a critic V(tau, x)."""
        return torch.cat([tau, state, action] if self.action_input else [tau, state], -1)

    def forward(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        return self.layers(self.inputs(tau, state, action))

    def at(self, action: Tensor) -> CriticValue:
        """The function V(tau, x) = Q(tau, x, action) with the action (N, m) frozen."""
        return CriticValue(self, action)


def stack(critics: Sequence[Critic]) -> Critic:
    """One critic whose parameters have a leading axis over `critics`, as in TorchRL's losses."""
    twin = copy.deepcopy(critics[0])
    for layer, *layers in zip(twin.layers, *(critic.layers for critic in critics), strict=True):
        for key in layer._parameters:
            setattr(layer, key, nn.Parameter(torch.stack([getattr(one, key) for one in layers]).detach()))
        for key in layer._buffers:
            setattr(layer, key, torch.stack([getattr(one, key) for one in layers]))
    return twin


class CriticValue:
    """A critic at a frozen action: maps tau (N,) and x (N, n) to V (N,), or (critics, N) with stacked parameters.

    Args:
        critic: the critic.
        action: the action (N, m), normalised to [-1, 1].
    """

    def __init__(self, critic: Critic, action: Tensor):
        self.critic, self.action = critic, action

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.critic(tau.unsqueeze(-1), x, self.action).squeeze(-1)
