"""Multilayer perceptrons of a problem: their inputs, how these are scaled, and where the first layer starts."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

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

FAR = (2.0, 16.0, 128.0, 1_024.0, 8_192.0)
"""Widths of boxes in which levels are asked for their numbers, in widths of `states`; paths may come so far."""

LOG_WIDTH = 0.01
"""The width of `LogLevels`, as a share of the width of a level over the box of states, see `_middle_and_width`."""

QUANTILES, HEAVY = (0.1587, 0.5, 0.8413), 5.0
"""The shares of a normal variable's values below -1, 0 and 1 deviations, and by which factor the deviation of a level
may exceed half the distance of the outer two quantiles, before these take its place."""


def perceptron(
    problem: ReachAvoidProblem,
    controls: int,
    hidden: Sequence[int],
    outputs: int,
    activation: str,
    output: str | nn.Module | None,
    root_time: bool,
    scaling: Box | None,
    levels: bool,
    log_levels: bool = False,
) -> nn.Sequential:
    """The layers, from inputs (*, 1 + n + controls) in physical units to `outputs` numbers.

    Args:
        problem: gives the horizon, the box of states and the sets.
        controls: the number of actions among the inputs, normalised to [-1, 1].
        hidden: widths of the hidden layers.
        outputs: the number of outputs.
        activation: the name of the layer of `torch.nn` that follows each hidden layer.
        output: the last layer, which follows the outputs, or its name in `torch.nn`; None for none.
        root_time, scaling, levels, log_levels: see `pirl_rl.networks.Critic`.

    Raises:
        ArgumentError: with the argument, what was expected and what was got.
    """
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
            middle, width = _middle_and_width(sampled)
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
    last = _activation("output", output) if isinstance(output, str) else output
    return nn.Sequential(*layers, Dense(width, outputs), *([] if last is None else [last]))


Ends = Sequence[tuple[float, float]]
"""The least and the largest number of each of k levels in the box of states."""


def _constraints(problem: ReachAvoidProblem, kept: Sequence[int] | None, x: Tensor, ends: Ends | None = None) -> Tensor:
    """The levels (*, k) of the constraints of A and B at states (*, n); of all, or of those with the numbers `kept`.

    With `ends`, a level that is infinite or has no number takes one of them: deep in its set it is the least, and else,
    as far outside, the largest.
    """
    sets = [problem.reached_constraints(x)] if problem.objective == "reach-avoid" else []
    both = torch.cat(sets + ([problem.avoid_constraints(x)] if problem.has_avoid_set else []), -1)
    levels = both if kept is None else both[..., kept]
    if ends is None:
        return levels
    pairs = zip(levels.unbind(-1), ends, strict=True)
    return torch.stack([torch.where(one.isfinite(), one, torch.where(one < 0, *pair)) for one, pair in pairs], -1)


def _levels(problem: ReachAvoidProblem) -> tuple[Levels, Tensor, Tensor]:
    """The layer of the k levels of A and B, these levels (N, k) at random states of the box, and which of the states
    are outside A and B, (N,)."""
    x = problem.states.sample(LEVEL_POINTS, torch.Generator().manual_seed(0), torch.float64)
    sampled = _constraints(problem, None, x)
    numbers = sampled.isfinite()
    least = torch.where(numbers, sampled, torch.inf).amin(0)
    largest = torch.where(numbers, sampled, -torch.inf).amax(0)
    # A level that is constant, or has no number anywhere, says nothing.
    kept = (least < largest).nonzero().flatten().tolist()
    levels = partial(_constraints, problem, kept if len(kept) < sampled.shape[-1] else None)
    rng = torch.Generator().manual_seed(0)
    far = torch.cat([problem.states.expand(factor).sample(LEVEL_POINTS, rng, x.dtype) for factor in FAR])
    if not levels(torch.cat([x, far])).isfinite().all():
        levels = partial(levels, ends=[*zip(least[kept].tolist(), largest[kept].tolist(), strict=True)])
    return Levels(levels, problem.states.dim), levels(x), problem.interior(x)


def _middle_and_width(sampled: Tensor) -> tuple[Tensor, Tensor]:
    """The middle and the width (k,) of levels (N, k) over the box, by which they are scaled: mean and deviation.

    Where a few values deep in a set are much larger than all others, the deviation would be that of these alone. There
    the middle is the median, and the width is half the distance between the two `QUANTILES` beside it, which is the
    deviation of a normal variable.
    """
    middle, width = sampled.mean(0), sampled.std(0)
    low, median, high = sampled.quantile(sampled.new_tensor(QUANTILES), dim=0)
    usual = (high - low) / 2
    heavy = (usual > 0) & (width > HEAVY * usual)
    return torch.where(heavy, median, middle), torch.where(heavy, usual, width)


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


def initialise_xavier(layers: nn.Sequential) -> None:
    """Draw the weights of all linear layers by Glorot's and Bengio's rule (2010), and set their biases to 0."""
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)


def spread_zeros(layers: nn.Sequential, spread: float | None, problem: ReachAvoidProblem, controls: int) -> None:
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
