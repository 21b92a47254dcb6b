"""The first passage of Brownian motion with drift, from which the exact values of several problems follow."""

from __future__ import annotations

import torch
from torch import Tensor


def first_passage(tau: Tensor, distance: Tensor, drift: float = 1.0, sigma: float = 1.0) -> Tensor:
    """The probability (*) that drift * t + sigma W_t comes to a level at `distance` within tau.

    It is Phi((m tau - d)/(s sqrt(tau))) + exp(2 m d/s^2) Phi(-(m tau + d)/(s sqrt(tau))) with the distance d, the drift
    m and the strength s of the noise (Karatzas and Shreve, Brownian Motion and Stochastic Calculus, Sec. 3.5.C). The
    second term is computed with erfcx, so that neither of its factors overflows or underflows.

    Args:
        tau: times (*), in s.
        distance: distances (*) to the level; the level counts as reached where they are not positive.
        drift: the drift towards the level, at least 0, in units of the distance per s.
        sigma: the strength of the noise, above 0, in units of the distance per sqrt(s).
    """
    outside = (distance > 0) & (tau > 0)
    # Absorbed states and tau = 0 get other arguments, so that no NaN enters the gradient through torch.where.
    d_safe = torch.where(outside, distance, torch.ones_like(distance))
    tau_safe = torch.where(outside, tau, torch.ones_like(tau))
    scale = torch.sqrt(2 * tau_safe) * sigma
    early, late = (d_safe - drift * tau_safe) / scale, (d_safe + drift * tau_safe) / scale
    value = (torch.special.erfc(early) + torch.exp(-(early**2)) * torch.special.erfcx(late)) / 2
    return torch.where(outside, value, (distance <= 0).to(value.dtype))
