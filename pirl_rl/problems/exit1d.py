"""Exit of Brownian motion with controlled drift from an interval at the right end, in one dimension.

The law of the exit is that of Karatzas and Shreve, Brownian Motion and Stochastic Calculus, Secs. 2.8.C and 3.5.C.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.passages import first_passage
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box

IMAGES = 8
"""The number of pairs of images in the exact value; those that are left out are below 2e-14 for every tau."""


class Exit1D(ReachAvoidProblem):
    """dX = u dt + dW with |u| <= 1: reach x >= 1 before x <= -1 within T = 1 s. The optimal control is u = 1."""

    horizon = 1.0
    states = Box([-1.0], [1.0])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.ones_like(x).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 1.0 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return 1.0 + x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The probability (*) that Brownian motion with unit drift comes to 1 within tau and before -1.

        By the method of images it is the sum over all integers k of sign(D) exp(d - |D|) F(tau, |D|) with d = 1 - x,
        D = d + 4 k and the first-passage probability F of `first_passage`. The eigenfunctions sin(l (x + 1)) with
        l = k pi/2 give another series of the same value, which converges slowly for small tau:

            (1 - exp(-2 x - 2))/(1 - exp(-4)) + exp(1 - x) sum_k (-1)^k l/(1 + l^2) sin(l (x + 1)) exp(-(1 + l^2) tau/2)
        """
        distance = 1.0 - x[..., 0]
        inside = (distance > 0) & (distance < 2)
        d = torch.where(inside, distance, torch.ones_like(distance))
        value = first_passage(tau, d)
        for k in range(1, IMAGES + 1):
            far, mirrored = d + 4 * k, 4 * k - d
            value = value + torch.exp(d - far) * first_passage(tau, far)
            value = value - torch.exp(d - mirrored) * first_passage(tau, mirrored)
        return torch.where(inside, value, (distance <= 0).to(value.dtype))

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor:
        return torch.ones_like(x)
