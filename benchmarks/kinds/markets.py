"""An endowment, a pair of shares, a granary and a hedge: to gain or to fill something before means are used up."""

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


class PairTrade(ReachAvoidProblem):
    """Gain a quarter of the means before a quarter is lost, by trading on a spread of prices that comes back to 0.

    The states are the spread and the means, the control is how much of the spread is held, bought or sold. The same
    noise moves both states, and it grows with the control.
    """

    horizon = 1.0
    states, controls = Box([-1.0, 0.7], [1.0, 1.3]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        back = -2 * x[..., 0]
        return rows(back, u[..., 0] * back)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        held = u[..., 0]
        return 0.6 * rows(torch.ones_like(x[..., 0] * held), held + 0 * x[..., 0]).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 1.25 - x[..., 1:]

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., 1:] - 0.75


class Hedge(ReachAvoidProblem):
    """Reach a wealth of 1.5 before 0.6 within two years, with a stock whose volatility wanders.

    The states are wealth and volatility, whose shocks are correlated. The control is the share of the wealth that is in
    the stock, up to 2.
    """

    horizon = 2.0
    states, controls = Box([0.4, 0.05], [2.0, 0.6]), Box([0.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        wealth, volatility = x.unbind(-1)
        return rows(wealth * (0.02 + 0.12 * u[..., 0]), 2 * (0.2 - volatility))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        wealth, volatility = x.unbind(-1)
        gain = rows(u[..., 0] * volatility * wealth, torch.zeros_like(wealth))
        return torch.stack([gain, rows(-0.2 * volatility, 0.25 * volatility)], -2)

    def target_level(self, x: Tensor) -> Tensor:
        return 1.5 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., 0] - 0.6
