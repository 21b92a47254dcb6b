"""Ascent over the levels of a control, at a cost that is linear in the number m of its coordinates.

The ascent gives one coordinate of the control after the other its best level while the rest stand still. It finds the
maximum over the levels if the objective is a sum of functions of one coordinate each. The Hamiltonian is one where the
drift is affine in u and sigma does not depend on u; its maximum is then a vertex of the box of controls. Unlike steps
along a gradient in u, the ascent leaves a local maximum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Objective = Callable[[Tensor], Tensor]
"""Maps actions (N, m), normalised to [-1, 1], to numbers (N,), each of which depends on its own action alone.

Those of `pirl_rl.action_values` and `pirl_rl.cubature` map actions (*, N, m) to numbers (*, N)."""


def ascend(objective: Objective, action: Tensor, levels: Tensor, sweeps: int = 1) -> tuple[Tensor, Tensor]:
    """Ascent over levels, one coordinate of the action or one group of s coordinates after the other.

    Args:
        objective: the function to maximise.
        action: where the ascent starts (N, m).
        levels: the levels (k,) of each coordinate, or the combinations (K, s) of levels of each s coordinates in a row.
        sweeps: how often it passes through all coordinates.

    Returns:
        The action (N, m) that was found, and its objective (N,), which is at least that of the start.
    """
    levels = levels.reshape(len(levels), -1)
    best, size = objective(action), levels.shape[1]
    for _ in range(sweeps):
        for i in range(0, action.shape[-1], size):
            for level in levels.unbind():
                trial = action.clone()
                trial[:, i : i + size] = level
                value = objective(trial)
                better = value > best
                best, action = torch.where(better, value, best), torch.where(better.unsqueeze(-1), trial, action)
    return action, best


def improved(
    objective: Objective,
    action: Tensor,
    levels: Tensor,
    inertia: float = 0.0,
    stride: int = 1,
    tried: Sequence[int] | None = None,
) -> tuple[Tensor, Tensor]:
    """The best level of each coordinate while the others stand still, for all coordinates in one call of the objective.

    If the objective is a sum of functions of one coordinate each, the best levels together are the maximum over the
    levels. Where they are worse together than the best of them alone, that one alone is taken. Groups of s coordinates
    take the place of coordinates where the levels are combinations of theirs.

    Inertia decides between levels that are nearly as good as each other: from an action to each level, the objective
    loses this share of its range between the two for each unit of their distance, which is the largest of those of the
    coordinates in a group. Between the two maxima of a function whose minimum lies in the middle, an action then goes
    to one and stays there. A level that is much worse than the action and than the level under trial, and does not lie
    between them, does not hold the action back. Where the objective is affine in a coordinate, the best of two bounds
    stays the best with any inertia below 1/2, and the best of more levels with any of at most 1/4.

    Args:
        objective: the function to maximise, for actions (*, N, m).
        action: the action (N, m) that is improved.
        levels: the levels (k,) of each coordinate in rising order, bounds included, or the combinations (K, s) of
            levels of each s coordinates in a row.
        inertia: that share, >= 0.
        stride: with a number above 1, which divides k - 1, every such level is tried first, and then those between the
            best of them and its neighbours, of which there are 2 (stride - 1). Only for levels of single coordinates.
        tried: the numbers of the groups that may change, counted from 0; None lets all of them.

    Returns:
        The action (N, m), whose objective is at least that of the given one, and how much each group that may change
        matters (N, g): the range of the objective over the levels that were tried and the given action.
    """
    levels = levels.reshape(len(levels), -1)
    size = levels.shape[1]
    groups = action.shape[-1] // size
    own = torch.eye(groups, dtype=torch.bool, device=action.device).repeat_interleave(size, 1)  # (g, m)
    parts = action.unflatten(-1, (groups, size)).movedim(-2, 0)  # (g, N, s)
    if tried is not None:
        own, parts = (torch.stack([entries[i] for i in tried]) for entries in (own, parts))
    before = objective(action)

    def placed(options: Tensor) -> Tensor:
        """Actions (g, *, N, m), each with an option (g, *, N, s) of its group and the others at the given action."""
        where = own.reshape(len(own), *[1] * (options.ndim - 2), -1)
        return torch.where(where, options.repeat(*[1] * (options.ndim - 1), groups), action)

    options = levels[::stride, None].expand(len(own), -1, len(action), -1)
    values = objective(placed(options))
    index, stakes = _preferred(values, before, options, parts, inertia)
    if stride > 1:
        steps = torch.arange(1, stride, device=action.device)
        beside = torch.cat([-steps, steps]).unsqueeze(-1)
        between = levels[(stride * index.unsqueeze(1) + beside).clamp(0, len(levels) - 1)]
        options = torch.cat([options, between], 1)
        values = torch.cat([values, objective(placed(between))], 1)
        index, stakes = _preferred(values, before, options, parts, inertia)
    top = values.gather(1, index.unsqueeze(1)).squeeze(1)
    best = options.gather(1, index[:, None, :, None].expand(-1, -1, -1, size)).squeeze(1)
    alone, which = top.max(0)
    moved = placed(torch.where((top > before).unsqueeze(-1), best, parts))
    together = torch.where(own.any(0), torch.where(own.unsqueeze(1), moved, 0).sum(0), action)
    single = moved.take_along_dim(which[None, :, None], 0).squeeze(0)
    return torch.where((objective(together) >= alone).unsqueeze(-1), together, single), stakes.mT


def best_bounds(objective: Objective, action: Tensor) -> tuple[Tensor, Tensor]:
    """The better of the two bounds of each coordinate while the others stand still, and how much it is better.

    Args:
        objective: the function to maximise, for actions (*, N, m), which is nearly affine in each coordinate.
        action: the action (N, m) at which the other coordinates stand still.

    Returns:
        The action (N, m) with all those bounds, and the range of the objective between the bounds of each coordinate
        (N, m), 0 where the objective has no number.
    """
    own = torch.eye(action.shape[-1], dtype=torch.bool, device=action.device)[:, None, None]
    bounds = torch.linspace(-1, 1, 2, dtype=action.dtype, device=action.device)[:, None, None]
    low, high = objective(torch.where(own, bounds, action)).movedim(1, 0).mT  # (N, m) each
    return torch.where(high > low, 1.0, -1.0).to(action), (high - low).abs().nan_to_num(0.0, 0.0, 0.0)


def _preferred(values: Tensor, before: Tensor, options: Tensor, parts: Tensor, inertia: float) -> tuple[Tensor, Tensor]:
    """The best option of each group after inertia (groups, N), and the range of the values (groups, N).

    Args:
        values: of the options (groups, k, N).
        before: the value (N,) of the given action.
        options: (groups, k, N, s).
        parts: the coordinates of the given action (groups, N, s).
        inertia: see `improved`.
    """
    distance = (options - parts.unsqueeze(1)).abs().amax(-1)
    penalty = inertia * distance * _ranges_between(values, before, options, parts)
    stakes = torch.maximum(values.amax(1), before) - torch.minimum(values.amin(1), before)
    return (values - penalty).argmax(1), stakes


def _ranges_between(values: Tensor, before: Tensor, options: Tensor, parts: Tensor) -> Tensor:
    """The range of the objective (groups, k, N) from the given action to each option; see `_preferred`.

    It is that over both and over all options in the box that has them as opposite corners.
    """
    given = parts.unsqueeze(1)
    low, high = (bound.unsqueeze(2) for bound in (torch.minimum(options, given), torch.maximum(options, given)))
    passed = options.unsqueeze(1)
    beside = ~((low <= passed) & (passed <= high)).all(-1)  # (groups, k, k, N)
    top, bottom = (values.unsqueeze(1).masked_fill(beside, far) for far in (-torch.inf, torch.inf))
    return torch.maximum(top.amax(2), before) - torch.minimum(bottom.amin(2), before)


def replaced(action: Tensor, column: int, level: Tensor | float) -> Tensor:
    """The action (N, m) with one coordinate replaced by a number."""
    changed = action.clone()
    changed[:, column] = level
    return changed
