"""Crossings of faces between both ends of an integration step, where the path is a Brownian bridge.

A bridge crosses a smooth face g = 0 with the probability exp(-2 g0 g1 / (|sigma^T grad g|^2 h)) of Eq. (bridge), where
g0 and g1 are the levels at both ends, and sigma and grad g are taken at the start. This is exact for constant
coefficients and a flat face (E. Gobet, Stochastic Processes and their Applications 87, 2000).

A curved face is nearer or farther than its tangent says, and where a path goes closely past a set there may be none.
So the level is looked at once more, at the zero of the tangent of the decisive face. On the way there it is the
parabola g(t) = g0 (1 - t + b t^2), with t from 0 to 1 and b = g(1) / g0. With B = sqrt(1 - 4 b) and
A = sqrt(1 - 4 b + 4 b g1 / g0) its first zero is at t = 2 / (1 + B), and it has the level g1 at the distance
2 g1 / (g0 (A + B)) before that. In the exponent these two take the places of 1 and g1 / g0. For b >= 1/4 there is no
zero, and the face is not crossed. Decisive is the nearest face where one is enough, and the farthest where all must be
crossed, in units of the noise of their levels.

Without the ends, crossings within a time have the law of Brownian motion with drift, see `pirl_rl.passages`.

A path enters an intersection of several sets, such as a box, at the time at which it crosses the last face, if no other
level is positive then, see `enters_intersection`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from pirl_rl.sigma import times, transposed_times

Constraints = Callable[[Tensor], Tensor]
"""Maps states (N, n) to the levels (N, k) of k faces."""

Decisive = Literal["nearest", "farthest"]
"""Which of several faces decides: the nearest for a union of sets, the farthest for an intersection."""

LEAST_BEND = -2.0
"""The smallest b: a face lies at least half as far away as its tangent says."""

SMALLEST = 1e-12
"""The smallest product of both levels of a bridge, in units of its variance, with which a time of crossing is drawn."""


def crossing_probability(
    constraints: Constraints, x: Tensor, moved: Tensor, sigma: Tensor, h: Tensor, decisive: Decisive
) -> Tensor:
    """The probability (N, k) that bridges are inside of each of k faces at some time, 1 where one of the ends is.

    Args:
        constraints: the levels of the faces.
        x, moved: both ends of the bridges (N, n).
        sigma: (N, n, w) at x.
        h: the time between the ends (N,), in s.
        decisive: the face whose curvature counts.
    """
    level, after, variance = _bridge(constraints, x, moved, sigma, h, decisive)
    # An infinite level is out of reach, and an infinite slope gives no tangent.
    return _chance(level, after, torch.where((level < torch.inf) & variance.isfinite(), variance, 0.0))


def crosses_any(
    constraints: Constraints, x: Tensor, moved: Tensor, sigma: Tensor, h: Tensor, uniform: Tensor
) -> Tensor:
    """Whether bridges with both ends outside cross one of k faces, (N,) bool.

    The faces are drawn independently of each other.

    Args:
        constraints: the levels of the faces.
        x, moved: both ends of the bridges (N, n).
        sigma: (N, n, w) at x.
        h: the time between the ends (N,), in s.
        uniform: uniform random numbers (N, k).
    """
    return (uniform < _probability(*_bridge(constraints, x, moved, sigma, h, "nearest"))).any(-1)


def enters_intersection(
    constraints: Constraints,
    x: Tensor,
    moved: Tensor,
    sigma: Tensor,
    h: Tensor,
    uniform: Tensor,
    normal: Tensor | None,
) -> Tensor:
    """Whether bridges from outside enter the set in which all k constraints hold, (N,) bool.

    To enter it, a path must cross every face outside of which it is. The times at which it crosses each of them for the
    first time are drawn from their law. At the last of these times the levels of all other faces are drawn: those of
    faces that were crossed start at 0 at their own time of crossing, and those of the others where they were. If none
    of them is positive, the path has entered. Else the rest of the step is drawn in the same way. A path that has not
    entered after R attempts is outside. The noise of different faces is taken as independent.

    Args:
        constraints, x, moved, sigma, h: those of `crosses_any`.
        uniform: uniform random numbers (R, N, k).
        normal: standard normal numbers (R, 2, N, k); with one constraint and one attempt they are not needed.
    """
    level, after, variance = _bridge(constraints, x, moved, sigma, h, "farthest")
    if normal is None:
        return (uniform[0] < _chance(level, after, variance)).all(-1)
    entered = torch.zeros_like(level[..., 0], dtype=torch.bool)
    may_enter, limits = ~entered, torch.finfo(x.dtype)
    for drawn, (timing, noise) in zip(uniform.unbind(), normal.unbind(), strict=True):
        outside, chance = level > 0, _chance(level, after, variance)
        may_enter = may_enter & (drawn < chance).all(-1)
        # Where a draw is below the chance, their ratio is uniform again.
        first = _crossing_time(level, after, variance, drawn / chance.clamp(min=limits.tiny), timing)
        start, level = torch.where(outside, first, 0.0), torch.where(outside, 0.0, level)
        last = start.amax(-1, keepdim=True)
        share = (last - start) / (1 - start).clamp(min=limits.eps)
        spread = (share * (1 - last) * variance).clamp(min=0).sqrt()
        # The share of the face that was crossed last is 0, so that its level is exactly 0.
        level, variance = level + share * (after - level) + spread * noise, variance * (1 - last)
        entered = entered | (may_enter & (level <= 0).all(-1))
    return entered


def _chance(before: Tensor, after: Tensor, variance: Tensor) -> Tensor:
    """The probability (N, k) that a bridge is inside of a face at some time, 1 where it is inside at one end.

    It is 0 where a level has no number, as a state is in no set there.
    """
    inside = ((before <= 0) | (after <= 0)).to(after)
    return torch.where((before > 0) & (after > 0), _probability(before, after, variance), inside)


def _crossing_time(before: Tensor, after: Tensor, variance: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
    """The time (N, k), as a share of the step, at which bridges first cross their face, Eq. (crossing_time).

    By reflection only |after| matters. With a = before, b = |after| and the variance v over the step, s / (1 - s) has
    the inverse Gaussian distribution with the mean a / b and the shape a^2 / v. It is drawn by the method of J.
    Michael, W. Schucany and R. Haas (The American Statistician 30, 1976). Without noise s is a / (a + b).
    """
    a, b = before.abs(), after.abs()
    product = torch.maximum(a * b, SMALLEST * variance).clamp(min=torch.finfo(a.dtype).tiny)
    z = variance * normal.square() / (2 * product)
    root = 1 + z + (z * (z + 2)).sqrt()
    b = torch.where(uniform * (1 + root) <= root, b * root, b / root)
    return a / (a + b).clamp(min=torch.finfo(a.dtype).tiny)


def _bridge(
    constraints: Constraints, x: Tensor, moved: Tensor, sigma: Tensor, h: Tensor, decisive: Decisive
) -> tuple[Tensor, ...]:
    """The levels (N, k) at both ends, and their variance (N, k) over the time h (N,).

    The variance of the decisive face is that with which its tangent has the chance of the curved face.
    """
    before, after = constraints(x), constraints(moved)
    rates = _rates(constraints, x, sigma, before.shape[-1])
    squared = rates.square().sum(-1)
    crossable = (before > 0) & (squared > 0)
    to_tangent = torch.where(crossable, before / squared, 0.0)
    distance = before * to_tangent
    if decisive == "nearest":
        face = torch.where(crossable, distance, torch.inf).argmin(-1, keepdim=True)
    else:
        face = torch.where(crossable, distance, -torch.inf).argmax(-1, keepdim=True)
    way = times(sigma, (rates * to_tangent[..., None]).take_along_dim(face[..., None], -2).squeeze(-2))
    start, end, chosen = (part.gather(-1, face) for part in (before, after, crossable))
    bend = constraints(x - way).gather(-1, face) / start
    bend = torch.where(bend.isfinite(), bend, 0.0).clamp(min=LEAST_BEND)
    root = (1 - 4 * bend).clamp(min=0)
    at_end = (root + 4 * bend * (end / start).abs()).clamp(min=0).sqrt()
    nearer = torch.where(root > 0, (1 + root.sqrt()) * (at_end + root.sqrt()) / 4, 0.0)
    # Where the path starts inside of the face, or its level has no noise, there is no tangent.
    nearer = torch.where(chosen & nearer.isfinite(), nearer, 1.0)
    return before, after, squared * torch.ones_like(squared).scatter(-1, face, nearer) * h[..., None]


def _probability(before: Tensor, after: Tensor, variance: Tensor) -> Tensor:
    """Eq. (bridge) where both ends are outside, else 0; all arguments are (N, k)."""
    # Where the variance is 0, the exponent is NaN or infinite, and the face is not crossed between the ends.
    between = (variance > 0) & (before > 0) & (after > 0)
    return torch.where(between, (-2 * before * after / variance).exp(), torch.zeros_like(before))


def squared_noise(constraints: Constraints, x: Tensor, sigma: Tensor, count: int) -> Tensor:
    """|sigma^T grad g|^2 (N, k) of k = `count` constraints g at x (N, n), by the fewer of w and k derivatives.

    Args:
        constraints: the levels g of the faces.
        x: states (N, n).
        sigma: (N, n, w) at x.
        count: the number k.
    """
    return _rates(constraints, x, sigma, count).square().sum(-1)


def _rates(constraints: Constraints, x: Tensor, sigma: Tensor, count: int) -> Tensor:
    """sigma^T grad g (N, k, w) of `squared_noise`."""
    if sigma.shape[-1] <= count:
        along = [torch.func.jvp(constraints, (x,), (column,))[1] for column in sigma.unbind(-1)]
        return torch.stack(along, -1)
    slopes = [torch.func.grad(lambda y, i=i: constraints(y)[..., i].sum())(x) for i in range(count)]
    return torch.stack([transposed_times(sigma, slope) for slope in slopes], -2)
