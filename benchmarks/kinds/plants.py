"""Stocks, tanks and populations: noise that depends on the state, sets far from symmetric."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class TwoTanks(ReachAvoidProblem):
    """Keep the levels of two tanks, of which one flows into the other, within bounds; noise grows with the level."""

    objective = "invariance"
    horizon = 4.0
    states, controls = Box([0.1, 0.1], [1.0, 1.0]), Box([0.0, 0.0], [0.5, 0.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        flow = x.clamp(min=1e-3).sqrt()
        return u + rows(-0.3 * flow[..., 0], 0.3 * flow[..., 0] - 0.35 * flow[..., 1])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(0.05 + 0.2 * x)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - 0.2, 0.9 - x], -1)


class Reservoir(ReachAvoidProblem):
    """Let a stock with logistic growth and geometric noise recover before it collapses; the control harvests it."""

    horizon = 5.0
    states, controls = Box([0.0], [3.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.8 * x * (1 - x / 2) - u * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.35 * x).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 2.4 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 0.3


class Tokens(ReachAvoidProblem):
    """Grow a stock into a band far from where it is lost; the noise grows with the root of the stock."""

    horizon = 8.0
    states, controls = Box([0.0], [10.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.4 * x * (u - 0.2) * (1 - x / 12)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.4 * x.clamp(min=1e-6).sqrt()).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return (x - 7.5).abs() - 0.5

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 0.4


class Epidemic(ReachAvoidProblem):
    """Keep the infected of an SIR model below the number of beds by keeping people apart; correlated noise, days."""

    objective = "invariance"
    horizon = 60.0
    states, controls = Box([0.2, 0.0], [1.0, 0.12]), Box([0.0], [0.6])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        susceptible, infected = x.unbind(-1)
        new = 0.3 * (1 - u[..., 0]) * susceptible * infected
        return rows(-new, new - 0.1 * infected)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        susceptible, infected = x.clamp(min=0).unbind(-1)
        contacts = 0.05 * susceptible * infected
        return torch.stack([rows(-contacts, contacts), rows(torch.zeros_like(infected), 0.06 * infected)], -1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 0.1 - x[..., 1:]


class Toggle(ReachAvoidProblem):
    """Flip a switch of two genes that repress each other by giving inducers of both."""

    horizon = 6.0
    states, controls = Box([0.0, 0.0], [3.0, 3.0]), Box([0.0, 0.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        one, other = x.clamp(min=0).unbind(-1)
        return rows(2.5 / (1 + other**3) + u[..., 0] - one, 2.5 / (1 + one**3) + u[..., 1] - other)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(0.15 + 0.1 * x.clamp(min=0))

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(2.0 - x[..., 0], x[..., 0] - 2.9, x[..., 1] - 0.7)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(3.0 - x[..., 0], 3.2 - x[..., 1])


class Investor(ReachAvoidProblem):
    """Reach a sum before ruin; the control is the share of the money that is at risk, up to three times of it."""

    horizon = 4.0
    states, controls = Box([0.2], [2.0]), Box([0.0], [3.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return x * (0.02 + 0.1 * u)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (x * (0.02 + 0.25 * u)).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 1.5 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 0.5


class Reactor(ReachAvoidProblem):
    """Bring a stirred reactor to its middle, unstable state without a runaway; conversion and temperature, scaled."""

    horizon = 6.0
    states, controls = Box([0.0, 0.0], [1.0, 6.0]), Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        conversion, heat = x.unbind(-1)
        rate = 0.072 * (1 - conversion) * torch.exp(heat / (1 + heat / 20))
        return rows(-conversion + rate, -1.3 * heat + 8 * rate + 0.6 * u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.05, 0.0], [0.0, 0.35])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows((x[..., 0] - 0.447).abs() - 0.06, (x[..., 1] - 2.75).abs() - 0.35)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 5 - x[..., 1:]
