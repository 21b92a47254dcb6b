"""A minefield with many ways through it, and two flywheels whose phases are both periodic."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


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


class Flywheels(ReachAvoidProblem):
    """Bring two flywheels, which pull each other, to the same mark within 12 s, never in opposite phase; in rad and s.

    The phases are those of Y. Kuramoto's oscillators, and the control turns the first one.
    """

    horizon = 12.0
    states = Box([-math.pi, -math.pi], [math.pi, math.pi], periodic=[0, 1])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        first, second = x.unbind(-1)
        pull = 0.4 * (second - first).sin()
        return rows(0.2 + pull + u[..., 0], 0.5 - pull)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.3, 0.0], [0.0, 0.4])

    def target_level(self, x: Tensor) -> Tensor:
        return 0.93 - x.cos().amin(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 0.9 + (x[..., 0] - x[..., 1]).cos()
