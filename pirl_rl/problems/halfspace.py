"""Reachability of a half-space in n dimensions, a benchmark of any dimension whose value is known in closed form.

Along the normal of the half-space the best state is a Brownian motion with drift, so its first passage (Karatzas and
Shreve, Brownian Motion and Stochastic Calculus, Sec. 3.5.C) is the value.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.errors import ArgumentError
from pirl_rl.passages import first_passage
from pirl_rl.payoffs import Payoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box, Plane


class HalfSpace(ReachAvoidProblem):
    """dX = u dt + dW in R^n with |u_i| <= 1/sqrt(n): reach a . x >= 1 within T = 1 s. The optimal u has a's signs.

    The normal a has length 1 and entries of both signs in the ratios 1 : -2 : 3 : -1 : 2 : -3 : ..., so that no two
    neighbouring coordinates play the same part. Both V and the spread of a . x over the box hardly depend on n.

    Args:
        payoff: replaces the indicator of the target.
        horizon: replaces the horizon, in s.
        dim: the number n of states and controls, at least 1.

    Attributes:
        normal: the entries of a, n numbers.
        speed: the drift of a . X under the optimal control, in units of x per s.

    Raises:
        ArgumentError: `dim` is not an integer of at least 1.
    """

    horizon = 1.0
    offset = 1.0

    def __init__(self, payoff: Payoff | None = None, horizon: float | None = None, dim: int = 2):
        super().__init__(payoff, horizon)
        if not (isinstance(dim, int) and dim >= 1):
            raise ArgumentError(f"HalfSpace.dim: expected an integer >= 1, got {dim!r}")
        self.states = Box([-1.5] * dim, [1.5] * dim)
        self.controls = Box([-1 / math.sqrt(dim)] * dim, [1 / math.sqrt(dim)] * dim)
        ratios = [(-1.0) ** i * (1 + i % 3) for i in range(dim)]
        self.normal = tuple(ratio / math.hypot(*ratios) for ratio in ratios)
        self.speed = sum(map(abs, self.normal)) / math.sqrt(dim)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.eye(x.shape[-1], dtype=x.dtype, device=x.device).expand(*x.shape, x.shape[-1])

    def target_level(self, x: Tensor) -> Tensor:
        return self.offset - (x * constant(self.normal, x)).sum(-1)

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The probability (*) that Brownian motion with drift `speed` covers the distance to the half-space in tau."""
        return first_passage(tau, self.target_level(x), self.speed)

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor:
        return (constant(self.normal, x).sign() / math.sqrt(x.shape[-1])).expand_as(x)

    @property
    def planes(self) -> dict[str, Plane]:
        """The section through the origin that the normal and one direction across it span; none in one dimension."""
        dim = self.states.dim
        if dim == 1:
            return {}
        first, second = self.normal[:2]
        across = [value / math.hypot(first, second) for value in (-second, first, *[0.0] * (dim - 2))]
        basis = torch.tensor([self.normal, across], dtype=torch.float64)
        section = Plane(
            ("along the normal", "across the normal"),
            Box([-1.5, -1.5], [1.5, 1.5]),
            lambda points: points @ basis.to(points),
            lambda x: x @ basis.mT.to(x),
        )
        return {"normal": section}
