"""One-dimensional reachability, Sec. V-A of the paper: a benchmark whose value is known in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box


class Reach1D(ReachAvoidProblem):
    """dX = u dt + dW with |u| <= 1: reach x >= 2 within T = 2 s. The optimal control is u = 1."""

    horizon = 2.0
    states = Box([-2.0], [2.0])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.ones_like(x).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 2.0 - x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The probability (*) that Brownian motion with unit drift passes 2 within tau.

        It is Phi((tau - d)/sqrt(tau)) + exp(2 d) Phi(-(tau + d)/sqrt(tau)) with d = 2 - x (Karatzas and Shreve,
        Brownian Motion and Stochastic Calculus, Sec. 3.5.C). The second term is computed with erfcx, so that neither of
        its factors overflows or underflows.
        """
        d = 2.0 - x[..., 0]
        outside = (d > 0) & (tau > 0)
        # Absorbed states and tau = 0 get other arguments, so that no NaN enters the gradient through torch.where.
        d_safe, tau_safe = torch.where(outside, d, torch.ones_like(d)), torch.where(outside, tau, torch.ones_like(tau))
        scale = torch.sqrt(2 * tau_safe)
        early, late = (d_safe - tau_safe) / scale, (d_safe + tau_safe) / scale
        value = (torch.special.erfc(early) + torch.exp(-(early**2)) * torch.special.erfcx(late)) / 2
        return torch.where(outside, value, (d <= 0).to(value.dtype))

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor:
        return torch.ones_like(x)
