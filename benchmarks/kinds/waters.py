"""A fjord, a drawbridge, a levee, a heated layer of water and a mined strait: way, moment or foresight decide."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Fjord(ReachAvoidProblem):
    """Row out of a winding fjord within 3 h, round two spits of land that are 0.1 km thick, against the wind.

    Places in km and speeds in km/h, along the fjord and across it.
    """

    horizon = 3.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.2, -1.2], [1.2, 1.2])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u + x.new_tensor([-0.3, 0.0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0], [0.0, 0.2])

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        along, across = x.unbind(-1)
        first = torch.maximum((along + 0.35).abs() - 0.05, across - 0.3)
        second = torch.maximum((along - 0.35).abs() - 0.05, -0.3 - across)
        shores = torch.minimum(1 - across.abs(), 1 + along)
        return torch.minimum(torch.minimum(first, second), shores)


class Drawbridge(ReachAvoidProblem):
    """Cross a canal within an hour and a quarter, and never be on the bridge while it is up for a part of each hour.

    The states are the place in km and the phase of the clock, the control is the speed in km/h.
    """

    horizon = 1.25
    states, controls = Box([0.0, -math.pi], [1.0, math.pi], periodic=[1]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(u[..., 0], torch.full_like(u[..., 0], 2 * math.pi))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.15], [0.0])

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        place, phase = x.unbind(-1)
        return torch.maximum((place - 0.5).abs() - 0.1, 0.3 - phase.cos())


class Levee(ReachAvoidProblem):
    """Keep a river below its levee and above the intakes for ten days, with a weir, while rain comes and goes.

    The states are the level in m and the logarithm of the inflow, the control opens the weir.
    """

    objective = "invariance"
    horizon = 10.0
    states, controls = Box([0.5, -2.0], [4.0, 2.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        level, rain = x.unbind(-1)
        return rows(0.4 * rain.exp() - (0.1 + 0.5 * u[..., 0]) * level.clamp(min=0).sqrt(), -0.5 * rain)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.6])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([x[..., 0] - 0.5, 4 - x[..., 0]], -1)


class Convection(ReachAvoidProblem):
    """Calm a layer of water that is heated from below, before it turns round: the equations of E. Lorenz (1963).

    The states are the circulation and the two differences of temperature, in his units; the control adds heat.
    The target surrounds one of the two steady circulations, which are unstable. States outside the box fail.
    """

    horizon = 1.2
    states, controls = Box([-10.0, -20.0, 5.0], [22.0, 28.0, 45.0]), Box([-40.0], [40.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        a, b, c = x.unbind(-1)
        return rows(10 * (b - a), a * (28 - c) - b + u[..., 0], a * b - 8 * c / 3)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [1.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0])

    def target_level(self, x: Tensor) -> Tensor:
        return (x - x.new_tensor([72**0.5, 72**0.5, 27.0])).norm(dim=-1) - 3

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - x.new_tensor(self.states.low), x.new_tensor(self.states.high) - x], -1)


class Minefield(ReachAvoidProblem):
    """Cross a strait of 10 km within 14 h, past nine mines, in a current that turns; km and km/h."""

    horizon = 14.0
    states, controls = Box([0.0, 0.0], [10.0, 10.0]), Box([-1.2, -1.2], [1.2, 1.2])
    MINES = ((2.0, 1.5), (2.2, 4.4), (2.0, 7.6), (5.0, 3.0), (5.2, 5.9), (4.9, 8.8), (7.6, 1.6), (7.9, 4.5), (7.7, 7.4))

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        along, across = (math.pi * x / 10).unbind(-1)
        return u + 0.4 * rows(-across.cos(), along.cos())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.35, 0.0], [0.0, 0.35])

    def target_level(self, x: Tensor) -> Tensor:
        return 10 - x[..., 0]

    def avoid_constraints(self, x: Tensor) -> Tensor:
        mines = (x.unsqueeze(-2) - x.new_tensor(self.MINES)).norm(dim=-1) - 0.7
        return torch.cat([mines, x, 10 - x[..., 1:]], -1)
