"""A bird, yeast, a battery and a stock of fish: something is stored against time."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import rows
from pirl_rl import Box, ReachAvoidProblem


class Forager(ReachAvoidProblem):
    """A small bird stores 30 kJ for the night before it starves; the bolder it feeds, the more noise; in kJ and h."""

    horizon = 10.0
    states, controls = Box([0.0], [32.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        heavy = 0.8 * (x > 24).to(x)  # a fat bird has to fly from hawks more often: a jump
        return 6.4 * u - 5.4 * u.square() - 1.0 - 0.01 * x - heavy

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.6 + 3.6 * u).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 30 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 3


class Ferment(ReachAvoidProblem):
    """Grow yeast to 25 g/l by feeding sugar, of which there must be neither too little nor too much; in g/l and h."""

    horizon = 5.0
    states, controls = Box([2.0, 0.0], [26.0, 18.0]), Box([0.0], [0.16])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        cells, sugar = x[..., 0], x[..., 1].clamp(min=0)
        growth = 0.4 * sugar / (0.3 + sugar + sugar.square() / 8)  # Haldane, 1/h
        feed = u[..., 0]
        return rows((growth - feed) * cells, feed * (100 - sugar) - 2 * growth * cells)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        strength = (0.07 + 1.2 * u[..., 0]) * x[..., 0]  # feeding stirs the broth; 7 to 26 % per root hour
        return rows(strength, torch.zeros_like(strength)).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(25 - x[..., 0], -self.avoid_level(x))

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 1] - 0.1, 16 - x[..., 1])


class FastCharge(ReachAvoidProblem):
    """Charge a cell to 80 % in time without overheating; heat grows as the square of the current; in K, A and s."""

    horizon = 1_000.0
    states, controls = Box([0.0, 288.0], [0.9, 322.0]), Box([0.0], [90.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        charge, heat = x.unbind(-1)
        current = torch.minimum(u[..., 0], 180 * (1.1 - charge).clamp(min=0))  # tapers towards the end
        resistance = 0.009 * torch.exp(-0.015 * (heat - 305))
        return rows(current / 108_000, (current.square() * resistance - 2 * (heat - 295)) / 1_200)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        strength = 0.12 + 0.003 * u[..., 0]
        return rows(torch.zeros_like(strength), strength).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return torch.maximum(0.8 - x[..., 0], -self.avoid_level(x))

    def avoid_level(self, x: Tensor) -> Tensor:
        return 320 - 8 * x[..., 0].square() - x[..., 1]


class Fishery(ReachAvoidProblem):
    """Let a stock of fish recover that dies out where it is small, before the fleet that fishes less has no money left.

    The states are the stock, as a share of what the sea can feed, and the money; the control is the effort.
    """

    horizon = 8.0
    states, controls = Box([0.0, 0.0], [1.2, 1.0]), Box([0.0], [0.6])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        stock, effort = x[..., 0], u[..., 0]
        growth = 0.48 * stock * (1 - stock) * (stock / 0.2 - 1)
        return rows(growth - effort * stock, 0.5 * effort * stock - 0.06)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(rows(0.2 * x[..., 0], 0.05 * torch.ones_like(x[..., 0])))

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(0.8 - x[..., 0], 0.3 - x[..., 1])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0] - 0.1, x[..., 1])


class Chemostat(ReachAvoidProblem):
    """Grow bacteria from a few milligrams to 4 g/l in 16 h; the inflow feeds them, and washes them out; g/l and h."""

    horizon = 16.0
    states, controls = Box([0.02, 0.0], [5.0, 10.0]), Box([0.0], [0.6])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        bacteria, sugar = x.unbind(-1)
        growth = 0.5 * sugar / (1 + sugar) * bacteria
        inflow = u[..., 0]
        return rows(growth - inflow * bacteria - 0.03 * bacteria, inflow * (10 - sugar) - 2 * growth)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(0.2 * x[..., 0], 0 * x[..., 0]).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return (4 - x[..., :1]) / 4
