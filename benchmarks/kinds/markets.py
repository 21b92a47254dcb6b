"""An endowment in a market whose noise comes and goes, and a granary that is filled when grain is cheap."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Endowment(ReachAvoidProblem):
    """Let wealth grow by a half, after spending, before it is halved; the control is the share that is invested.

    The variance of the market is the second state, after S. Heston, "A closed-form solution for options with stochastic
    volatility", 1993. Its noise is correlated with that of the market. The unit of time is a year.
    """

    horizon = 5.0
    states, controls = Box([0.4, 0.0], [1.6, 0.3]), Box([0.0], [1.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        wealth, variance = x.unbind(-1)
        return rows(wealth * (0.01 + 0.09 * u[..., 0]) - 0.04, 2 * (0.06 - variance))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        wealth, deviation = x[..., 0], x[..., 1].clamp(min=0.0025).sqrt()
        nothing = torch.zeros_like(wealth * u[..., 0])
        market = rows(wealth * u[..., 0] * deviation, nothing)
        return torch.stack([market, rows(-0.18 * deviation + nothing, 0.24 * deviation + nothing)], -2)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 1.5 - x[..., :1]

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., :1] - 0.5


class Granary(ReachAvoidProblem):
    """Fill a granary before money or grain is used up; the states are the price, grain and money."""

    horizon = 3.0
    states, controls = Box([0.2, 0.0, 0.0], [1.8, 1.1, 1.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        price, bought = x[..., 0], u[..., 0]
        return rows(1.5 * (1 - price), bought - 0.3, 0.42 - price * bought)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.5], [0.0], [0.0])

    def target_constraints(self, x: Tensor) -> Tensor:
        return 1 - x[..., 1:2]

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., 1:]
