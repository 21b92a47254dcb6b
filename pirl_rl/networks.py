"""Actor and critics: multilayer perceptrons whose first layer scales the inputs to [-1, 1].

They take the sine and the cosine of a periodic coordinate, so that they have its period exactly, with all derivatives.

The parameters may have leading axes, over which `forward` broadcasts. With weights stacked as (critics, out, in), as in
TorchRL's losses, one call evaluates all critics and returns (critics, N, 1).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.layers import Dense, Levels, LogLevels, Periodic, RootTime, Scaling
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box

ROOT_TIME_OFFSET = 1e-4
"""tau_0 of `RootTime` as a fraction of the horizon."""

LEVEL_POINTS = 4_096
"""The number of states at which the levels of the sets are taken to scale them."""

LOG_WIDTH = 0.01
"""The width of `LogLevels`, as a share of the standard deviation of a level over the box of states."""


def _stack(
    problem: ReachAvoidProblem,
    controls: int,
    hidden: Sequence[int],
    outputs: int,
    activation: str,
    output: str | None,
    root_time: bool,
    scaling: Box | None,
    levels: bool,
    log_levels: bool = False,
) -> nn.Sequential:
    if log_levels and not levels:
        raise ArgumentError("log_levels: expected levels=true beside log_levels=true, got levels=false")
    if not all(isinstance(width, int) and width >= 1 for width in hidden):
        raise ArgumentError(f"hidden: expected widths of layers, integers >= 1, got {list(hidden)}")
    box = _with_periods(scaling or problem.states, problem.states)
    low, high = (0.0, *box.low, *[-1.0] * controls), (problem.horizon, *box.high, *[1.0] * controls)
    layers: list[nn.Module] = []
    if levels:
        layer, sampled, outside = _levels(problem)
        layers.append(layer)
        if sampled.shape[-1]:
            middle, width = sampled.mean(0), sampled.std(0)
            low, high = (*low, *(middle - width).tolist()), (*high, *(middle + width).tolist())
            if log_levels:
                layers.append(logs := LogLevels(LOG_WIDTH * width))
                least, largest = _range_of_logs(logs, sampled[outside] if outside.any() else sampled)
                low, high = (*low, *least.tolist()), (*high, *largest.tolist())
    if root_time:
        tau_0 = ROOT_TIME_OFFSET * problem.horizon
        layers.append(RootTime(tau_0))
        low, high = (*low, tau_0**0.5), (*high, (problem.horizon + tau_0) ** 0.5)
    layers.append(Scaling(low, high))
    width = len(low)
    if box.periodic:
        # The time to go is the first input.
        layers.append(Periodic(width, [1 + axis for axis in box.periodic]))
        width += len(box.periodic)
    for wide in hidden:
        layers += [Dense(width, wide), _activation("activation", activation)]
        width = wide
    return nn.Sequential(*layers, Dense(width, outputs), *([] if output is None else [_activation("output", output)]))


def _constraints(problem: ReachAvoidProblem, kept: Sequence[int] | None, x: Tensor) -> Tensor:
    """The levels (*, k) of the constraints of A and B at states (*, n); of all, or of those with the numbers `kept`."""
    sets = [problem.reached_constraints(x)] if problem.objective == "reach-avoid" else []
    both = torch.cat(sets + ([problem.avoid_constraints(x)] if problem.has_avoid_set else []), -1)
    return both if kept is None else both[..., kept]


def _levels(problem: ReachAvoidProblem) -> tuple[Levels, Tensor, Tensor]:
    """The layer of the k levels of A and B, these levels (N, k) at random states of the box, and which of the states
    are outside A and B, (N,)."""
    x = problem.states.sample(LEVEL_POINTS, torch.Generator().manual_seed(0), torch.float64)
    sampled = _constraints(problem, None, x)
    width = sampled.std(0)
    # A level that is constant or infinite says nothing.
    kept = ((width > 0) & width.isfinite()).nonzero().flatten().tolist()
    levels = partial(_constraints, problem, kept if len(kept) < len(width) else None)
    return Levels(levels, problem.states.dim), sampled[:, kept], problem.interior(x)


def _range_of_logs(logs: LogLevels, sampled: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest logarithm (k,) of each level among levels (N, k), between which the zeros of the first
    layer are spread. A level may be constant outside of its set, as the sign of another one; its range has length 1."""
    least, largest = logs.logs(sampled)[0].aminmax(dim=0)
    return least, torch.where(largest > least, largest, least + 1)


def _with_periods(box: Box, states: Box) -> Box:
    """The box with the periodic axes of `states` in place of its own."""
    low, high = list(box.low), list(box.high)
    for axis in states.periodic:
        low[axis], high[axis] = states.low[axis], states.high[axis]
    return Box(low, high, states.periodic)


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


def _spread(layers: nn.Sequential, spread: float | None, problem: ReachAvoidProblem, controls: int) -> None:
    """Spread the zeros of the first hidden layer over the box of the inputs; nothing happens without a spread.

    By the usual initialisation all zeros pass near the middle of the box, and training has to move them first. In few
    dimensions, where V has kinks and layers in many places, that takes most of the updates. Of n > 2 states each has
    2/n of the weight of the other inputs: time and levels would otherwise be lost among many states, along a single
    one of which V changes little.

    Raises:
        ArgumentError: `spread` is not positive.
    """
    if spread is None:
        return
    if not spread > 0:
        raise ArgumentError(f"spread: expected a number > 0, or None, got {spread}")
    first = next(index for index, layer in enumerate(layers) if isinstance(layer, Dense))
    dense: Dense = layers[first]  # type: ignore[assignment]
    count, states = dense.out_features, problem.states.dim
    tau, action = problem.horizon * torch.rand(count, 1), 2 * torch.rand(count, controls) - 1
    with torch.no_grad():
        through = layers[:first](torch.cat([tau, problem.states.sample(count), action], -1))
        direction = torch.randn_like(dense.weight)
        # The time to go is the first input, the states follow, and the cosines of periodic ones are the last.
        cosines = range(direction.shape[-1] - len(problem.states.periodic), direction.shape[-1])
        direction[:, [*range(1, 1 + states), *cosines]] *= min(1.0, 2 / states)
        dense.weight.copy_(2 * spread * torch.rand(count, 1) * nn.functional.normalize(direction, dim=-1))
        dense.bias.copy_(-(dense.weight * through).sum(-1))


class Actor(nn.Module):
    """The policy pi(tau, x): maps tau (N, 1), in s, and x (N, n) to the control (N, m), normalised to [-1, 1].

    Args:
        problem: gives the numbers of states and controls, and the horizon.
        hidden: widths of the hidden layers.
        activation: name of a layer of `torch.nn`.
        scaling: box of states that the first layer maps to [-1, 1]^n; default `problem.states`, which gives the periods
            of periodic axes in any case.
        root_time: whether sqrt(tau) is an input beside tau, see `RootTime`.
        spread: the mean slope of the neurons of the first layer in the scaled inputs. Their zeros then pass through
            points that are uniform in the box. None takes the usual initialisation, for which all zeros pass near the
            middle of the box.
        levels: whether the levels of the constraints of A and B are inputs too, see `Levels`.

    Raises:
        ArgumentError: `activation` is not the name of a layer of `torch.nn`, or `spread` is not positive.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        hidden: Sequence[int] = (32, 32),
        activation: str = "ReLU",
        scaling: Box | None = None,
        root_time: bool = False,
        spread: float | None = None,
        levels: bool = False,
    ):
        super().__init__()
        self.layers = _stack(problem, 0, hidden, problem.controls.dim, activation, "Tanh", root_time, scaling, levels)
        _spread(self.layers, spread, problem, 0)

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
        scaling: box of states that the first layer maps to [-1, 1]^n; default `problem.states`, which gives the periods
            of periodic axes in any case.
        spread: the mean slope of the neurons of the first layer in the scaled inputs. Their zeros then pass through
            points that are uniform in the box. None takes the usual initialisation, for which all zeros pass near the
            middle of the box.
        levels: whether the levels of the constraints of A and B are inputs too, see `Levels`.
        log_levels: whether the logarithms of these levels are inputs beside them, see `LogLevels`.

    Raises:
        ArgumentError: `activation` or `output` is not the name of a layer of `torch.nn`, `spread` is not positive, or
            `log_levels` is given without `levels`.
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
        spread: float | None = None,
        levels: bool = False,
        log_levels: bool = False,
    ):
        super().__init__()
        self.action_input = action_input
        controls = problem.controls.dim if action_input else 0
        self.layers = _stack(problem, controls, hidden, 1, activation, output, root_time, scaling, levels, log_levels)
        _xavier(self.layers)
        _spread(self.layers, spread, problem, controls)

    def inputs(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """The input (N, d) of the first layer: (tau, x, u), or (tau, x) for a critic V(tau, x)."""
        return torch.cat([tau, state, action] if self.action_input else [tau, state], -1)

    def logits(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """The output (N, 1) before the sigmoid of the last layer, for a critic with output "Sigmoid"."""
        return self.layers[:-1](self.inputs(tau, state, action))

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


def unstack(critic: Critic) -> list[Critic]:
    """The critics, with parameters of their own, that `stack` has made one of."""
    critics = []
    for i in range(len(next(critic.parameters()))):
        one = copy.deepcopy(critic)
        for layer in one.layers:
            for key in layer._parameters:
                setattr(layer, key, nn.Parameter(getattr(layer, key)[i].detach()))
            for key in layer._buffers:
                setattr(layer, key, getattr(layer, key)[i])
        critics.append(one)
    return critics


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
