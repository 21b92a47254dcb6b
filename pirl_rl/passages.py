"""First passages: the probabilities that paths cross faces within a time, wherever they are at its end.

The level of a face is taken as Brownian motion with drift, whose first passage has a closed form. For paths whose end
is known, see `pirl_rl.crossings`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.crossings import Constraints, squared_noise

PIECES = 16
"""The number of pieces of a time, in each of which paths enter a set at its middle, see `entrance_probability`."""


def first_passage(tau: Tensor, distance: Tensor, drift: Tensor | float = 1.0, sigma: Tensor | float = 1.0) -> Tensor:
    """The probability (*) that drift * t + sigma W_t comes to a level at `distance` within tau.

    It is Phi((m tau - d)/(s sqrt(tau))) + exp(2 m d/s^2) Phi(-(m tau + d)/(s sqrt(tau))) with the distance d, the drift
    m and the strength s of the noise (Karatzas and Shreve, Brownian Motion and Stochastic Calculus, Sec. 3.5.C). The
    factors of the second term may overflow or underflow. Their product is therefore computed with erfcx, except where
    the drift leads so fast away from the level that exp(2 m d/s^2) is the small one.

    Args:
        tau: times (*), in s.
        distance: distances (*) to the level; the level counts as reached where they are not positive.
        drift: the drift (*) towards the level, in units of the distance per s.
        sigma: the strength (*) of the noise, above 0, in units of the distance per sqrt(s).
    """
    outside = (distance > 0) & (tau > 0)
    # Absorbed states and tau = 0 get other arguments, so that no NaN enters the gradient through torch.where.
    d_safe = torch.where(outside, distance, torch.ones_like(distance))
    tau_safe = torch.where(outside, tau, torch.ones_like(tau))
    scale = torch.sqrt(2 * tau_safe) * sigma
    early, late = (d_safe - drift * tau_safe) / scale, (d_safe + drift * tau_safe) / scale
    towards = torch.exp(-(early**2)) * torch.special.erfcx(late.clamp(min=0))
    away = torch.exp((2 * (drift / sigma) * (d_safe / sigma)).clamp(max=0)) * torch.special.erfc(late)
    value = (torch.special.erfc(early) + torch.where(late > 0, towards, away)) / 2
    return torch.where(outside, value, (distance <= 0).to(value.dtype))


def passage_probability(constraints: Constraints, x: Tensor, moved: Tensor, sigma: Tensor, h: Tensor) -> Tensor:
    """The probability (N, k) that paths cross each of k faces within the time h, wherever they are then.

    Each level is taken as Brownian motion with drift, see `first_passage`.

    Args:
        constraints: the levels of the faces.
        x: where the paths start (N, n). The probability is 1 for faces inside of which that is.
        moved: where they are after h without noise (N, n).
        sigma: (N, n, w) at x.
        h: the time (N,), in s.
    """
    level, way, deviation = _brownian_levels(constraints, x, moved, sigma, h)
    return first_passage(torch.ones_like(level), level, way, deviation)


def entrance_probability(
    target: Constraints, avoid: Constraints | None, x: Tensor, moved: Tensor, sigma: Tensor, h: Tensor
) -> Tensor:
    """The probability (N,) that paths from outside of A and B enter A within the time h, and not B before.

    A path enters A at a time at which it crosses one face for the first time, if no other level of A is positive then.
    The noise of different faces is taken as independent. With the probability F_k(t) of `first_passage` for a face k
    this is the sum over k of the integral of dF_k(t) prod_j P(level j <= 0 at t) prod_b (1 - F_b(t)), with j over the
    other faces of A and b over those of B. Paths that enter A at a later crossing of a face are left out, so that near
    a corner of A this is up to 0.05 too little.

    Args:
        target: the levels of A, all of which must be at most 0.
        avoid: the levels of B, one of which suffices, or None without B.
        x, moved, sigma, h: those of `passage_probability`.
    """
    level, way, deviation = _brownian_levels(target, x, moved, sigma, h)
    danger = None if avoid is None else _brownian_levels(avoid, x, moved, sigma, h)
    entered, crossed = torch.zeros_like(h), torch.zeros_like(level)
    for piece in range(PIECES):
        end, middle = (torch.full_like(level, (piece + share) / PIECES) for share in (1.0, 0.5))
        later = first_passage(end, level, way, deviation)
        inside = torch.special.ndtr((way * middle - level) / (deviation * middle.sqrt()))
        others = [inside[..., torch.arange(inside.shape[-1]) != k].prod(-1) for k in range(inside.shape[-1])]
        now = ((later - crossed) * torch.stack(others, -1)).sum(-1)
        if danger is not None:
            now = now * (1 - first_passage(torch.full_like(danger[0], (piece + 0.5) / PIECES), *danger)).prod(-1)
        entered, crossed = entered + now, later
    return entered


def _brownian_levels(
    constraints: Constraints, x: Tensor, moved: Tensor, sigma: Tensor, h: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The levels (N, k) at x, and in units of h their drift towards 0 and their deviation, each (N, k).

    Where the level at x is infinite or has no number the face is out of reach. The level is 1 there, or -1 deep inside,
    and stands still.
    """
    level, after = constraints(x), constraints(moved)
    variance = (squared_noise(constraints, x, sigma, level.shape[-1]) * h[..., None]).nan_to_num(0.0, 0.0)
    way, near = (level - after).nan_to_num(-torch.inf, torch.inf, -torch.inf), level.isfinite()
    way, variance = (torch.where(near, entry, 0.0) for entry in (way, variance))
    return level.nan_to_num(1.0, 1.0, -1.0), way, variance.sqrt().clamp(min=torch.finfo(x.dtype).tiny ** 0.5)
