"""Rooms, a patient, a lake and a game reserve: what is in several compartments must stay or come between limits."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Anaesthesia(ReachAvoidProblem):
    """Keep a drug in three compartments of a patient within safe limits; mg/l, minutes, and an infusion in mg/min.

    After the anaesthesia benchmark of the ARCH competition (A. Abate and others, ARCH-COMP18: Stochastic Modelling).
    """

    objective = "invariance"
    horizon = 10.0
    states, controls = Box([1.5, 1.0, 1.0], [3.5, 5.0, 5.0]), Box([0.0], [30.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        blood, muscle, fat = x.unbind(-1)
        gain = -(0.4436 + 0.1140 + 0.0419) * blood + 0.1140 * muscle + 0.0419 * fat + u[..., 0] / 16.044
        return rows(gain, 0.0550 * (blood - muscle), 0.0033 * (blood - fat))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.6, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.2])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - x.new_tensor([1.5, 1.0, 1.0]), x.new_tensor([3.5, 5.0, 5.0]) - x], -1)


class Rooms(ReachAvoidProblem):
    """Warm two rooms to 20 to 23 degrees within 30 min by one heater, whose fan blows to one or the other; kW, minutes.

    Rooms must stay below 25 degrees and the heater below 75, also where the rooms are comfortable: the sets overlap.
    """

    horizon = 30.0
    states, controls = Box([14.0, 14.0, 20.0], [25.0, 25.0, 75.0]), Box([0.0, 0.0], [4.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        first, second, heater = x.unbind(-1)
        power, share = u.unbind(-1)
        one, other = 0.08 * share * (heater - first), 0.08 * (1 - share) * (heater - second)
        between = 0.03 * (second - first)
        warming = rows(one + between - 0.06 * (first - 5), other - between - 0.06 * (second - 5)) / 10
        return torch.cat([warming, (power - one - other).unsqueeze(-1)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.5])

    def target_constraints(self, x: Tensor) -> Tensor:
        first, second = x[..., 0], x[..., 1]
        return rows(20 - first, first - 23, 20 - second, second - 23)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x.new_tensor([25.0, 25.0, 75.0]) - x


class LotkaVolterra(ReachAvoidProblem):
    """Keep prey and predators (thousands) above 0.2 for six years by fishing, mostly of predators; geometric noise."""

    objective = "invariance"
    horizon = 6.0
    states, controls = Box([0.2, 0.2], [2.5, 2.5]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        prey, predators = x.unbind(-1)
        effort = u[..., 0]
        return rows(prey * (1 - predators - 0.1 * effort), predators * (prey - 1 - 0.5 * effort))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(0.25 * x)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 0.2


class LynxAndHare(ReachAvoidProblem):
    """Both populations of a game reserve must stay between extinction and pest for eight years by culling, per year.

    The states are hares per square kilometre and lynx per ten square kilometres.
    """

    objective = "invariance"
    horizon = 8.0
    states, controls = Box([30.0, 5.0], [260.0, 32.0]), Box([0.0, 0.0], [0.7, 0.7])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        hares, lynx = x.unbind(-1)
        eaten = 12.0 * hares / (90.0 + hares.clamp(min=0.0))
        growth = 1.6 * hares * (1.0 - hares / 400.0) - eaten * lynx - u[..., 0] * hares
        return rows(growth, (0.1 * eaten - 0.35 - u[..., 1]) * lynx)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(x * x.new_tensor([0.4, 0.24]))

    def avoid_constraints(self, x: Tensor) -> Tensor:
        hares, lynx = x.unbind(-1)
        return rows((hares - 30.0) / 230.0, (260.0 - hares) / 230.0, (lynx - 5.0) / 27.0, (32.0 - lynx) / 27.0)


class HerdImmunity(ReachAvoidProblem):
    """End an epidemic at 30 % susceptible before more than 5 % are infected at once; in percent and days.

    The controls are the share of contacts that is avoided and the rate of vaccination. Infections in clusters make
    noise that grows with the contacts.
    """

    horizon = 100.0
    states, controls = Box([30.0, 0.05], [85.0, 5.0]), Box([0.0, 0.0], [0.8, 0.005])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        contacts = self._contacts(x, u)
        vaccinated, recovered = u[..., 1] * x[..., 0], 0.1 * x[..., 1]
        return rows(-0.35 * contacts - vaccinated, 0.35 * contacts - recovered)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        clusters = 0.9 * self._contacts(x, u)
        return rows(-clusters, clusters).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows((x[..., 0] - 30) / 55, (x[..., 1] - 5) / 5)

    def avoid_level(self, x: Tensor) -> Tensor:
        return (5 - x[..., 1]) / 5

    @staticmethod
    def _contacts(x: Tensor, u: Tensor) -> Tensor:
        return (1 - u[..., 0]) * x[..., 0] * x[..., 1] / 100
