"""The function that is deployed: V, its gradient in x and the policy, of times to go and states in SI units."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from pirl_rl.layers import Levels, RootTime
from pirl_rl.networks import Actor, Critic, unstack
from pirl_rl.sets import Box
from pirl_rl.solution import Solution


class Program:
    """A solution as one function, of times to go tau (N,) in s and states x (N, n) in SI units.

    It returns `value`, V (N,) in [0, 1], `gradient`, the gradient of V in x (N, n) per unit of each state, and
    `control` (N, m) in SI units. They are those of `Solution`, up to rounding. The function has few operators, since a
    runtime that evaluates one state spends most of its time between them. Each critic therefore has matrices of its
    own, and the features of tau and x are made of tau and x themselves, not of slices of the networks' input.

    Args:
        solution: the problem and the networks, which are copied.
    """

    def __init__(self, solution: Solution):
        self.problem = solution.problem
        self.actor = copy.deepcopy(solution.actor).requires_grad_(False)
        self.critics = [critic.requires_grad_(False) for critic in unstack(solution.critic)]
        self.wrap = _Wrap(solution.problem.states, solution.dtype)

    def __call__(self, tau: Tensor, x: Tensor) -> dict[str, Tensor]:
        problem, time = self.problem, tau.unsqueeze(-1)
        x = self.wrap(x)
        action = _output(self.actor, [time, x])

        def raw_value(y: Tensor) -> Tensor:
            values = [_output(one, [time, y, action] if one.action_input else [time, y]) for one in self.critics]
            return torch.cat(values, -1).mean(-1) if len(values) > 1 else values[0].squeeze(-1)

        value, pullback = torch.func.vjp(raw_value, x)  # type: ignore[misc]
        # Outside this block torch writes derivatives of activations so that they can be differentiated once more.
        with torch.no_grad():
            (gradient,) = pullback(torch.ones_like(value))
        lost = problem.failed(x) | problem.unreachable(x)
        value = value.clamp(0, 1).masked_fill(problem.reached(x), 1.0).masked_fill(lost, 0.0)
        return {"value": value, "gradient": gradient, "control": problem.controls.denormalize(action)}


def _output(network: Actor | Critic, inputs: list[Tensor]) -> Tensor:
    """The output of a network at its inputs: times to go (N, 1), states (N, n), and for Q(tau, x, u) actions (N, m)."""
    features, layers = [*inputs], []
    for layer in network.layers:
        if isinstance(layer, Levels):
            features.append(layer.levels(inputs[1]))
        elif isinstance(layer, RootTime):
            features.append(layer.root(inputs[0]))
        else:
            layers.append(layer)
    z = torch.cat(features, -1)
    for layer in layers:
        z = layer(z)
    return z


class _Wrap:
    """`box.wrap` of states (N, n) with few operators; rounding may leave a coordinate at the other end of its period.

    Both ends of a period are the same state.
    """

    def __init__(self, box: Box, dtype: torch.dtype):
        low, high = torch.tensor([box.low, box.high], dtype=torch.float64)
        turning = torch.zeros_like(low)
        turning[[*box.periodic]] = 1.0
        self.periodic = bool(box.periodic)
        self.low, self.period, self.turns = (
            entry.to(dtype) for entry in (low, turning * (high - low), turning / (high - low))
        )

    def __call__(self, x: Tensor) -> Tensor:
        return x - self.period * torch.floor((x - self.low) * self.turns) if self.periodic else x
