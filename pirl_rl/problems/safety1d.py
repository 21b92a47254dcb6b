"""One-dimensional invariance, Remark 1 of the paper: the largest probability to stay inside an interval."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box


class Safety1D(ReachAvoidProblem):
    """dX = u dt + dW with |u| <= 1: stay in |x| < 1 for T = 2 s. The optimal control is u = -sign(x)."""

    objective = "invariance"
    horizon = 2.0
    states = Box([-1.0], [1.0])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.ones_like(x).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([1.0 - x, 1.0 + x], -1)

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor:
        return -torch.sign(x)
