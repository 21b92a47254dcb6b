"""A ball under a magnet, a mass with dry friction, a boost converter, a tumbling body: machines with fast parts."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class MagLev(ReachAvoidProblem):
    """Keep an iron ball between a magnet and a stop for 0.6 s; the states in mm, mm/s and A, the control in V."""

    objective = "invariance"
    horizon = 0.6
    states, controls = Box([5.0, -150.0, 0.2], [15.0, 150.0, 2.2]), Box([0.0], [24.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        gap, speed, current = x.unbind(-1)
        pull = 9_810 * (10 * current / gap.clamp(min=1)).square()  # 1 A holds the ball at 10 mm
        return rows(speed, 9_810 - pull, (u[..., 0] - 10 * current) / 0.4)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [60.0], [0.0])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0] - 6, 14 - x[..., 0])


class Friction(ReachAvoidProblem):
    """Push a mass with dry friction on to a pad, and leave it at rest there, before it falls off the table; m and s."""

    horizon = 4.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        speed = x[..., 1]
        return rows(speed, u[..., 0] - 0.4 * torch.tanh(speed / 0.02) - 0.1 * speed)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.25])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows((x[..., 0] - 1.3).abs() - 0.2, x[..., 1].abs() - 0.15)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(1.8 - x[..., 0], x[..., 0] + 1.9)


class Converter(ReachAvoidProblem):
    """Bring the voltage of a boost converter into a band without too large a current; in A, V and ms."""

    horizon = 2.5
    states, controls = Box([0.0, 5.0], [8.0, 30.0]), Box([0.05], [0.95])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        current, voltage = x.unbind(-1)
        passed = 1 - u[..., 0]
        return rows((12 - passed * voltage - 0.3 * current) / 2, (passed * current - voltage / 12) / 0.5)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(rows(torch.full_like(x[..., 0], 0.6), 0.05 * x[..., 1]))

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows((x[..., 1] - 25).abs() - 0.7, (x[..., 0] - 4.2).abs() - 0.6)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(7 - x[..., 0], x[..., 0] - 0.1, 29 - x[..., 1])


class Detumble(ReachAvoidProblem):
    """Stop the rotation of a rigid body with two torques about three axes, by the equations of Euler; in rad/s."""

    horizon = 8.0
    states, controls = Box([-1.0] * 3, [1.0] * 3), Box([-0.15] * 2, [0.15] * 2)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        a, b, c = x.unbind(-1)
        return rows(0.6 * b * c + u[..., 0], -0.7 * a * c + u[..., 1], 0.4 * a * b)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.08, 0.0, 0.0], [0.0, 0.08, 0.0], [0.0, 0.0, 0.04])

    def target_level(self, x: Tensor) -> Tensor:
        return x.norm(dim=-1) - 0.25

    def avoid_level(self, x: Tensor) -> Tensor:
        return 0.98 - x.abs().amax(-1)
