"""A cold store, a fire, a patient and an island: control against a demand or a growth that wanders."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class VaccineStock(ReachAvoidProblem):
    """Keep a cold store neither empty nor over-full for 30 days by deliveries; in thousands of doses and days.

    Demand is 2 a day, 4 % a day spoil, and withdrawals are the more erratic the more there is on the shelf.
    """

    objective = "invariance"
    horizon = 30.0
    states, controls = Box([2.0], [20.0]), Box([0.0], [5.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u - 2.0 - 0.04 * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (2.0 + 0.15 * x.clamp(min=0.0)).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - 2.0, 20.0 - x], -1)


class Backburn(ReachAvoidProblem):
    """Drive a fire front 4 km away from a village by burning back, which also throws sparks; in km and hours.

    A harder burn gains ground up to a point, and its noise grows with the control.
    """

    horizon = 10.0
    states, controls = Box([0.0], [4.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return -0.4 + 1.6 * u - 1.1 * u.square()

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.15 + 1.2 * u**3).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 4.0 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., 0]


class ChemoWard(ReachAvoidProblem):
    """Shrink a tumour to 1 cm^3 in 8 weeks without severe neutropenia, where target and avoid set touch.

    States are the logarithm of the volume and neutrophils in 1e9/l. The two controls are the dose of chemotherapy, and
    a growth factor for neutrophils that also feeds the tumour.
    """

    horizon = 8.0
    states, controls = Box([0.0, 0.5], [4.0, 5.0]), Box([0.0, 0.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        volume, cells = x.unbind(-1)
        dose, factor = u.unbind(-1)
        growth = 0.08 * (5.0 - volume) + 0.15 * factor - 0.7 * dose
        return rows(growth, (0.5 + 0.5 * factor) * (4.0 - cells) - 2.2 * dose * cells)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        cells = 0.8 * x[..., 1].clamp(min=0.1).sqrt()
        return torch.diag_embed(rows(torch.full_like(cells, 0.5), cells))

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0], 0.5 - x[..., 1])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 1] - 0.5, 4.0 - x[..., 0])


class IslandGrid(ReachAvoidProblem):
    """Keep a battery between 10 and 110 kWh for 24 h with a diesel set, while the wind power wanders; in kW and kWh.

    Only the wind is noisy. Charging and discharging lose 10 % each, so that the drift has a kink.
    """

    objective = "invariance"
    horizon = 24.0
    states, controls = Box([10.0, -40.0], [110.0, 40.0]), Box([0.0], [40.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        wind = x[..., 1]
        surplus = wind - 20.0 + u[..., 0]
        return rows(torch.where(surplus > 0, 0.9 * surplus, surplus / 0.9), -0.3 * wind)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [15.0])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0] - 10.0, 110.0 - x[..., 0])
