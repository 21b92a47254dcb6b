"""One-dimensional reachability, Sec. V-A of the paper: a benchmark whose value is known in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.passages import first_passage
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
        """The probability (*) that Brownian motion with unit drift comes to 2 within tau."""
        return first_passage(tau, 2.0 - x[..., 0])

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor:
        return torch.ones_like(x)
