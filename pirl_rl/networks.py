"""Actor and critics: plain layer stacks, scaled to [-1, 1] by their first layer.

Every forward broadcasts over leading axes of the parameters: with weights stacked as (critics, out, in), as TorchRL's
losses hold them, one call evaluates all critics, (critics, N, 1).
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
    """x W^T + b with parameters that may be stacked: weight (*, out, in), bias (*, out), x (*, N, in)."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.matmul(input, self.weight.mT) + self.bias.unsqueeze(-2)


class Scaling(nn.Module):
    """The affine map of [low, high] to [-1, 1], axis by axis, as a layer: autograd does the chain rule."""

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
    """Appends sqrt(tau + tau_0) to inputs (*, d) whose first entry is the time to go.

    Where data jump at tau = 0, V spreads over a width of sqrt(tau): in the root of time that is a wedge, which a small
    network can follow into the corner. tau_0 > 0 bounds the slope 1/(2 sqrt(tau + tau_0)) at tau = 0.
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
    """The layer of `torch.nn` of that name, without arguments.

    Raises:
        ArgumentError: there is none.
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
    """pi(tau, x): the normalised control, (*, 1), (*, n) -> (*, m) in [-1, 1].

    Args:
        problem: gives the scaling and the sizes.
        hidden: widths of the hidden layers.
        activation: name of a module of `torch.nn`.
        scaling: box of states that the first layer maps to [-1, 1]; default `problem.states`.
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
        """What the control is the hyperbolic tangent of."""
        return self.layers[:-1](torch.cat([tau, state], -1))

    def forward(self, tau: Tensor, state: Tensor) -> Tensor:
        return self.layers[-1](self.logits(tau, state))


class Critic(nn.Module):
    """Q(tau, x, u), or V(tau, x): a probability, (*, 1), (*, n), (*, m) -> (*, 1); u normalised.

    Args:
        problem: gives the scaling and the sizes.
        hidden: widths of the hidden layers.
        activation: name of a module of `torch.nn`; C^2 where an HJB residual is taken.
        action_input: True is Q, as in the paper; its derivatives at a frozen u are those of holding u for ever. False
            is V: the action is ignored, derivatives are those of the policy's value, and transitions must be played
            without noise.
        root_time: whether sqrt(tau) is an input beside tau, see `RootTime`.
        output: "Sigmoid" keeps probabilities in (0, 1), as in the paper, but reaches 0 or 1 at a face only in the limit
            of infinite weights; None is linear, and meets a face as V does.
        scaling: box of states that the first layer maps to [-1, 1]; default `problem.states`.
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
        return torch.cat([tau, state, action] if self.action_input else [tau, state], -1)

    def forward(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        return self.layers(self.inputs(tau, state, action))

    def at(self, action: Tensor) -> CriticValue:
        """V(tau, x) = Q(tau, x, action) with the action (N, m) frozen."""
        return CriticValue(self, action)


def stack(critics: Sequence[Critic]) -> Critic:
    """One critic whose parameters carry a leading axis over `critics`, as TorchRL's losses hold them."""
    twin = copy.deepcopy(critics[0])
    for layer, *layers in zip(twin.layers, *(critic.layers for critic in critics), strict=True):
        for key in layer._parameters:
            setattr(layer, key, nn.Parameter(torch.stack([getattr(one, key) for one in layers]).detach()))
        for key in layer._buffers:
            setattr(layer, key, torch.stack([getattr(one, key) for one in layers]))
    return twin


class CriticValue:
    """A critic at a frozen action: V, (N,), (N, n) -> (N,), or (critics, N) with stacked parameters."""

    def __init__(self, critic: Critic, action: Tensor):
        self.critic, self.action = critic, action

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.critic(tau.unsqueeze(-1), x, self.action).squeeze(-1)
