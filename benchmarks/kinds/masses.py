"""Masses and motors: forces that are bounded, noise that acts through integrators."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Servo(ReachAvoidProblem):
    """Bring a motor with dry friction to rest near the middle; noise acts on the speed alone."""

    horizon = 2.5
    states, controls = Box([-1.5, -2.0], [1.5, 2.0]), Box([-1.5], [1.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        speed = x[..., 1]
        return rows(speed, u[..., 0] - 0.6 * speed - 0.3 * torch.tanh(8 * speed))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.35])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0].abs() - 0.15, x[..., 1].abs() - 0.3)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1.2 - x[..., :1].abs()


class Gusty(ReachAvoidProblem):
    """Reach a disc behind a rock in a box, with noise that grows with the control."""

    horizon = 2.5
    states, controls = Box([-1.5, -1.5], [1.5, 1.5]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u + 0.4 * rows(x[..., 1], -x[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(0.15 + 0.25 * u.abs())

    def target_level(self, x: Tensor) -> Tensor:
        return (x - 0.8).norm(dim=-1) - 0.3

    def avoid_level(self, x: Tensor) -> Tensor:
        return torch.minimum(x.norm(dim=-1) - 0.35, 1.4 - x.abs().amax(-1))


class Orbit(ReachAvoidProblem):
    """Come to rest at a station within an hour, in metres and seconds, before a wall on either side."""

    horizon = 3_600.0
    states, controls = Box([-1e5, -200.0], [1e5, 200.0]), Box([-0.2], [0.2])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 1], u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [200.0, 0.0], [0.0, 1.0])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0].abs() - 1e4, x[..., 1].abs() - 30)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 9.5e4 - x[..., :1].abs()


class VanDerPol(ReachAvoidProblem):
    """Stop a self-excited oscillation with a weak motor; noise acts on the speed alone."""

    horizon = 6.0
    states, controls = Box([-2.5, -3.5], [2.5, 3.5]), Box([-0.6], [0.6])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        q, v = x.unbind(-1)
        return rows(v, (1 - q.square()) * v - q + u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.3])

    def target_level(self, x: Tensor) -> Tensor:
        return x.norm(dim=-1) - 0.4

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 2.4 - x[..., :1].abs()


class Lander(ReachAvoidProblem):
    """Touch down softly with an engine that can only push upwards."""

    horizon = 4.0
    states, controls = Box([0.0, -2.5], [3.0, 1.5]), Box([0.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 1], u[..., 0] - 1.0)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.25])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows((x[..., 0] - 0.06).abs() - 0.05, x[..., 1].abs() - 0.4)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., :1]


class Crosswind(ReachAvoidProblem):
    """Bring a mass to rest between two walls in a wind that nobody controls, and which alone has noise."""

    horizon = 2.5
    states, controls = Box([-1.5, -1.5, -1.0], [1.5, 1.5, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        _, speed, wind = x.unbind(-1)
        return rows(speed, u[..., 0] + wind, -0.8 * wind)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.0], [0.5])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0].abs() - 0.2, x[..., 1].abs() - 0.3)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1.3 - x[..., :1].abs()


class Sprint(ReachAvoidProblem):
    """Run to a line before the strength is spent, which falls with the square of the speed and grows at rest."""

    horizon = 3.0
    states, controls = Box([0.0, 0.0], [2.0, 1.0]), Box([0.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        speed = u[..., 0]
        return rows(speed - 0.3, 0.25 - 0.5 * speed.square())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.25, 0.0], [0.0, 0.15])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(1.7 - x[..., 0], 0.02 - x[..., 1])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., 1:]
