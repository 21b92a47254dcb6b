"""Descent of level functions, which finds points of a set that is too thin to be hit by sampling, and its faces."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.sets import Box

STEPS = 400
"""The number of steps of a descent that finds thin sets."""

FEWER_STEPS = 100
"""The number of steps that suffice where a set is not thin, and its parts are looked for."""

MOST_PARTS = 16
"""The number of parts of a union from which each of them has fewer descents, so that all together have no more."""

FIRST, LAST = 0.05, 1e-6
"""Sizes of the first and the last of `STEPS` steps, in coordinates in which the box is [-1, 1]^n."""

BISECTIONS = 50
"""The number of halvings of a segment between a point inside a set and one outside; enough for double precision."""


def descended(constraints: Callable[[Tensor], Tensor], x: Tensor, box: Box, steps: int = STEPS) -> Tensor:
    """Points (N, n) where the largest of several levels is low, found by Adam from the states x (N, n).

    They stay within a box twice as wide as `box`, and need not lie in the set.

    Args:
        constraints: the levels (N, k) at states (N, n), differentiable; all of them are <= 0 in the set.
        x: where the descent starts.
        box: gives the scale of the steps.
        steps: their number; the fewer, the longer is each, so that all together lead as far.
    """

    z = box.normalize(x).clone().requires_grad_()
    optimizer = torch.optim.Adam([z], lr=FIRST * STEPS / steps)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (LAST / FIRST) ** (1 / steps))
    for _ in range(steps):
        with torch.enable_grad():
            # The second term gives a level that is constant everywhere its slope of 0.
            level = constraints(box.wrap(box.denormalize(z))).amax(-1).sum() + 0 * z.sum()
            (slope,) = torch.autograd.grad(level, z)
        # Where the level has no slope, as where it is infinite, the last steps lead on.
        z.grad = slope.nan_to_num(0.0, 0.0, 0.0)
        optimizer.step()
        decay.step()
        with torch.no_grad():
            z.clamp_(-2, 2)
    return box.wrap(box.denormalize(z.detach()))


def descended_parts(levels: Callable[[Tensor], Tensor], own: Tensor, x: Tensor, box: Box, steps: int = STEPS) -> Tensor:
    """The ends (parts, N, n) of `descended` for each part of a set from states (parts, N, n), all parts at once.

    Args:
        levels: the levels (M, k) of all parts at states (M, n), differentiable.
        own: which of them each part has (parts, k), bool; all of these are <= 0 in the part.
        x: where the descents of each part start.
        box: gives the scale of the steps.
        steps: their number.
    """
    others = ~own.repeat_interleave(x.shape[1], 0)
    ends = descended(lambda y: levels(y).masked_fill(others, -torch.inf), x.flatten(0, 1), box, steps)
    return ends.unflatten(0, x.shape[:2])


def starts_of_a_part(wanted: int, parts: int) -> int:
    """The number of descents of each part of a set: the wanted one, or fewer where the set has more parts than
    `MOST_PARTS`."""
    return min(wanted, max(1, MOST_PARTS * wanted // parts))


def bisected(absorbs: Callable[[Tensor], Tensor], inside: Tensor, outside: Tensor) -> Tensor:
    """The points (N, n) at which the segments from points inside a set to points outside leave it.

    Args:
        absorbs: whether states (N, n) are in the set, (N,) bool.
        inside: states (N, n) in the set.
        outside: states (N, n) that are not.
    """
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        held = absorbs(middle).unsqueeze(-1)
        inside, outside = torch.where(held, middle, inside), torch.where(held, outside, middle)
    return inside
