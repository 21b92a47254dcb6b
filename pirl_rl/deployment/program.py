"""The function that is deployed: V, its gradient in x and the policy, of times to go and states in SI units."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from pirl_rl.layers import Dense, Levels, LogLevels, Periodic, RootTime, Scaling
from pirl_rl.networks import Actor, Critic, unstack
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box
from pirl_rl.solution import Solution


class Program:
    """A solution as one function, of times to go tau (N,) in s and states x (N, n) in SI units.

    It returns `value`, V (N,) in [0, 1], `gradient`, the gradient of V in x (N, n) per unit of each state, and
    `control` (N, m) in SI units. They are those of `Solution`, up to rounding. The function has few operators, since a
    runtime that evaluates one state spends most of its time between them: each critic has matrices of its own, the
    first of which include the scaling of the inputs, and sets that a problem does not have leave no trace.

    Args:
        solution: the problem and the networks, whose numbers are copied.
    """

    def __init__(self, solution: Solution):
        self.problem = solution.problem
        self.actor = _Network(solution.actor, solution.problem.states.dim)
        self.critics = [_Network(critic, solution.problem.states.dim) for critic in unstack(solution.critic)]
        self.action_input = solution.critic.action_input
        self.wrap = _Wrap(solution.problem.states, solution.dtype)

    def __call__(self, tau: Tensor, x: Tensor) -> dict[str, Tensor]:
        problem, time = self.problem, tau.unsqueeze(-1)
        x = self.wrap(x)
        action = self.actor([time, x])

        def raw_value(y: Tensor) -> Tensor:
            values = [critic([time, y, action] if self.action_input else [time, y]) for critic in self.critics]
            return torch.cat(values, -1).mean(-1) if len(values) > 1 else values[0].squeeze(-1)

        value, pullback = torch.func.vjp(raw_value, x)  # type: ignore[misc]
        # Outside this block torch writes derivatives of activations so that they can be differentiated once more.
        with torch.no_grad():
            (gradient,) = pullback(torch.ones_like(value))
        value = self._masked(value.clamp(0, 1), x)
        return {"value": value, "gradient": gradient, "control": problem.controls.denormalize(action)}

    def _masked(self, value: Tensor, x: Tensor) -> Tensor:
        """V (N,) with 1 in A and 0 where it is lost, as far as the problem has such states."""
        problem = self.problem
        if problem.objective == "reach-avoid":
            value = value.masked_fill(problem.reached(x), 1.0)
        lost = [problem.failed(x)] if problem.has_avoid_set else []
        if type(problem).unreachable is not ReachAvoidProblem.unreachable:
            lost.append(problem.unreachable(x))
        for mask in lost:
            value = value.masked_fill(mask, 0.0)
        return value


class _Network:
    """The output of a network at its inputs: times to go (N, 1), states (N, n), and for Q(tau, x, u) actions (N, m).

    The weights of the first affine map include the scaling of its inputs. Sines and cosines of periodic coordinates
    come after all other inputs, and the weights of these coordinates themselves are 0.

    Args:
        network: an actor or a single critic, whose numbers are copied.
        states: the number n of states.
    """

    def __init__(self, network: Actor | Critic, states: int):
        layers = list(network.layers)
        dense = next(layer for layer in layers if isinstance(layer, Dense))
        scaling = next(layer for layer in layers if isinstance(layer, Scaling))
        first, dtype = layers.index(dense), dense.weight.dtype
        self.features = [layer for layer in layers[:first] if isinstance(layer, (Levels, LogLevels, RootTime))]
        self.rest = [copy.deepcopy(layer).requires_grad_(False) for layer in layers[first + 1 :]]
        scale, shift, weight, bias = (
            entry.detach().double() for entry in (scaling.scale, scaling.shift, dense.weight, dense.bias)
        )
        waves = [_angles(layer, scale, shift, states) for layer in layers[:first] if isinstance(layer, Periodic)]
        self.waves = [(phase.to(dtype), frequency.to(dtype)) for phase, frequency, _ in waves]
        sines = [weight[:, places] for _, _, places in waves]
        weight = weight[:, : len(scale)].clone()
        for _, _, places in waves:
            weight[:, [place for place in places if place < len(scale)]] = 0.0
        self.bias, self.weight = bias.to(dtype), torch.cat([weight * scale, *sines], -1).mT.to(dtype)
        # Subtracted before the product: bias and weights times large inputs would cancel each other.
        self.middle = torch.cat([-shift / scale, torch.zeros(sum(part.shape[-1] for part in sines))]).to(dtype)

    def __call__(self, inputs: list[Tensor]) -> Tensor:
        time, x, *_ = inputs
        features: list[Tensor] = []
        for layer in self.features:
            if isinstance(layer, LogLevels):
                features.append(torch.asinh(features[-1] / layer.width))
            else:
                features.append(layer.levels(x) if isinstance(layer, Levels) else layer.root(time))
        waves = [torch.sin(torch.addmm(phase, x, frequency)) for phase, frequency in self.waves]
        z = torch.addmm(self.bias, torch.cat([*inputs, *features, *waves], -1) - self.middle, self.weight)
        for layer in self.rest:
            z = layer(z)
        return z


def _angles(layer: Periodic, scale: Tensor, shift: Tensor, states: int) -> tuple[Tensor, Tensor, list[int]]:
    """Phases (2k,) and frequencies (n, 2k) of the angles of k periodic coordinates, whose sines the layer gives.

    The third result are the places of these sines among the outputs of the layer, whose inputs are scaled by `scale`
    (d,) and shifted by `shift` (d,).
    """
    columns = [*layer.columns, *layer.columns]
    places = [*layer.columns, *range(len(scale), len(scale) + len(layer.columns))]
    rate, phase = layer.frequency.double()[places], layer.phase.double()[places]
    frequency = torch.zeros(states, len(places), dtype=torch.float64)
    # The time to go is the first column.
    frequency[[column - 1 for column in columns], range(len(places))] = rate * scale[columns]
    return rate * (shift[columns] + 1) + phase, frequency, places


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
